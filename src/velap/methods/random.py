"""Uniform actions: how far a task gets without any knowledge. ours: Table 1 has no such row.

B environments, N stacked frames, A action dimension.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from velap.errors import ConfigError
from velap.methods.base import Agent, Method, Parts, State, checked_starts
from velap.methods.states import checked_frames
from velap.registry import register_method

if TYPE_CHECKING:
    from gymnasium.spaces import Box


class RandomAgent:
    """Uniform actions over the action space, from one generator a row."""

    method = "random"

    def __init__(self, action_space: Box, frame_stack: int) -> None:
        if not action_space.is_bounded():
            raise ConfigError(f"uniform actions need bounds, and the action space is {action_space}; expected finite ones. "
                              "Give the environment bounds, for example by gymnasium.wrappers.ClipAction or RescaleAction, "
                              "or use another method.")
        self.frame_stack = frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self._low = action_space.low.astype(np.float32)
        self._high = action_space.high.astype(np.float32)
        self._generators: list[np.random.Generator] = []

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """New generators where `mask` [B] is set."""
        mask, starts = checked_starts(mask, seeds)
        if len(self._generators) != len(mask):
            self._generators = [np.random.default_rng(row) for row in range(len(mask))]
            self.last_plan_ms = np.full(len(mask), np.nan)
        for row, seed in starts:
            self._generators[row] = np.random.default_rng(seed)

    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """Uniform actions [B, A]; of the frames [B, N, H, W, 3] only the number counts, H and W are any."""
        frames = checked_frames(frames, self.frame_stack)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        draws = [generator.uniform(self._low, self._high) for generator in self._generators]
        return np.stack(draws).astype(np.float32)


@register_method("random")
class Random(Method):
    """Uniform actions."""

    label = "random"
    needs_model = False

    def agent(self, parts: Parts) -> Agent:
        """Acts without a model; frames are stacked but not read."""
        return RandomAgent(parts.action_space, parts.config.model.frame_stack)
