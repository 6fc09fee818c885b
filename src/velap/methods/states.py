"""Frames to latents, with what an agent remembers of its own actions (`command_dims`, ours) and the state beside them.

B environments, N stacked frames, A action dimension, D latent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.data.commands import remembered
from velap.errors import ObservationError

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


def checked_frames(frames: Any, stack: int, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """The frames of B states as φ reads them: uint8 [B, N, H, W, 3] in one block of memory.

    Raises ObservationError for every other type, number of axes and shape. φ would accept some of them silently, for
    instance floats in [0, 1], and give another action.

    Args:
        frames: what `act` was given; a view of any strides, and what is read-only, is copied.
        stack: N, frames a state [frames].
        size: H and W [px]; None takes any.
    """
    given = np.asarray(frames)
    height, width = size or ("H", "W")
    got = (f"got frames of type {given.dtype} and shape {list(given.shape)}; expected uint8 in 0 to 255 of shape "
           f"[B, {stack}, {height}, {width}, 3], oldest frame first")
    if given.dtype != np.uint8:
        raise ObservationError(f"{got}. {_type_hint(given)}")
    state = (stack, *(size or given.shape[2:4]), 3)
    if len(given.shape) != 5 or len(given) == 0 or given.shape[1:] != state:
        raise ObservationError(f"{got}. {_shape_hint(given.shape, state)}")
    return np.require(given, requirements=("C", "W"))


def _type_hint(given: NDArray[Any]) -> str:
    """What to do about frames that are not uint8."""
    if given.dtype.kind == "f" and given.size and np.nanmax(given) <= 1:
        return "Convert floats in 0 to 1 by np.round(255 * frames).astype(np.uint8)."
    return "Convert values in 0 to 255 by np.round(frames).astype(np.uint8)."


def _shape_hint(given: tuple[int, ...], state: tuple[int, ...]) -> str:
    """What to do about frames of another shape than [B, *state]."""
    if len(given) == 4 and given[0] == state[0]:
        return "Add the batch axis: frames[None]."
    if len(given) != 5 or given[0] == 0:
        return "Stack the frames of each environment, and the environments, B of them, 1 or more."
    if given[1] != state[0]:
        return f"Give the newest {state[0]} frames of each episode; repeat its first frame where there are fewer."
    if given[2] == 3 and given[4] != 3:
        return "Put the channels last: np.moveaxis(frames, 2, -1)."
    return "Give frames of the size and the colours that the model was trained on."


class StateEncoder:
    """φ on an agent's frames, and the leaky mean of the actions that it took in each row's episode."""

    def __init__(self, model: LatentModel) -> None:
        self._model = model
        self._memory = model.memory
        self._device = next(model.parameters()).device
        self._commands = torch.empty(0, model.action_dim, device=self._device)

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Start new episodes where `mask` [B] is set."""
        if len(self._commands) != len(mask):
            self._commands = self._commands.new_zeros(len(mask), self._model.action_dim)
        started = torch.from_numpy(mask).to(self._device)
        self._commands = self._commands.masked_fill(started[:, None], 0.0)

    def checked(self, frames: NDArray[np.uint8], state: NDArray[np.floating[Any]] | None = None) -> NDArray[np.uint8]:
        """`checked_frames` by the model's own N, H and W; raises ObservationError for another state than [B, S] as well. An
        agent calls it before it changes anything of its own."""
        spaces, size = self._model.spaces, self._model.spaces.state_dim
        checked = checked_frames(frames, self._model.config.frame_stack, (spaces.height, spaces.width))
        got = None if state is None else np.asarray(state)
        wanted = (len(checked), size) if size else None
        if (None if got is None else got.shape) != wanted or (got is not None and not np.isfinite(got).all()):
            raise ObservationError(f"got {'no state' if got is None else f'a state of shape {list(got.shape)}'}; expected "
                                   f"{f'finite numbers [{len(checked)}, {size}]' if size else 'none'}, as the training data "
                                   "have. Call act(frames, state).")
        return checked

    def __call__(self, frames: NDArray[np.uint8], state: NDArray[np.floating[Any]] | None = None) -> Tensor:
        """Frames [B, N, H, W, 3], and the state [B, S] of a model that has one -> latents [B, D]; raises ObservationError on
        anything else."""
        seen = torch.from_numpy(self.checked(frames, state)).to(self._device)
        held = None if state is None else torch.from_numpy(np.array(state, np.float32)).to(self._device)
        return self._model.encode(seen, self._commands, held)

    def act(self, actions: Tensor) -> NDArray[np.float32]:
        """Actions [B, A] in [-1, 1] in the environment's own range; they are remembered as taken."""
        self._commands = remembered(self._commands, actions, self._memory)
        return self._model.to_env(actions)
