"""What agents that follow plans have in common: when rows plan, what they hold, and what they tell of it.

B environments, N stacked frames, P rows that plan in one call, D latent dimensions, A action dimension.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.base import State, checked_starts
from velap.methods.lookahead import local_policy_of
from velap.methods.states import StateEncoder
from velap.methods.waypoints import Plans
from velap.models.horizon import q_from_steps
from velap.search.types import Path

if TYPE_CHECKING:
    from velap.config import Config
    from velap.models.velap import LatentModel


class Actor(StrEnum):
    """Who decided an action."""

    GOAL = "goal"
    """π^g, because the goal is near."""
    LOCAL = "local"
    """π^l on its way to a waypoint: an edge of g, or any edge where edges do not remember their proposer."""
    POLICY = "policy"
    """π^g on an edge of its own."""
    CLONE = "clone"
    """The policy cloned from successes on an edge of its own."""
    NOWHERE = "nowhere"
    """π^g, because the tree has no edge to follow."""


FOLLOWING = (Actor.LOCAL, Actor.POLICY, Actor.CLONE)
"""Those whose action follows an edge of the current tree."""
IN_WORDS = {
    Actor.GOAL: "global policy, goal near",
    Actor.LOCAL: "local policy",
    Actor.POLICY: "global policy",
    Actor.CLONE: "clone",
    Actor.NOWHERE: "global policy, no way found",
}
"""Actors as pictures and pages name them; the font of videos has no Greek letters."""


class TreeAgent(ABC):
    """Rows replan at their own times; those due at one step plan as one batch. A row draws from its own generator, and only
    for what it does itself, so that the other rows reach it through the rounding of batched arithmetic only."""

    method = "velap"

    def __init__(self, model: LatentModel, config: Config) -> None:
        self.frame_stack = config.model.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self.last_plan: Path | None = None
        """The plans of the last `act` that planned, kept for figures and videos."""
        self.last_plan_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows of `last_plan`."""
        self.planned_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows that planned in the last `act`."""
        self._states, self._fns = StateEncoder(model), model.search_fns()
        self._n_replan = config.controller.n_replan
        self._stop_value = q_from_steps(config.controller.stop_exponent, self._fns.discount)
        self._reached_value = q_from_steps(config.controller.waypoint_exponent, self._fns.discount)
        self._local_policy = local_policy_of(config.planner, model, self._fns)
        self._device = next(model.parameters()).device
        self._generators: list[torch.Generator] = []
        self._latents = torch.empty(0, 0)
        self._actors: list[Actor] = []
        self._allocate(0)

    def _allocate(self, batch: int) -> None:
        """Hold `batch` rows."""
        self.plans = Plans(batch, self._device)
        """What the rows follow."""
        self._age = torch.full((batch,), self._n_replan, device=self._device)
        """[B] steps since each row planned, n_replan where it has to [steps]."""
        self._values = torch.zeros(batch, device=self._device)
        self._near_goal = torch.zeros(batch, dtype=torch.bool, device=self._device)
        self.last_plan_ms = np.full(batch, np.nan)

    @torch.inference_mode()
    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the plans where `mask` [B] is set and seed those rows anew."""
        mask, starts = checked_starts(mask, seeds)
        if len(self._generators) != len(mask):
            self._generators = [torch.Generator().manual_seed(row) for row in range(len(mask))]
            self._allocate(len(mask))
        for row, seed in starts:
            self._generators[row].manual_seed(seed)
        self._states.forget(mask)
        started = torch.from_numpy(mask).to(self._device)
        self.plans.forget(started)
        self._age[started] = self._n_replan

    @abstractmethod
    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """One step: frames [B, N, H, W, 3] -> actions [B, A]."""

    @abstractmethod
    def _search(self, z: Tensor, generators: list[torch.Generator]) -> Path:
        """Plans from latents [P, D]."""

    def _observe(self, frames: NDArray[np.uint8], state: State) -> Tensor:
        """The latents [B, D] of frames [B, N, H, W, 3], and where they are near the goal."""
        frames = self._states.checked(frames, state)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        self._latents = self._states(frames, state)
        self._values = self._fns.value(self._latents)
        self._near_goal = self._values > self._stop_value
        return self._latents

    def _replan(self, z: Tensor, due: Tensor) -> None:
        """Plan for the rows `due` bool [B] from z [B, D]; they follow what is found."""
        self.last_plan_ms[:] = np.nan
        self.planned_rows = np.flatnonzero(due.cpu().numpy())
        if len(self.planned_rows) == 0:
            return
        rows = torch.from_numpy(self.planned_rows).to(self._device)
        start = time.perf_counter()
        found = self._search(z[rows], [self._generators[row] for row in self.planned_rows])
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.last_plan_ms[self.planned_rows] = (time.perf_counter() - start) * 1e3 / len(self.planned_rows)
        self.last_plan, self.last_plan_rows = found, self.planned_rows
        self.follow(rows, found)

    @torch.inference_mode()
    def follow(self, rows: Tensor, found: Path) -> None:
        """From now on `rows` int64 [P] follow the paths `found`."""
        self.plans.store(rows, found.waypoints, found.length)
        self._age[rows] = 0

    def _towards_waypoints(self, z: Tensor, rows: Tensor) -> Tensor:
        """Actions [P, A] of π^l, or of its lookahead, for `rows` int64 [P] of z [B, D] (Alg. 2, l. 10)."""
        generators = [self._generators[row] for row in rows.tolist()]
        return self._local_policy(self._fns, z[rows], self.plans.targets(rows), generators)

    @property
    def last_latents(self) -> NDArray[np.float32]:
        """[B, D] the last states."""
        return self._latents.float().cpu().numpy()

    @property
    def last_values(self) -> NDArray[np.float32]:
        """[B] Q^g of the last states [Q-value]."""
        return self._values.float().cpu().numpy()

    @property
    def near_goal(self) -> NDArray[np.bool_]:
        """[B] rows that π^g led in the last `act` because the goal was near."""
        return self._near_goal.cpu().numpy()

    @property
    def last_actors(self) -> list[Actor]:
        """[B] who decided the last actions."""
        return self._actors

    @property
    def by_plan(self) -> NDArray[np.bool_]:
        """[B] rows whose last action followed an edge of their tree."""
        return np.array([actor in FOLLOWING for actor in self._actors], bool)
