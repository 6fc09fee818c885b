"""Batches of windows of consecutive frames, goals relabelled by index (App. B.4). Frames are gathered late, by row.

Letters: B windows, L steps a window, M rows to encode, T value transitions, W rollouts, A action dimension, F frames of the
store.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from velap.config.training import TrainConfig
from velap.data.commands import past_commands
from velap.data.frames import FrameStore, stack_indices
from velap.data.relabelling import Later, goal_positions, later_in_window
from velap.errors import DatasetError


@dataclass(frozen=True)
class WholeWindows:
    """Windows anywhere in the episodes; values and dynamics learn from all over them, so that each frame is used often."""

    windows: int
    """B."""
    length: int
    """L [steps]."""
    transitions: int = 0
    """T that the values learn from, without repetition; 0 takes all."""
    rollouts: int = 0
    """W starts that the dynamics are unrolled from, without repetition; 0 takes all."""
    horizon: int = 1
    """Steps that the dynamics are unrolled: starts lie at least so far from the end of their window [steps]."""


@dataclass(frozen=True)
class FirstTransitions:
    """Windows that begin at a drawn transition, the only one that values and dynamics learn from; later goals are frames of
    their own."""

    windows: int
    """B."""
    length: int
    """L [steps]."""


class Batch(NamedTuple):
    """One sample. The first B·(L+1) of `rows` are the windows. What ends in `_at` is a position in `rows`, and so in the
    latents of their frames: each frame is encoded once."""

    rows: Tensor
    """int64 [M], rows of the store whose frames are to be encoded."""
    valid: Tensor
    """bool [B, L], the transition lies inside its episode."""
    actions: Tensor
    """float32 [B, L, A] in [-1, 1]."""
    unroll_at: Tensor
    """int64 [W], latents that the dynamics are unrolled from."""
    now_at: Tensor
    """int64 [T], z_t; z_{t+1} is the next one."""
    goal_at: Tensor
    """int64 [T], z_* of the local learners."""
    action: Tensor
    """float32 [T, A], a_t."""
    reward: Tensor
    """float32 [T], r_t of the task."""
    proceeds: Tensor
    """float32 [T], 0 where the task ended at t+1, else 1."""
    goal_reward: Tensor
    """float32 [T], 1 where the next state is the goal."""
    goal_proceeds: Tensor
    """float32 [T], 0 where the goal is reached or the task ended at t+1, else 1."""
    weight: Tensor
    """float32 [T], 1 where the transition lies inside its episode."""


class WindowSampler:
    """Draws batches from a frame store; everything that sampling needs lives on `device`, frames included when asked."""

    def __init__(self, store: FrameStore, config: TrainConfig, frame_stack: int, device: torch.device, holdout: np.ndarray):
        self.config, self.frame_stack, self.device = config, frame_stack, device

        def put(array: np.ndarray) -> Tensor:
            return torch.from_numpy(np.ascontiguousarray(array)).to(device)

        low, high = store.action_low, store.action_high
        self.frames = put(store.frames)
        self.actions = put(((store.actions - low) / (high - low) * 2 - 1).clip(-1, 1).astype(np.float32))
        self.rewards = put(store.rewards)
        self.terminated = put(store.terminated)
        self.states = None if store.states is None else put(store.states)
        """float32 [F, S], as recorded; None without."""
        self.first = put(store.first)
        self.last = put(store.last)
        training = ~np.isin(store.episode_of, holdout)
        inside = np.arange(len(store.frames)) < store.last
        self.transitions = put(np.flatnonzero(inside & training))
        self.rewarded = put(np.flatnonzero(inside & training & (store.rewards > 0)))
        kept = np.setdiff1d(np.flatnonzero(store.episode_length), holdout)
        self.episodes = put(kept)
        self.starts, self.lengths = put(store.episode_start), put(store.episode_length)
        # a row's place among the training episodes
        self.rank_of_row = put(np.searchsorted(kept, store.episode_of).clip(max=max(len(kept) - 1, 0)))
        self._commands: dict[float, Tensor] = {}
        if len(self.transitions) == 0:
            raise DatasetError("the dataset has no transition to train on; expected episodes of at least one step.")

    def sample(
        self, draw: WholeWindows | FirstTransitions, generator: torch.Generator, rewarded_share: float
    ) -> Batch:
        """What `draw` says; `rewarded_share` of the windows hold a rewarded transition, beyond chance."""
        windows, length = draw.windows, draw.length
        last, first_row = self._draw_windows(draw, rewarded_share, generator)
        window_rows = torch.minimum(first_row[:, None] + torch.arange(length + 1, device=self.device), last[:, None])
        valid = first_row[:, None] + torch.arange(length, device=self.device) < last[:, None]
        positions = torch.arange(windows * (length + 1), device=self.device).view(windows, length + 1)
        rows = window_rows.reshape(-1)
        if isinstance(draw, WholeWindows):
            now_at = self._choose(positions[:, :length], draw.transitions, generator)
            unroll_at = self._choose(positions[:, : length - draw.horizon + 1], draw.rollouts, generator)
            later = later_in_window(now_at, valid, generator)
        else:
            now_at = unroll_at = positions[:, 0]
            rows, later = self._with_later_frames(rows, now_at, last, generator)
        inside = valid[now_at // (length + 1), now_at % (length + 1)]
        goal_at = goal_positions(now_at, inside, valid, later, self.config, generator)
        reached = rows[goal_at] == rows[now_at + 1]
        chosen = rows[now_at]
        proceeds = (~self.terminated[chosen]).float()
        return Batch(
            rows=rows,
            valid=valid,
            actions=self.actions[window_rows[:, :-1]],
            unroll_at=unroll_at,
            now_at=now_at,
            goal_at=goal_at,
            action=self.actions[chosen],
            reward=self.rewards[chosen],
            proceeds=proceeds,
            goal_reward=reached.float(),
            goal_proceeds=(~reached).float() * proceeds,
            weight=inside.float(),
        )

    def _with_later_frames(
        self, rows: Tensor, now_at: Tensor, last: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Later]:
        """Rows [M + B]: one more frame for each window, two steps or more after its first where the episode goes on."""
        first = rows[now_at]
        span = (last - first - 1).clamp(min=0)
        ahead = 2 + (torch.rand(len(now_at), generator=generator, device=self.device) * span).long()
        frames = torch.minimum(first + ahead, last)
        appended = len(rows) + torch.arange(len(now_at), device=self.device)
        return torch.cat([rows, frames]), Later(appended, frames > rows[now_at + 1])

    def successes(self) -> Tensor:
        """Rows int64 [*] of the training transitions of successful episodes; raises DatasetError where there are none."""
        if len(self.rewarded) == 0:
            raise DatasetError("the dataset has no successful episode to clone; expected at least one with a reward of 1. "
                               "Collect or label some successes, or leave the clone phase out (train.clone.steps=0).")
        return self.transitions[torch.isin(self.first[self.transitions], self.first[self.rewarded])]

    def _choose(self, positions: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """`count` of the positions without repetition, or all of them where they are no more or `count` is 0."""
        everything = positions.reshape(-1)
        if not 0 < count < len(everything):
            return everything
        return everything[torch.randperm(len(everything), generator=generator, device=self.device)[:count]]

    def stacks(self, rows: Tensor) -> Tensor:
        """Frame stacks of rows: int64 `[*] → uint8 [*, N, H, W, 3]`."""
        index = self.stack_rows(rows)
        return self.frames.index_select(0, index.flatten()).view(*index.shape, *self.frames.shape[1:])

    def stack_rows(self, rows: Tensor) -> Tensor:
        """Rows of the frames of their stacks, oldest first: int64 `[*] → [*, N]`."""
        return stack_indices(rows, self.first[rows], self.frame_stack)

    def commands(self, rows: Tensor, memory: float) -> Tensor:
        """Leaky means of the actions before rows: int64 `[*] → float32 [*, A]` in [-1, 1]; see `velap.data.commands`."""
        if memory not in self._commands:
            self._commands[memory] = past_commands(self.actions, self.first, memory)
        return self._commands[memory][rows]

    def _draw_windows(
        self, what: WholeWindows | FirstTransitions, rewarded_share: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Last row of each window's episode, and the window's first row, each int64 [B]."""
        windows, length = what.windows, what.length

        def draw(pool: Tensor, n: int) -> Tensor:
            return pool[torch.randint(len(pool), (n,), generator=generator, device=self.device)]

        anchor = draw(self.transitions, windows)
        if self.config.group_windows > 1:
            anchor = self._gather(anchor, generator)
        if rewarded_share > 0 and len(self.rewarded):
            rare = torch.rand(windows, generator=generator, device=self.device) < rewarded_share
            anchor = torch.where(rare, draw(self.rewarded, windows), anchor)
        last = self.last[anchor]
        if isinstance(what, FirstTransitions):
            return last, anchor
        back = torch.randint(length, (windows,), generator=generator, device=self.device)
        return last, torch.maximum(torch.minimum(anchor - back, last - length), self.first[anchor])

    def _gather(self, anchor: Tensor, generator: torch.Generator) -> Tensor:
        """Anchors int64 [B] of which each group's first stays and the others move to episodes near its own."""
        size, reach = self.config.group_windows, self.config.group_reach
        number = torch.arange(len(anchor), device=self.device)
        leader = anchor[number // size * size]
        step = torch.randint(-reach, reach + 1, anchor.shape, generator=generator, device=self.device)
        episode = self.episodes[(self.rank_of_row[leader] + step).clamp(0, len(self.episodes) - 1)]
        at = torch.rand(anchor.shape, generator=generator, device=self.device) * self.lengths[episode]
        moved = self.starts[episode] + at.long().clamp(max=self.lengths[episode] - 1)
        return torch.where(number % size == 0, anchor, moved)
