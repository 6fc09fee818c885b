"""Batches of windows of consecutive frames, goals relabelled by index (App. B.4). Frames are gathered late, by row.

Letters: B windows, L steps a window, M rows to encode, T value transitions, W rollouts, A action dimension, F frames of the
store.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from velap.config.training import TrainConfig
from velap.data.commands import past_commands
from velap.data.frames import FrameStore, stack_indices
from velap.data.relabelling import Relabelled, relabel
from velap.errors import DatasetError


class Batch(NamedTuple):
    """One sample. The first B·(L+1) of `rows` are the windows; positions index `rows`, so each frame is encoded once."""

    rows: Tensor
    """int64 [M], frame rows to encode."""
    valid: Tensor
    """bool [B, L], the transition lies inside its episode."""
    actions: Tensor
    """float32 [B, L, A] in [-1, 1]."""
    unrolled: Tensor
    """int64 [W], position of the latents that the dynamics are unrolled from."""
    start: Tensor
    """int64 [T], position of z_t."""
    action: Tensor
    """float32 [T, A], a_t."""
    reward: Tensor
    """float32 [T], r_t of the task."""
    proceeds: Tensor
    """float32 [T], 0 where the task ended at t+1, else 1; z_{t+1} is at `start + 1`."""
    weight: Tensor
    """float32 [T], 1 where the transition lies inside its episode."""
    goals: Relabelled
    """Goals of the local learners."""


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
        self, windows: int, length: int, whole: bool, generator: torch.Generator, *, rewarded_share: float | None = None
    ) -> Batch:
        """B `windows` of L `length` steps; with `whole` the values learn from transitions and the dynamics from starts all
        over them (as many as the config says), else from each window's first. `rewarded_share` replaces the config's."""
        share = self.config.rewarded_share if rewarded_share is None else rewarded_share
        _, last, at = self._draw_windows(windows, length, whole, share, generator)
        window_rows = torch.minimum(at[:, None] + torch.arange(length + 1, device=self.device), last[:, None])
        valid = at[:, None] + torch.arange(length, device=self.device) < last[:, None]
        positions = torch.arange(windows * (length + 1), device=self.device).view(windows, length + 1)
        if whole:
            ahead_of_end = length - self.config.dynamics_horizon + 1
            start = self._draw(positions[:, :length], self.config.value_transitions, generator)
            unrolled = self._draw(positions[:, :ahead_of_end], self.config.dynamics_rollouts, generator)
        else:
            start = unrolled = positions[:, 0]
        inside = valid[start // (length + 1), start % (length + 1)]
        rows = window_rows.reshape(-1)
        chosen = rows[start]
        extra = None
        if not whole:
            span = (last - chosen - 1).clamp(min=0)
            ahead = 2 + (torch.rand(windows, generator=generator, device=self.device) * span).long()
            extra = torch.minimum(chosen + ahead, last)
            rows = torch.cat([rows, extra])
        goals = relabel(rows, start, inside, valid, self.config, generator)
        ended = self.terminated[chosen]
        proceeds = (~ended).float()
        return Batch(
            rows=rows,
            valid=valid,
            actions=self.actions[window_rows[:, :-1]],
            unrolled=unrolled,
            start=start,
            action=self.actions[chosen],
            reward=self.rewards[chosen],
            proceeds=proceeds,
            weight=inside.float(),
            goals=goals._replace(proceeds=goals.proceeds * proceeds),
        )

    def successes(self, reach: int = 0) -> Tensor:
        """Rows int64 [*] of the training transitions of successful episodes, with a `reach` above 0 of those at most so many
        steps before a reward; raises DatasetError where there are none."""
        if len(self.rewarded) == 0:
            raise DatasetError("the dataset has no successful episode to clone; expected at least one with a reward of 1. "
                               "Collect or label some successes, or set `clone_steps` to 0.")
        rows = self.transitions[torch.isin(self.first[self.transitions], self.first[self.rewarded])]
        if reach == 0:
            return rows
        following = torch.searchsorted(self.rewarded, rows).clamp(max=len(self.rewarded) - 1)
        ahead = self.rewarded[following] - rows
        return rows[(ahead >= 0) & (ahead <= reach) & (self.first[self.rewarded[following]] == self.first[rows])]

    def _draw(self, positions: Tensor, count: int, generator: torch.Generator) -> Tensor:
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
        self, windows: int, length: int, whole: bool, rewarded_share: float, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """First row and last row of each window's episode, and the window's first row, each int64 [B]."""

        def draw(pool: Tensor, n: int) -> Tensor:
            return pool[torch.randint(len(pool), (n,), generator=generator, device=self.device)]

        anchor = draw(self.transitions, windows)
        if self.config.group_windows > 1:
            anchor = self._gather(anchor, generator)
        if rewarded_share > 0 and len(self.rewarded):
            rare = torch.rand(windows, generator=generator, device=self.device) < rewarded_share
            anchor = torch.where(rare, draw(self.rewarded, windows), anchor)
        first, last = self.first[anchor], self.last[anchor]
        if not whole:
            return first, last, anchor
        back = torch.randint(length, (windows,), generator=generator, device=self.device)
        return first, last, torch.maximum(torch.minimum(anchor - back, last - length), first)

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
