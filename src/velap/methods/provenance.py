"""VELAP with edges that remember their proposers: the search leads, and every edge is walked by what proposed it (ours).

The controller is Algorithm 2 with one difference: an edge of a policy is walked by that policy, for n_sim steps or until its
waypoint is reached. A promise that does not come true ends the plan at once.

B environments, N stacked frames, L waypoints of the longest plan held, D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.config.planning import has_provenance
from velap.methods.base import State
from velap.methods.tree_agent import Actor, TreeAgent
from velap.models.horizon import steps_from_q
from velap.search import est, provenance
from velap.search.provenance import Policy, Provenance
from velap.search.types import Path, Plan, RowGenerator, SearchFns

if TYPE_CHECKING:
    from velap.config import Config
    from velap.models.velap import LatentModel

PATIENCE = 2
"""An edge of g is broken when it is not walked after this many times n_sim steps. ours."""


class Proposer(NamedTuple):
    """A policy that proposes edges and walks them."""

    actor: Actor
    policy: Policy


def proposers_of(fns: SearchFns) -> tuple[Proposer, ...]:
    """What proposes besides g: π^g, or the policy cloned from successes, whichever gets to the goal more often by h; both
    where h cannot tell."""
    learnt = Proposer(Actor.POLICY, fns.act_global)
    if fns.act_success is None:
        return (learnt,)
    cloned, (by_learnt, by_clone) = Proposer(Actor.CLONE, fns.act_success), fns.arrival_rates
    if by_learnt == by_clone:
        return learnt, cloned
    return (learnt,) if by_learnt > by_clone else (cloned,)


def search_of(model: LatentModel, config: Config, fns: SearchFns | None = None) -> Callable[[Tensor, RowGenerator], Plan]:
    """The search that a config asks for: latents [P, D] and a generator a row → plans. `fns`: those of the model."""
    fns = model.search_fns() if fns is None else fns
    if not has_provenance(config.planner, fns.success_share):
        return lambda z, generator: est.plan(fns, z, config.planner, generator)
    policies = [each.policy for each in proposers_of(fns)]
    return lambda z, generator: provenance.plan(fns, z, config.planner, generator, policies=policies)


class ProvenanceAgent(TreeAgent):
    """Plans when a plan is used up, broken or `n_replan` steps old, and hands over to π^g near the goal."""

    def __init__(self, model: LatentModel, config: Config) -> None:
        super().__init__(model, config)
        self._n_sim = config.planner.n_sim
        self._proposers_of_edges = proposers_of(self._fns)
        self._plan = search_of(model, config, self._fns)

    def _allocate(self, batch: int) -> None:
        super()._allocate(batch)
        self._proposers = torch.zeros(batch, 1, dtype=torch.int64, device=self._device)
        """[B, L] proposer of the edge into each waypoint, 0 for g."""
        self._promised = torch.zeros(batch, 1, device=self._device)
        """[B, L] log_γ Q^g of each waypoint [steps]."""
        self._spent = torch.zeros(batch, dtype=torch.int64, device=self._device)
        """[B] steps on the present edge [steps]."""
        self._begun = torch.zeros(batch, device=self._device)
        """[B] log_γ Q^g where the present edge began [steps]."""

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """One step: frames [B, N, H, W, 3] -> actions [B, A]."""
        z = self._observe(frames, state)
        self._spent += 1
        self._advance(z, steps_from_q(self._values.clamp(min=1e-6), self._fns.discount).float())
        used_up = (self.plans.length > 1) & ~self._on_edge
        self._replan(z, ((self._age >= self._n_replan) | used_up) & ~self._near_goal)
        self._age += 1
        return self._states.act(self._actions(z))

    def _search(self, z: Tensor, generators: list[torch.Generator]) -> Path:
        return self._plan(z, generators)

    @property
    def _on_edge(self) -> Tensor:
        """[B] bool, the row's plan has an edge ahead."""
        return (self.plans.length > 1) & (self.plans.current < self.plans.length)

    def _actions(self, z: Tensor) -> Tensor:
        """Actions [B, A]: of the proposer of each row's edge; of π^g near the goal and where the tree is its root alone."""
        actions = self._fns.act_global(z)
        self._actors = [Actor.GOAL if near else Actor.NOWHERE for near in self._near_goal.tolist()]
        rows = torch.nonzero(~self._near_goal & self._on_edge).flatten()
        who = self._proposers[rows, self.plans.current[rows]]
        by_g = rows[who == 0]
        if len(by_g):
            actions = actions.index_copy(0, by_g, self._towards_waypoints(z, by_g).to(actions))
        self._note(by_g, Actor.LOCAL)
        for number, (actor, policy) in enumerate(self._proposers_of_edges, 1):
            mine = rows[who == number]
            actions = actions.index_copy(0, mine, policy(z[mine]).to(actions))
            self._note(mine, actor)
        return actions

    def _note(self, rows: Tensor, actor: Actor) -> None:
        for row in rows.tolist():
            self._actors[row] = actor

    def _advance(self, z: Tensor, to_go: Tensor) -> None:
        """On to the next edge where one is walked; a plan whose promise did not come true is used up.

        Args:
            z: [B, D] latents.
            to_go: [B] log_γ Q^g of them [steps].
        """
        plans, n_sim = self.plans, self._n_sim
        rows = torch.nonzero(self._on_edge).flatten()
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

    @torch.inference_mode()
    def follow(self, rows: Tensor, found: Path) -> None:
        """From now on `rows` int64 [P] follow the paths `found`."""
        super().follow(rows, found)
        assert isinstance(found, Provenance)
        width, held = found.proposers.shape[1], self.plans.waypoints.shape[1]
        self._proposers, self._promised = _widened(self._proposers, held), _widened(self._promised, held)
        self._proposers[rows, :width] = found.proposers
        self._promised[rows, :width] = found.steps_to_goal.float()
        self._spent[rows], self._begun[rows] = 0, self._promised[rows, 0]


def _widened(held: Tensor, width: int) -> Tensor:
    """[B, L] with zeros behind it up to `width`."""
    return torch.nn.functional.pad(held, (0, max(width - held.shape[1], 0)))
