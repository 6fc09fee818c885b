"""The `Agent` protocol: what acts in a batch of environments, and the registry of the methods that do.

B environments, N stacked frames, A action dimensions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from velap.errors import UnknownTaskError

if TYPE_CHECKING:
    from gymnasium.spaces import Box

    from velap.config import Config
    from velap.models.latent import LatentModel

METHODS = ("velap", "td3bc", "random")
"""Methods of this package, in the names that records and tables use."""


class Agent(Protocol):
    """Acts in B environments at once; rows never influence each other."""

    method: str
    """Name in records and tables, one of `METHODS`."""
    frame_stack: int
    """N, frames a state [frames]."""
    last_plan_ms: NDArray[np.float64]
    """[B] planning time of the last `act` [ms], NaN in rows that did not plan."""

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Start new episodes where `mask` [B] is set, with randomness from `seeds` [B] alone; None takes the row numbers."""
        ...

    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Stacked frames [B, N, H, W, 3], oldest first -> actions [B, A] in the environment's own range.

        A batch of another size than the last one starts new episodes in all rows.
        """
        ...


def make_agent(method: str, model: LatentModel | None, config: Config, action_space: Box) -> Agent:
    """The agent of that name: `random` needs no model, the others act by `model`, which is put into evaluation mode."""
    if method not in METHODS:
        raise UnknownTaskError(f"unknown method {method!r}; expected one of {', '.join(METHODS)}.")
    from velap.agents.reactive import RandomAgent, ReactiveAgent
    from velap.agents.velap import VelapAgent

    if method == "random":
        return RandomAgent(action_space, config.model.frame_stack)
    if model is None:
        raise UnknownTaskError(f"method {method!r} acts by a trained model, got none; name one with --checkpoint.")
    model.eval()
    if method == "td3bc":
        return ReactiveAgent(model, config.model.frame_stack)
    return VelapAgent(model, config)


def masked_seeds(mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None) -> list[tuple[int, int]]:
    """(row, seed) of every row set in `mask` [B]."""
    rows = np.flatnonzero(mask)
    return [(int(row), int(row if seeds is None else seeds[row])) for row in rows]
