"""The VELAP controller: Algorithm 2 with the settings of Table 9 (App. B.7), vectorised over environments.

B environments, N stacked frames, D latent dimensions, L waypoints of the longest plan held, P rows that plan in one call.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.base import masked_seeds
from velap.methods.residuals import Residuals, Step
from velap.methods.revisits import Revisits
from velap.methods.states import StateEncoder
from velap.methods.successes import SuccessRollouts
from velap.models.arrivals import GAINS
from velap.models.horizon import q_from_steps
from velap.search.est import plan
from velap.search.types import Plan, SearchFns

if TYPE_CHECKING:
    from velap.config import Config
    from velap.models.velap import LatentModel

SAMPLES = 32
"""Actions drawn from g for the lookahead. ours."""


class VelapAgent:
    """Plans every `n_replan` steps of a row, follows the waypoints by π^l, and hands over to π^g near the goal.

    Rows replan at their own times; those due at one step plan as one batch. A row draws from its own generator, and only
    for what it does itself, so that the other rows reach it through the rounding of batched arithmetic only.
    """

    method = "velap"

    def __init__(self, model: LatentModel, config: Config) -> None:
        self.frame_stack = config.model.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self.last_plan: Plan | None = None
        """A plan of the last `act` that planned, kept for figures and videos."""
        self.last_plan_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows of `last_plan`. Rows whose model their episode corrects plan alone."""
        self.planned_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows that planned in the last `act`."""
        self.last_values: NDArray[np.float32] = np.empty(0, np.float32)
        """[B] Q^g of the last states, less what standing there before has cost (`revisit_penalty`) [Q-value]."""
        self.near_goal: NDArray[np.bool_] = np.empty(0, bool)
        """[B] rows that π^g or a policy in its place led in the last `act` because the goal was near."""
        self.led_by_success: NDArray[np.bool_] = np.empty(0, bool)
        """[B] rows that the policy cloned from successes led in the last `act`."""
        self._model, self._states = model, StateEncoder(model)
        self._fns = SearchFns(**model.search_fns(config.planner.neighbour_distance_factor))
        self._planner = config.planner
        self._n_replan = config.controller.n_replan
        self._lookahead = config.controller.lookahead
        self._gain, self._goal_lookahead = config.controller.lookahead_gain, config.controller.goal_lookahead
        self._stop_value = q_from_steps(config.controller.stop_exponent, self._fns.discount)
        self._turn = config.controller.held_turn
        self.leader = "global policy"
        """What leads where no plan and no success does, in words."""
        if model.held_policy is not None:
            self.leader = "held or global policy" if self._turn else "held policy"
        close = config.controller.success_exponent
        self._success_value = q_from_steps(close, self._fns.discount) if close > 0 else None
        self._reached_value = q_from_steps(config.controller.waypoint_exponent, self._fns.discount)
        shortcut = config.controller.shortcut_exponent
        self._shortcut_value = q_from_steps(shortcut, self._fns.discount) if shortcut > 0 else None
        self._device = next(model.parameters()).device
        self._successes: SuccessRollouts | None = None
        if config.controller.success_rollout > 0:
            goal_value = q_from_steps(config.planner.goal_exponent, self._fns.discount)
            self._successes = SuccessRollouts(self._fns, config.controller.success_rollout, goal_value, GAINS)
        self._residuals: Residuals | None = None
        if config.controller.residuals:
            self._residuals = Residuals(config.controller.residuals, self._fns.step, self._fns.step_distance)
        self._revisits: Revisits | None = None
        if config.controller.revisit_penalty > 0:
            self._revisits = Revisits(config.controller.revisit_penalty, self._fns.step_distance, self._fns.discount)
        self._generators: list[torch.Generator] = []
        self._steps = torch.empty(0, dtype=torch.long)
        self._plan_age = torch.empty(0, dtype=torch.long)
        self._waypoints = torch.empty(0, 1, 0)
        self._length = torch.empty(0, dtype=torch.long)
        self._current = torch.empty(0, dtype=torch.long)

    @torch.inference_mode()
    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the plans where `mask` [B] is set and seed those rows anew."""
        if len(self._generators) != len(mask):
            self._allocate(len(mask))
        for row, seed in masked_seeds(mask, seeds):
            self._generators[row].manual_seed(seed)
        self._states.forget(mask)
        started = torch.from_numpy(mask).to(self._device)
        self._steps[started] = 0
        self._plan_age[started] = self._n_replan
        self._length[started] = 0
        if self._residuals is not None:
            self._residuals.forget(started)
        if self._revisits is not None:
            self._revisits.forget(started)

    def _allocate(self, batch: int) -> None:
        """Empty state for `batch` rows."""
        self._generators = [torch.Generator().manual_seed(row) for row in range(batch)]
        self._steps = torch.zeros(batch, dtype=torch.long, device=self._device)
        self._plan_age = torch.full((batch,), self._n_replan, device=self._device)
        self._waypoints = torch.zeros(batch, 1, 0, device=self._device)
        self._length = torch.zeros(batch, dtype=torch.long, device=self._device)
        self._current = torch.zeros(batch, dtype=torch.long, device=self._device)
        self.last_plan_ms = np.full(batch, np.nan)

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """One step of Algorithm 2: frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        latents = self._states(frames)
        if self._residuals is not None:
            self._residuals.observe(latents)
        values = promised = self._fns.value(latents)
        if self._revisits is not None:
            values = self._revisits.observe(latents, values)
        near_goal = values > self._stop_value
        self.last_values, self.near_goal = values.float().cpu().numpy(), near_goal.cpu().numpy()
        led = self._successes.lead(latents) if self._successes is not None else None
        self.led_by_success = np.zeros(len(latents), bool) if led is None else led.arrives.cpu().numpy()
        self._replan(latents, (self._plan_age >= self._n_replan) & ~(near_goal if led is None else near_goal | led.arrives))
        self._advance(latents)
        self._plan_age += 1
        self._steps += 1

        # A plan of the root alone leads nowhere, and a row near the goal may have none: π^g acts in both.
        actions = self._act_global(latents)
        rows = torch.nonzero(~near_goal & (self._length > 1)).flatten()
        if len(rows):
            actions = actions.index_copy(0, rows, self._act_local(latents[rows], rows).to(actions))
        if led is not None:
            actions = torch.where(led.arrives[:, None], led.actions, actions)
        if self._success_value is not None and self._fns.act_success is not None:
            close = near_goal & (promised > self._success_value)
            actions = torch.where(close[:, None], self._fns.act_success(latents), actions)
            self.led_by_success |= close.cpu().numpy()
        if self._residuals is not None:
            self._residuals.acted(latents, actions)
        return self._states.act(actions)

    def _act_local(self, latents: Tensor, rows: Tensor) -> Tensor:
        """π^l from latents [P, D] of `rows` int64 [P] towards their waypoints: actions [P, A].

        With lookahead (ours) the best of it and of sampled actions: every action is held for a few steps of h, and the one
        whose end reaches the waypoint with the highest Q_min wins.
        """
        waypoints = self._waypoints[rows, self._current[rows]]
        policy = self._model.act_local(latents, waypoints)
        if self._lookahead == 0:
            return policy
        shape = (SAMPLES, self._fns.noise_dim)
        drawn = [torch.randn(shape, generator=self._generators[row]) for row in rows.tolist()]
        noise = torch.stack(drawn).to(latents)
        sampled = self._fns.propose(latents.unsqueeze(1).expand(-1, SAMPLES, -1), noise)
        actions = torch.cat([policy.unsqueeze(1), sampled], 1)
        if self._gain != 1:
            actions = torch.cat([actions, (self._gain * actions).clamp(-1, 1)], 1)
        step = self._fns.step if self._residuals is None else self._residuals.of_rows(rows)
        ends = self._held(latents, actions, step, self._lookahead)
        q_min, _ = self._fns.reach(ends, waypoints.unsqueeze(1).expand_as(ends))
        return actions[torch.arange(len(actions), device=actions.device), q_min.argmax(1)]

    def _act_global(self, latents: Tensor) -> Tensor:
        """What leads, or the best of it and stronger versions of its action under the dynamics, by Q^g (ours): actions
        [B, A]."""
        policy = self._lead(latents)
        if self._goal_lookahead == 0:
            return policy
        gains = torch.tensor(GAINS, device=policy.device).view(-1, 1)
        actions = (gains * policy.unsqueeze(1)).clamp(-1, 1)
        ends = self._held(latents, actions, self._fns.step, self._goal_lookahead)
        return actions[torch.arange(len(actions), device=actions.device), self._fns.value(ends).argmax(1)]

    def _lead(self, latents: Tensor) -> Tensor:
        """π^g, or the held policy where there is one, or both in turns: actions [B, A]."""
        if self._model.held_policy is None:
            return self._model.act_global(latents)
        held = self._model.held_policy(latents)
        if self._turn == 0:
            return held
        first = (self._steps - 1) // self._turn % 2 == 0
        return torch.where(first[:, None], held, self._model.act_global(latents))

    @staticmethod
    def _held(latents: Tensor, actions: Tensor, step: Step, count: int) -> Tensor:
        """Where `count` steps of each of `actions` [B, S, A] lead from latents [B, D]: [B, S, D]."""
        ends = latents.unsqueeze(1).expand(-1, actions.shape[1], -1)
        for _ in range(count):
            ends = step(ends, actions)
        return ends

    def _replan(self, latents: Tensor, due: Tensor) -> None:
        """Plan for the rows `due` [B] from `latents` [B, D] and store their waypoints."""
        self.last_plan_ms[:] = np.nan
        self.planned_rows = np.flatnonzero(due.cpu().numpy())
        if len(self.planned_rows) == 0:
            return
        own = {int(row): fns for row in self.planned_rows if (fns := self._own_fns(int(row))) is not None}
        plain = np.array([row for row in self.planned_rows if int(row) not in own], np.int64)
        if len(plain):
            self._plan(self._fns, plain, latents)
        for row, fns in own.items():
            self._plan(fns, np.array([row]), latents)

    def _own_fns(self, row: int) -> SearchFns | None:
        """The model as the row's episode corrects it, where it does."""
        fns = self._fns
        if self._residuals is not None and (step := self._residuals.of_row(row)) is not None:
            fns = fns._replace(step=step, rollout=None)
        if self._revisits is not None and (value := self._revisits.of_row(row, fns.value)) is not None:
            fns = fns._replace(value=value)
        return None if fns is self._fns else fns

    def _plan(self, fns: SearchFns, planned: NDArray[np.int64], latents: Tensor) -> None:
        """Plan for the rows `planned` [P] from `latents` [B, D] together."""
        rows = torch.from_numpy(planned).to(self._device)
        start = time.perf_counter()
        generators = [self._generators[row] for row in planned]
        result = plan(fns, latents[rows], self._planner, generators)
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.last_plan_ms[planned] = (time.perf_counter() - start) * 1e3 / len(planned)
        self.last_plan, self.last_plan_rows = result, planned
        self._store(rows, result.waypoints, result.length)

    def _store(self, rows: Tensor, waypoints: Tensor, length: Tensor) -> None:
        """Put waypoints [P, L', D] of `rows` [P] into the held [B, L, D], widening L where needed."""
        width = max(waypoints.shape[1], self._waypoints.shape[1])
        if self._waypoints.shape[1:] != (width, waypoints.shape[2]):
            held = self._waypoints.new_zeros(len(self._length), width, waypoints.shape[2])
            held[:, : self._waypoints.shape[1], : self._waypoints.shape[2]] = self._waypoints
            self._waypoints = held
        self._waypoints[rows, : waypoints.shape[1]] = waypoints.to(self._waypoints.dtype)
        self._length[rows] = length
        self._current[rows] = (length - 1).clamp(max=1)
        self._plan_age[rows] = 0

    def _advance(self, latents: Tensor) -> None:
        """`update_waypoint` of Algorithm 2: on to the next one while Q_min(z_curr, z_wp) > τ_wp; the last one stays."""
        rows = torch.nonzero(self._current < self._length - 1).flatten()
        while len(rows):
            q_min, _ = self._fns.reach(latents[rows], self._waypoints[rows, self._current[rows]])
            rows = rows[q_min > self._reached_value]
            self._current[rows] += 1
            rows = rows[self._current[rows] < self._length[rows] - 1]
        if self._shortcut_value is not None:
            self._cut_short(latents, self._shortcut_value)

    def _cut_short(self, latents: Tensor, threshold: float) -> None:
        """On to the farthest waypoint ahead with Q_min(z_curr, z_wp) > threshold, where there is one (ours)."""
        number = torch.arange(self._waypoints.shape[1], device=latents.device)
        ahead = (number > self._current.unsqueeze(1)) & (number < self._length.unsqueeze(1))
        row, waypoint = ahead.nonzero(as_tuple=True)
        if len(row) == 0:
            return
        q_min, _ = self._fns.reach(latents[row], self._waypoints[row, waypoint])
        near = q_min > threshold
        self._current.scatter_reduce_(0, row[near], waypoint[near], "amax")

    def waypoints_ahead(self, row: int) -> Tensor:
        """[L', D] waypoints of `row` that are still ahead, the current one first; empty before the first plan."""
        if self._length[row] == 0:
            return self._waypoints.new_zeros(0, self._waypoints.shape[2])
        return self._waypoints[row, self._current[row] : self._length[row]].clone()
