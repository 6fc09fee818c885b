"""What an environment may tell beside frames and rewards, one protocol a purpose.

Training and evaluation need none of it. Whoever asks says by `isinstance` what it needs, and does without where an
environment does not have it. Environments are asked through `env.unwrapped`.

A action dimension, P position dimensions, C points.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from velap.envs.mazes.geometry import Layout


@runtime_checkable
class Positioned(Protocol):
    """Knows where its agent is: positions are kept with a dataset, and pictures are drawn over them."""

    def agent_position(self) -> NDArray[np.float64]:
        """[P] [m]."""


@runtime_checkable
class HasTestRegion(Protocol):
    """Knows where test episodes start: a dataset's card says how many of its successes begin there."""

    def in_test_region(self) -> bool:
        """Is the agent where test episodes start?"""


@runtime_checkable
class Expert(Protocol):
    """Has a scripted expert: `velap study experts` shows that the task can be solved, diagnosis compares with it."""

    def expert_action(self) -> NDArray[np.floating[Any]]:
        """The expert's action [A], in the environment's own range."""


@runtime_checkable
class ScriptedTask(HasTestRegion, Expert, Protocol):
    """What the behaviour `noisy-expert` asks, which collects demonstrations."""

    def expert_distance(self) -> float:
        """Distance to what the expert acts on in the data [m]; infinite where it stays silent."""


@runtime_checkable
class Mapped(Positioned, Protocol):
    """A world seen from above in which the agent can be put anywhere: figures of latents and plans are drawn over it."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least and largest x, least and largest y [m]."""

    def set_agent_position(self, position: NDArray[np.float64]) -> None:
        """Put the agent at [P] [m]."""

    def free_positions(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Positions [C, P] [m] at which the agent can be, drawn uniformly."""


@runtime_checkable
class Walled(Protocol):
    """A block maze: straight lines and true distances can be computed."""

    layout: Layout
    """Walls, goal and starts of the present context."""


@runtime_checkable
class Measured(Protocol):
    """Knows how far the goal is: diagnosis says how close a failed episode came."""

    def geodesic_steps(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions [..., P] [m] → shortest ways to the goal [...] [steps]."""


@runtime_checkable
class WithObjects(Protocol):
    """Has things that the agent moves: diagnosis says whether a failed episode moved any."""

    def objects(self) -> NDArray[np.float64]:
        """Places of all of them [number, 3] [m]."""


@runtime_checkable
class WithSubtasks(Protocol):
    """Has to be solved in parts: diagnosis says which of them a failed episode solved."""

    def subtasks(self) -> tuple[bool, ...]:
        """Which parts are solved."""


@runtime_checkable
class WithTrueState(Protocol):
    """Knows all that pictures show: `velap study exact-latents` learns from that instead of pictures."""

    def true_state(self) -> NDArray[np.float32]:
        """[number]."""
