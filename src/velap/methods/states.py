"""Frames to latents, with what an agent remembers of its own actions (`command_memory`, ours).

B environments, N stacked frames, A action dimension, D latent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.data.commands import remembered

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


class StateEncoder:
    """φ on an agent's frames, and the leaky mean of the actions that it took in each row's episode."""

    def __init__(self, model: LatentModel) -> None:
        self._model = model
        self._memory = model.config.command_memory
        self._device = next(model.parameters()).device
        self._commands = torch.empty(0, model.action_dim, device=self._device)

    def forget(self, mask: NDArray[np.bool_]) -> None:
        """Start new episodes where `mask` [B] is set."""
        if len(self._commands) != len(mask):
            self._commands = self._commands.new_zeros(len(mask), self._model.action_dim)
        started = torch.from_numpy(mask).to(self._device)
        self._commands = self._commands.masked_fill(started[:, None], 0.0)

    def __call__(self, frames: NDArray[np.uint8]) -> Tensor:
        """[B, N, H, W, 3] -> [B, D]."""
        return self._model.encode(torch.from_numpy(frames).to(self._device), self._commands)

    def act(self, actions: Tensor) -> NDArray[np.float32]:
        """Actions [B, A] in [-1, 1] in the environment's own range; they are remembered as taken."""
        self._commands = remembered(self._commands, actions, self._memory)
        return self._model.to_env(actions)
