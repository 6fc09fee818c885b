"""What an environment may offer beside frames and rewards, one protocol a purpose.

Training and evaluation need none of them. Code that uses one checks `isinstance(env.unwrapped, Protocol)` and works without
it otherwise.

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
    """Knows where its agent is. Datasets keep positions, and figures are drawn over them."""

    def agent_position(self) -> NDArray[np.float64]:
        """[P] [m]."""


@runtime_checkable
class HasTestRegion(Protocol):
    """Knows where test episodes start. A dataset's card counts the successes that begin there."""

    def in_test_region(self) -> bool:
        """Is the agent where test episodes start?"""


@runtime_checkable
class Expert(Protocol):
    """Has a scripted expert, for `velap study experts` and for diagnosis."""

    def expert_action(self) -> NDArray[np.floating[Any]]:
        """The expert's action [A], in the environment's own range."""


@runtime_checkable
class ScriptedTask(HasTestRegion, Expert, Protocol):
    """What the behaviour `noisy-expert` needs to collect demonstrations."""

    def expert_distance(self) -> float:
        """Distance to what the expert acts on in the data [m]; infinite where it does not act."""


@runtime_checkable
class Mapped(Positioned, Protocol):
    """A world seen from above in which the agent can be placed anywhere. Figures of latents and plans are drawn over it."""

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Least and largest x, least and largest y [m]."""

    def set_agent_position(self, position: NDArray[np.float64]) -> None:
        """Put the agent at [P] [m]."""

    def free_positions(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Positions [C, P] [m] at which the agent can be, drawn uniformly."""


@runtime_checkable
class Walled(Protocol):
    """A block maze, in which true distances can be computed."""

    layout: Layout
    """Walls, goal and starts of the current context."""


@runtime_checkable
class Measured(Protocol):
    """Knows the distance to the goal. Diagnosis reports how close a failed episode came."""

    def geodesic_steps(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Positions [..., P] [m] → shortest ways to the goal [...] [steps]."""


@runtime_checkable
class WithObjects(Protocol):
    """Has objects that the agent moves. Diagnosis reports whether a failed episode moved any."""

    def objects(self) -> NDArray[np.float64]:
        """Positions of all objects [number, 3] [m]."""


@runtime_checkable
class WithSubtasks(Protocol):
    """Consists of subtasks. Diagnosis reports which of them a failed episode solved."""

    def subtasks(self) -> tuple[bool, ...]:
        """Which subtasks are solved, in their order."""


@runtime_checkable
class WithTrueState(Protocol):
    """Knows the state that frames show. `velap study exact-latents` learns from it instead of frames."""

    def true_state(self) -> NDArray[np.float32]:
        """[number], the agent's position first."""
