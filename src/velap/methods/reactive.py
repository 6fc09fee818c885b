"""Agents that look at the current state only: uniform random actions, π^g alone (TD3-BC), and the policies of BC and IQL."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.base import masked_seeds
from velap.methods.states import StateEncoder, checked_frames

if TYPE_CHECKING:
    from gymnasium.spaces import Box

    from velap.models.velap import LatentModel


class RandomAgent:
    """Uniform actions over the action space, from one generator a row."""

    method = "random"

    def __init__(self, action_space: Box, frame_stack: int = 1) -> None:
        self.frame_stack = frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self._low = action_space.low.astype(np.float32)
        self._high = action_space.high.astype(np.float32)
        self._generators: list[np.random.Generator] = []

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """New generators where `mask` [B] is set."""
        if len(self._generators) != len(mask):
            self._generators = [np.random.default_rng(row) for row in range(len(mask))]
            self.last_plan_ms = np.full(len(mask), np.nan)
        for row, seed in masked_seeds(mask, seeds):
            self._generators[row] = np.random.default_rng(seed)

    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Uniform actions [B, A]; of the frames [B, N, H, W, 3] only the number counts, H and W are any."""
        frames = checked_frames(frames, self.frame_stack)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        draws = [generator.uniform(self._low, self._high) for generator in self._generators]
        return np.stack(draws).astype(np.float32)


class ReactiveAgent:
    """One policy of the latent state at every step: π^g of the joint checkpoint (TD3-BC, D.2), or a head's (D.1, D.3)."""

    def __init__(self, method: str, model: LatentModel, policy: Callable[[Tensor], Tensor], frame_stack: int) -> None:
        self.method = method
        self.frame_stack = frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self._policy = policy
        self._states = StateEncoder(model)

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the actions taken, where the state holds them: the policy is a function of the state."""
        self._states.forget(mask)
        self.last_plan_ms = np.full(len(mask), np.nan)

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames)
        if len(frames) != len(self.last_plan_ms):
            self.reset(np.ones(len(frames), bool))
        return self._states.act(self._policy(self._states(frames)))
