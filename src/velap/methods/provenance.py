"""VELAP with provenance: the search leads, and every edge is walked by what proposed it (ours).

The controller is Algorithm 2 with one difference: an edge of a policy is walked by that policy, for n_sim steps or until its
waypoint is reached. A promise that does not come true ends the plan at once. Nothing else leads: no leaders, no corrections.

B environments, N stacked frames, L waypoints of the longest plan held, D latent, A action dimension.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.config import Config
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.methods.base import Agent, Method, Parts, masked_seeds
from velap.methods.lookahead import local_policy_of
from velap.methods.states import StateEncoder
from velap.methods.waypoints import Plans
from velap.models.horizon import q_from_steps, steps_from_q
from velap.models.velap import LatentModel
from velap.registry import register_method
from velap.search.provenance import Provenance, plan
from velap.search.risk import measured_risk

PATIENCE = 2
"""An edge of g is broken when it is not walked after this many times n_sim steps. ours."""
CONTROLLER = ControllerConfig(n_replan=15, lookahead=3, lookahead_gain=2.0)
"""The controller for every task: Table 9, and the lookahead of edges of g."""


def planner_config(config: Config) -> PlannerConfig:
    """The search for every task; n_iter, n_sim and the anchor are the checkpoint's, as Table 8 varies them by task."""
    own = config.planner
    return replace(PlannerConfig(), n_iter=max(own.n_iter, 500), n_sim=own.n_sim, anchor=own.anchor, candidates=10,
                   discard_low_exponent=20.0, p_sparse=0.9, p_value=0.1, expansion_weight=1.0)


class ProvenanceAgent:
    """Plans when a plan is used up, broken or `n_replan` steps old, and hands over to π^g near the goal."""

    def __init__(self, model: LatentModel, config: Config, missed: float, cost: float) -> None:
        self.method = "velap-provenance"
        self.frame_stack = config.model.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self.last_plan: Provenance | None = None
        """The plans of the last `act` that planned."""
        self.last_plan_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows of `last_plan`."""
        self._states, self._fns = StateEncoder(model), model.search_fns()
        self._search = planner_config(config)
        self._local_policy = local_policy_of(CONTROLLER, model)
        cloned = self._fns.act_success
        self.policies = (self._fns.act_global, *([] if cloned is None else [cloned]))
        """What proposes besides g: π^g, and the policy cloned from successes where the model has one."""
        states = model.bank_latents[model.bank_rows >= 0].float()
        with torch.inference_mode():
            self._risk = measured_risk(self._fns, self.policies, states, missed)
        print("risk", self._risk)
        self._stop_value = q_from_steps(CONTROLLER.stop_exponent, self._fns.discount)
        self._reached_value = q_from_steps(CONTROLLER.waypoint_exponent, self._fns.discount)
        self._device = next(model.parameters()).device
        self._generators: list[torch.Generator] = []
        self._allocate(0)

    def _allocate(self, batch: int) -> None:
        self.plans = Plans(batch, self._device)
        """What the rows follow."""
        self._proposers = torch.zeros(batch, 1, dtype=torch.int64, device=self._device)
        self._promised = torch.zeros(batch, 1, device=self._device)
        self._age = torch.full((batch,), CONTROLLER.n_replan, device=self._device)
        self._spent = torch.zeros(batch, dtype=torch.int64, device=self._device)
        self._begun = torch.zeros(batch, device=self._device)
        self._values, self._near_goal = torch.zeros(batch), torch.zeros(batch, dtype=torch.bool)
        self._walking = torch.zeros(batch, dtype=torch.bool)

    @torch.inference_mode()
    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the plans where `mask` [B] is set and seed those rows anew."""
        if len(self._generators) != len(mask):
            self._generators = [torch.Generator().manual_seed(row) for row in range(len(mask))]
            self._allocate(len(mask))
            self.last_plan_ms = np.full(len(mask), np.nan)
        for row, seed in masked_seeds(mask, seeds):
            self._generators[row].manual_seed(seed)
        self._states.forget(mask)
        started = torch.from_numpy(mask).to(self._device)
        self.plans.forget(started)
        self._age[started] = CONTROLLER.n_replan

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """One step: frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        z = self._states(frames)
        self._values = self._fns.value(z)
        self._near_goal = self._values > self._stop_value
        to_go = steps_from_q(self._values.clamp(min=1e-6), self._fns.discount).float()
        self._spent += 1
        self._advance(z, to_go)
        over = (self.plans.length > 1) & (self.plans.current >= self.plans.length)
        self._replan(z, to_go, ((self._age >= CONTROLLER.n_replan) | over) & ~self._near_goal)
        self._age += 1
        self._walking = ~self._near_goal & (self.plans.length > 1) & (self.plans.current < self.plans.length)
        return self._states.act(self._actions(z))

    def _actions(self, z: Tensor) -> Tensor:
        """Actions [B, A]: of the proposer of each row's edge; of π^g near the goal and where the tree is its root alone."""
        actions = self._fns.act_global(z)
        rows = torch.nonzero(self._walking).flatten()
        who = self._proposers[rows, self.plans.current[rows]]
        for number, policy in enumerate(self.policies, 1):
            mine = rows[who == number]
            actions = actions.index_copy(0, mine, policy(z[mine]))
        mine = rows[who == 0]
        if len(mine):
            generators = [self._generators[row] for row in mine.tolist()]
            local = self._local_policy(self._fns, z[mine], self.plans.targets(mine), generators)
            actions = actions.index_copy(0, mine, local.to(actions))
        return actions

    def _advance(self, z: Tensor, to_go: Tensor) -> None:
        """On to the next edge where one is walked; a plan whose promise did not come true is used up.

        Args:
            z: [B, D] latents.
            to_go: [B] log_γ Q^g of them [steps].
        """
        plans, n_sim = self.plans, self._search.n_sim
        rows = torch.nonzero((plans.length > 1) & (plans.current < plans.length)).flatten()
        while len(rows):
            at = plans.current[rows]
            arrived = self._fns.reach(z[rows], plans.targets(rows))[0] > self._reached_value
            by_policy = self._proposers[rows, at] > 0
            walked = ~arrived & by_policy & (self._spent[rows] >= n_sim)
            promised = self._promised[rows, at - 1] - self._promised[rows, at]
            behind = to_go[rows] - self._promised[rows, at]
            broken = walked & (self._begun[rows] - to_go[rows] < 0.5 * promised) & (behind > 0.5 * n_sim)
            broken |= ~arrived & ~by_policy & (self._spent[rows] >= PATIENCE * n_sim)
            onward = rows[(arrived | walked) & ~broken]
            plans.current[onward] += 1
            self._spent[onward], self._begun[onward] = 0, to_go[onward]
            plans.current[rows[broken]] = plans.length[rows[broken]]
            rows = onward[plans.current[onward] < plans.length[onward]]

    def _replan(self, z: Tensor, to_go: Tensor, due: Tensor) -> None:
        """Plan for the rows `due` bool [B] from z [B, D]."""
        self.last_plan_ms[:] = np.nan
        planned = np.flatnonzero(due.cpu().numpy())
        if len(planned) == 0:
            return
        rows = torch.from_numpy(planned).to(self._device)
        start = time.perf_counter()
        found = plan(self._fns, z[rows], self._search, [self._generators[row] for row in planned], policies=self.policies,
                     risk=self._risk)
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.last_plan_ms[planned] = (time.perf_counter() - start) * 1e3 / len(planned)
        self.last_plan, self.last_plan_rows = found, planned
        self.follow(rows, found, to_go[rows])

    @torch.inference_mode()
    def follow(self, rows: Tensor, found: Provenance, to_go: Tensor) -> None:
        """From now on `rows` int64 [P] follow the plans `found` from states with log_γ Q^g `to_go` [P] [steps]."""
        self.plans.store(rows, found.waypoints, found.length)
        self._proposers = _widened(self._proposers, self.plans.waypoints.shape[1])
        self._promised = _widened(self._promised, self.plans.waypoints.shape[1])
        width = found.proposers.shape[1]
        self._proposers[rows, :width] = found.proposers
        self._promised[rows, :width] = found.steps_to_goal.float()
        self._age[rows], self._spent[rows], self._begun[rows] = 0, 0, to_go

    @property
    def last_values(self) -> NDArray[np.float32]:
        """[B] Q^g of the last states [Q-value]."""
        return self._values.float().cpu().numpy()

    @property
    def near_goal(self) -> NDArray[np.bool_]:
        """[B] rows that π^g led in the last `act` because the goal was near."""
        return self._near_goal.cpu().numpy()

    @property
    def by_plan(self) -> NDArray[np.bool_]:
        """[B] rows whose last action followed an edge of their tree."""
        return self._walking.cpu().numpy()


def _widened(held: Tensor, width: int) -> Tensor:
    """[B, L] with zeros behind it up to `width`."""
    return torch.nn.functional.pad(held, (0, max(width - held.shape[1], 0)))


@dataclass(frozen=True)
class ProvenanceSettings:
    """What the search trusts."""

    missed: float = 0.2
    cost: float = 150.0


@register_method("velap-provenance")
class VelapProvenance(Method):
    """The search leads, and every edge is walked by what proposed it."""

    label = "VELAP, provenance"
    settings = ProvenanceSettings()
    whole_checkpoint = True

    def agent(self, parts: Parts) -> Agent:
        """The loop around the search with provenance."""
        return ProvenanceAgent(parts.model, parts.config, parts.settings.missed, parts.settings.cost)

    def legacy_hash(self, config: Config, head: Any = None, settings: Any = None) -> str | None:
        """None: velap 0.1 had no such method."""
        return None
