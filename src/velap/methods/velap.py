"""VELAP: Algorithm 2 with the settings of Table 9 (App. B.7), vectorised over environments.

The lines of Algorithm 2 are numbered from its "Given". What is ours is plugged in: corrections of the model
(`velap.methods.corrections`), leaders and what acts in place of π^g (`leaders`), lookahead in place of π^l alone
(`lookahead`), and rules beside `update_waypoint` (`waypoints`).

B environments, N stacked frames, P rows that plan in one call, D latent dimensions, A action dimension.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.config.migrate_v1 import legacy_hash
from velap.methods.base import Agent, Learnt, Method, Parts, masked_seeds
from velap.methods.corrections import corrections_of
from velap.methods.leaders import global_policy_of, leaders_of
from velap.methods.lookahead import local_policy_of
from velap.methods.states import StateEncoder
from velap.methods.waypoints import Plans, Rule, in_order, shortcut
from velap.models.horizon import q_from_steps
from velap.registry import PLANNERS, register_method
from velap.search.est import plan
from velap.search.types import Path, Planner, SearchFns

if TYPE_CHECKING:
    from velap.config import Config
    from velap.config.planning import ControllerConfig
    from velap.models.velap import LatentModel


class VelapAgent:
    """Plans every `n_replan` steps of a row, follows the waypoints by π^l, and hands over to π^g near the goal.

    Rows replan at their own times; those due at one step plan as one batch. A row draws from its own generator, and only
    for what it does itself, so that the other rows reach it through the rounding of batched arithmetic only.
    """

    method = "velap"

    def __init__(self, model: LatentModel, config: Config, planner: Planner = plan) -> None:
        self.frame_stack = config.model.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self.last_plan: Path | None = None
        """A plan of the last `act` that planned, kept for figures and videos."""
        self.last_plan_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows of `last_plan`. Rows whose model their episode corrects plan alone."""
        self.planned_rows: NDArray[np.int64] = np.empty(0, np.int64)
        """Rows that planned in the last `act`."""
        self._model, self._states = model, StateEncoder(model)
        self._fns = model.search_fns()
        self._search, self._planner, self._n_replan = planner, config.planner, config.controller.n_replan
        self._stop_value = q_from_steps(config.controller.stop_exponent, self._fns.discount)
        self._update_waypoint = waypoint_rules(config.controller, self._fns.discount)
        self._local_policy = local_policy_of(config.controller, model)
        self._global_policy = global_policy_of(config, model, self._fns)
        self._leaders = leaders_of(config, self._fns)
        self._corrections = corrections_of(config.controller, self._fns)
        self._device = next(model.parameters()).device
        self._generators: list[torch.Generator] = []
        self._age = torch.empty(0, dtype=torch.long)
        """[B] steps since each row planned, n_replan where it has to [steps]."""
        self.plans = Plans(0, self._device)
        """What the rows follow."""
        self._latents = torch.empty(0, 0)
        self._values, self._near_goal = torch.empty(0), torch.empty(0, dtype=torch.bool)
        self._led = torch.empty(0, dtype=torch.bool)

    @torch.inference_mode()
    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the plans where `mask` [B] is set and seed those rows anew."""
        if len(self._generators) != len(mask):
            self._generators = [torch.Generator().manual_seed(row) for row in range(len(mask))]
            self._age = torch.full((len(mask),), self._n_replan, device=self._device)
            self.plans = Plans(len(mask), self._device)
            self.last_plan_ms = np.full(len(mask), np.nan)
        for row, seed in masked_seeds(mask, seeds):
            self._generators[row].manual_seed(seed)
        self._states.forget(mask)
        started = torch.from_numpy(mask).to(self._device)
        self._age[started] = self._n_replan
        self.plans.forget(started)
        self._global_policy.forget(started)
        for correction in self._corrections:
            correction.forget(started)

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        """One step of Algorithm 2: frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames)
        if len(frames) != len(self._generators):
            self.reset(np.ones(len(frames), bool))
        self._latents = z = self._states(frames)  # Alg. 2, l. 2 and 12
        self._values = self._corrected(torch.arange(len(z), device=self._device)).value(z)
        for correction in self._corrections:
            correction.observe(z)
        self._near_goal = self._values > self._stop_value  # l. 4: "goal not achieved", by B.7's proximity
        led, leading = self._lead(z)
        self._replan(z, (self._age >= self._n_replan) & ~self._near_goal & ~led)  # l. 5-8
        self._age += 1  # l. 13
        for update_waypoint in self._update_waypoint:
            update_waypoint(self.plans, self._fns, z)  # l. 9
        actions = self._global_policy(z)  # l. 10, in proximity to the goal, or where a plan of the root alone leads nowhere
        rows = torch.nonzero(~self._near_goal & (self.plans.length > 1)).flatten()
        if len(rows):
            generators = [self._generators[row] for row in rows.tolist()]
            local = self._local_policy(self._corrected(rows), z[rows], self.plans.targets(rows), generators)  # l. 10
            actions = actions.index_copy(0, rows, local.to(actions))
        if leading is not None:
            actions = torch.where(led[:, None], leading, actions)
        for correction in self._corrections:
            correction.acted(z, actions)
        return self._states.act(actions)  # l. 11

    def _lead(self, z: Tensor) -> tuple[Tensor, Tensor | None]:
        """Rows [B] bool that a leader leads, and its actions [B, A]: those of the first leader that has a row."""
        led, actions = torch.zeros_like(self._near_goal), None
        for leader in self._leaders:
            leads, offered = leader.lead(z, self._near_goal)
            actions = offered if actions is None else torch.where(led[:, None], actions, offered)
            led = led | leads
        self._led = led
        return led, actions

    def _corrected(self, rows: Tensor) -> SearchFns:
        """The model as each of `rows` int64 [P] corrects it, for queries of its own."""
        fns = self._fns
        for correction in self._corrections:
            fns = correction.in_rows(fns, rows)
        return fns

    def _replan(self, z: Tensor, due: Tensor) -> None:
        """Plan for the rows `due` bool [B] from z [B, D] and store their waypoints."""
        self.last_plan_ms[:] = np.nan
        self.planned_rows = np.flatnonzero(due.cpu().numpy())
        alone: dict[int, SearchFns] = {}
        for row in self.planned_rows.tolist():
            fns = self._fns
            for correction in self._corrections:
                fns = correction.in_row(fns, row)
            if fns is not self._fns:
                alone[row] = fns
        together = np.array([row for row in self.planned_rows if row not in alone], np.int64)
        if len(together):
            self._plan(self._fns, together, z)
        for row, fns in alone.items():
            self._plan(fns, np.array([row]), z)

    def _plan(self, fns: SearchFns, planned: NDArray[np.int64], z: Tensor) -> None:
        """Plan for the rows `planned` [P] from z [B, D] together."""
        rows = torch.from_numpy(planned).to(self._device)
        start = time.perf_counter()
        found = self._search(fns, z[rows], self._planner, [self._generators[row] for row in planned])  # l. 6-7
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        self.last_plan_ms[planned] = (time.perf_counter() - start) * 1e3 / len(planned)
        self.last_plan, self.last_plan_rows = found, planned
        self.plans.store(rows, found.waypoints, found.length)
        self._age[rows] = 0

    @property
    def last_latents(self) -> NDArray[np.float32]:
        """[B, D] the last states."""
        return self._latents.float().cpu().numpy()

    @property
    def last_values(self) -> NDArray[np.float32]:
        """[B] Q^g of the last states, less what corrections take off [Q-value]."""
        return self._values.float().cpu().numpy()

    @property
    def near_goal(self) -> NDArray[np.bool_]:
        """[B] rows where Algorithm 2 left the last action to π^g because the goal was near."""
        return self._near_goal.cpu().numpy()

    @property
    def led(self) -> NDArray[np.bool_]:
        """[B] rows that a leader led in the last `act`."""
        return self._led.cpu().numpy()

    @property
    def by_plan(self) -> NDArray[np.bool_]:
        """[B] rows whose last action followed an edge of their tree: π^l was on its way to a waypoint."""
        return (~self._near_goal & ~self._led & (self.plans.length > 1)).cpu().numpy()

    @property
    def global_policy(self) -> str:
        """What acts in place of π^g, in words."""
        return self._global_policy.name


def waypoint_rules(config: ControllerConfig, discount: float) -> list[Rule]:
    """`update_waypoint` of B.7, and what a config wants beside it."""
    rules = [in_order(q_from_steps(config.waypoint_exponent, discount))]
    if config.shortcut_exponent > 0:
        rules.append(shortcut(q_from_steps(config.shortcut_exponent, discount)))
    return rules


@dataclass(frozen=True)
class VelapSettings:
    """What is chosen beside the checkpoint's `planner` and `controller`."""

    planner: str = "est"
    """Registered planner."""


@register_method("velap")
class Velap(Method):
    """Algorithms 1 and 2."""

    label = "VELAP"
    settings = VelapSettings()
    whole_checkpoint = True

    def agent(self, parts: Parts) -> Agent:
        """The MPC loop around the chosen planner."""
        return VelapAgent(parts.model, parts.config, PLANNERS[parts.settings.planner])

    def config_hash(self, config: Config, head: Learnt | None = None, settings: Any = None) -> str:
        """The config's own hash; with another planner, of that as well."""
        own = settings in (None, self.settings)
        return config.hash() if own else super().config_hash(config, head, settings)

    def legacy_hash(self, config: Config, head: Learnt | None = None, settings: Any = None) -> str | None:
        """The hash that velap 0.1 gave the config."""
        return legacy_hash(config)
