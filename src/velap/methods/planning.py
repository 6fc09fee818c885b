"""What the planning baselines share: rows that plan every few steps and follow their plan in between.

B environments, N stacked frames, P rows that plan at one step, D latent, A action dimension.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.base import State, checked_starts
from velap.methods.states import StateEncoder

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


class PlanningAgent(ABC):
    """Plans for a row when its plan is `period` [steps] old, by the row's own generator.

    On a CPU rows plan one after the other: hundreds of samples a row fill the machine and stay in its cache, and a row's
    plan is the same to the last bit whatever rows it shares the batch with. On a GPU all rows due plan at once.
    """

    def __init__(self, method: str, model: LatentModel, period: int) -> None:
        self.method = method
        self.frame_stack = model.config.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self._model, self._states = model, StateEncoder(model)
        self._period = period
        self._device = next(model.parameters()).device
        self._generators: list[torch.Generator] = []
        self._age: NDArray[np.int64] = np.empty(0, np.int64)

    @torch.inference_mode()
    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the plans where `mask` [B] is set and seed those rows anew."""
        mask, starts = checked_starts(mask, seeds)
        if len(self._generators) != len(mask):
            self._generators = [torch.Generator().manual_seed(row) for row in range(len(mask))]
            self._age = np.full(len(mask), self._period)
            self.last_plan_ms = np.full(len(mask), np.nan)
            self._allocate(len(mask))
        self._states.forget(mask)
        for row, seed in starts:
            self._generators[row].manual_seed(seed)
            self._forget(row)
        self._age[mask] = self._period

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """Frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames, state)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        latents = self._states(frames, state)
        self.last_plan_ms[:] = np.nan
        due = np.flatnonzero(self._age >= self._period)
        at_once = 1 if self._device.type == "cpu" else max(len(due), 1)
        for start in range(0, len(due), at_once):
            self._timed_plan(due[start : start + at_once], latents)
        actions = self._follow(latents)
        self._age += 1
        return self._states.act(actions)

    def _timed_plan(self, rows: NDArray[np.int64], latents: Tensor) -> None:
        """Plan for `rows` [P] together and note each one's share of the time."""
        began = time.perf_counter()
        self._plan(rows, latents[torch.from_numpy(rows).to(self._device)], [self._generators[row] for row in rows])
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.last_plan_ms[rows] = (time.perf_counter() - began) * 1e3 / len(rows)
        self._age[rows] = 0

    @abstractmethod
    def _allocate(self, batch: int) -> None:
        """Room for the plans of `batch` rows."""

    @abstractmethod
    def _forget(self, row: int) -> None:
        """A new episode begins in `row`."""

    @abstractmethod
    def _plan(self, rows: NDArray[np.int64], latents: Tensor, generators: list[torch.Generator]) -> None:
        """Make and keep the plans of `rows` [P] from their latents [P, D], with one generator a row."""

    @abstractmethod
    def _follow(self, latents: Tensor) -> Tensor:
        """The plans' next actions [B, A] in [-1, 1] at latents [B, D]; every row has a plan, `_age` [steps] old."""
