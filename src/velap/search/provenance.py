"""Algorithm 1 with edges that remember what proposed them (ours).

The tree of Algorithm 1 mixes actions of g and of π^g, and its controller walks every edge by π^l. Where h errs, a search
among thousands of sampled actions finds the errors. A policy that was learnt without h does not seek them. So every node
remembers its proposer: g, or one of the policies. An edge of a policy costs n_sim steps and is walked by that policy. An
edge of g carries a risk, which counts in the cost of a path and in the choice of its end.

B trees, N nodes, K candidates of a round, P policies, L nodes of the longest path, D latent dimension. Proposer 0 is g, and
proposer p is policy p - 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from velap.config.planning import PlannerConfig
from velap.models.horizon import steps_from_q
from velap.search.est import Thresholds, Verdict, count_rejections, crowding_of, thresholds
from velap.search.neighbours import candidate_neighbours, first_come, gained_neighbours, incoming_q
from velap.search.sampling import Noise, draw_noise, node_distribution, sample_nodes
from velap.search.simulation import anchored, simulate, value_where
from velap.search.tree import Candidates, free_slots, insert_, new_tree, take, trace_back, trimmed
from velap.search.types import Plan, RowGenerator, SearchFns

Policy = Callable[[Tensor], Tensor]
"""Latents [*, D] → actions [*, A] in [-1, 1]."""
RISK = 30.0
"""Of an edge of g [steps]. ours: twice `n_replan`. A risk measured on held-out data solved less (ADR 89)."""
TRUNK_STEPS = 150
"""Longest walk of a policy from the root before the first round [steps]. ours: the longest episode that most tasks allow."""


@dataclass(frozen=True)
class Provenance(Plan):
    """A path whose edges tell their proposer. Its `cost` counts steps and risk; candidates of the policies count among
    its `rejections`, their walks from the root do not."""

    proposers: Tensor
    """[B, L] int64 proposer of the edge into each node; 0 for the root."""
    steps_to_goal: Tensor
    """[B, L] log_γ Q^g of each node [steps]."""


class _Growing:
    """Trees that grow, and what they remember of every node besides `Tree`."""

    def __init__(self, fns: SearchFns, z_root: Tensor, cfg: PlannerConfig, policies: int) -> None:
        self.tree = new_tree(z_root, fns.value(z_root), cfg.n_iter + 1)
        slots = self.tree.parents.shape
        self.proposers = torch.zeros(slots, dtype=torch.int64, device=z_root.device)
        """[B, N + 1]."""
        self.risk = torch.zeros_like(self.tree.root_steps)
        """[B, N + 1] of all edges from the root [steps]."""
        self.expanded = torch.zeros(policies, *slots, dtype=torch.bool, device=z_root.device)
        """[P, B, N + 1] nodes from which each policy has walked: it would only walk the same way again."""
        self._discount = fns.discount

    @property
    def steps_to_goal(self) -> Tensor:
        """[B, N + 1] log_γ Q^g [steps]."""
        return steps_from_q(self.tree.goal_values.clamp(min=1e-6), self._discount)

    def insert(self, new: Candidates, accepted: Tensor, proposers: Tensor, risk: Tensor) -> Tensor:
        """Adds the accepted [B, K] of K candidates, their risk [B, K] being that of their own edge; slots [B, K]."""
        target = free_slots(self.tree, accepted)
        insert_(self.tree, new, target)
        self.proposers.scatter_(1, target, proposers)
        self.risk.scatter_(1, target, self.risk.gather(1, new.parents) + risk)
        return target


@torch.inference_mode()
def plan(fns: SearchFns, z_root: Tensor, cfg: PlannerConfig, generator: RowGenerator, *, policies: Sequence[Policy],
         risk: float = RISK) -> Provenance:
    """A tree from every root, half of whose expansions are the policies', and a path in it.

    Args:
        fns: the model.
        z_root: [B, D] latents to plan from.
        cfg: n_iter, n_sim, thresholds and mixtures of Algorithm 1; p_policy has no effect.
        generator: one for all rows, or one a row.
        policies: what proposes besides g, at least one.
        risk: of an edge of g [steps].
    """
    noise = draw_noise(cfg, fns.noise_dim, z_root, generator)
    limits = thresholds(cfg, fns.discount, z_root)
    grown = _Growing(fns, z_root, cfg, len(policies))
    edges = -(-TRUNK_STEPS // cfg.n_sim)
    for number, policy in enumerate(policies, 1):
        _walk_from_root(grown, fns, cfg, limits, policy, number, edges)
    rounds = range(0, cfg.n_iter, cfg.candidates)
    verdicts = []
    for start in rounds:
        part = noise.part(start, start + cfg.candidates)
        verdicts.append(_expand(grown, fns, cfg, limits, part, policies, risk))
    leaf, reached = _choose_leaf(grown, limits.goal)
    nodes, length = trace_back(grown.tree.parents, leaf, depth=edges + len(rounds))
    nodes = nodes[:, : int(length.max())]
    cost = (grown.tree.root_steps + grown.risk).gather(1, leaf.unsqueeze(1)).squeeze(1)
    return Provenance(waypoints=take(grown.tree.latents, nodes), length=length, cost=cost, reached_goal=reached, nodes=nodes,
                      tree=trimmed(grown.tree), rejections=count_rejections(verdicts, limits),
                      proposers=grown.proposers.gather(1, nodes), steps_to_goal=grown.steps_to_goal.gather(1, nodes))


def _walk_from_root(grown: _Growing, fns: SearchFns, cfg: PlannerConfig, limits: Thresholds, policy: Policy, number: int,
                    edges: int) -> None:
    """The policy's own walk from the root, one node every n_sim steps, until the goal is near or an edge cannot be true.

    An edge is not true where Q^l says that it stands still or is longer than its steps: h leaks through walls.
    """
    tree = grown.tree
    at = torch.zeros(len(tree.size), 1, dtype=torch.int64, device=tree.size.device)
    going = torch.ones_like(at, dtype=torch.bool)
    for _ in range(edges):
        z_exp = take(tree.latents, at)
        z_new, supported = anchored(fns, _walk(fns, z_exp, policy, cfg.n_sim), cfg)
        q_edge, _ = fns.reach(z_exp, z_new)
        going = going & supported & (q_edge > limits.low) & (q_edge < limits.high)
        if not going.any():
            return
        values = fns.value(z_new)
        grown.expanded[number - 1].scatter_(1, at, grown.expanded[number - 1].gather(1, at) | going)
        new = Candidates(z_new, at, values, tree.root_steps.gather(1, at) + cfg.n_sim, torch.zeros_like(at))
        target = grown.insert(new, going, torch.full_like(at, number), torch.zeros_like(values))
        going = going & (values < limits.goal)
        at = torch.where(going, target, at)


def _walk(fns: SearchFns, z: Tensor, policy: Policy, n_sim: int) -> Tensor:
    """Latents [*, D] after n_sim steps of a policy from z [*, D]."""
    for _ in range(n_sim):
        z = fns.step(z, policy(z))
    return z


def _expand(grown: _Growing, fns: SearchFns, cfg: PlannerConfig, limits: Thresholds, noise: Noise,
            policies: Sequence[Policy], risk: float) -> Verdict:
    """One round of K candidates: half by the policies, from the nodes that promise most, half by g as in Algorithm 1."""
    tree, discount = grown.tree, fns.discount
    count = noise.node.shape[1]
    own = count // 2
    slots = int(tree.size.max())
    used = torch.arange(slots, device=tree.size.device) < tree.size.unsqueeze(1)

    parents, proposers = _policy_parents(grown, used, own)
    share = noise.part(own, count)
    values = tree.goal_values[:, :slots] * discount ** grown.risk[:, :slots]
    crowding = crowding_of(tree, slots, fns, cfg)
    by_g = sample_nodes(node_distribution(crowding, values, used, cfg), share.node, tree.size)  # Alg. 1, l. 4
    tree.expansions.scatter_add_(1, by_g, torch.ones_like(by_g))
    z_exp = take(tree.latents, parents)
    walked = z_exp.clone()
    for number, policy in enumerate(policies, 1):
        mine = proposers == number
        walked[mine] = _walk(fns, z_exp[mine], policy, cfg.n_sim)
    by_noise = simulate(fns, take(tree.latents, by_g), share._replace(policy=torch.ones_like(share.policy)), cfg)  # l. 5-10
    z_new, supported = anchored(fns, torch.cat([walked, by_noise], 1), cfg)
    parents, proposers = torch.cat([parents, by_g], 1), torch.cat([proposers, torch.zeros_like(by_g)], 1)

    # l. 13. A policy is certain of its own way: τ_std asks g alone.
    q_edge, std_edge = fns.reach(take(tree.latents, parents), z_new)
    by_policy = proposers > 0
    feasible = (q_edge > limits.low) & (q_edge < limits.high) & supported & (by_policy | (std_edge < limits.std))
    feasible &= proposers >= 0

    # The paths of Eq. 8 in steps: an edge of a policy has n_sim of them.
    steps = torch.where(by_policy, torch.full_like(q_edge, cfg.n_sim), steps_from_q(q_edge, discount))

    # l. 14. A policy's node is too close to policies' nodes only: those of g would cut its way.
    near = candidate_neighbours(tree.latents[:, :slots], used, z_new, fns.d_neigh)
    q_in = incoming_q(fns, near, z_new, feasible, parents, q_edge)
    others = torch.cat([grown.proposers[:, :slots], proposers], 1).gather(1, near.rows.flatten(1)).view_as(near.rows)
    from_parent = near.rows == parents.unsqueeze(-1)
    too_close = ~(q_in < limits.high) & ~(by_policy.unsqueeze(-1) & (others == 0) & ~from_parent)
    novel = feasible & ~too_close[:, :, :-count].any(-1)
    accepted = first_come(novel, too_close[:, :, -count:])

    # l. 16.
    accepted &= free_slots(tree, accepted) < tree.parents.shape[1] - 1
    gained = gained_neighbours(fns, near, z_new, accepted, q_in, limits.neighbour)
    tree.neighbour_counts[:, :slots].add_(gained[:, :slots])
    new = Candidates(z_new, parents, value_where(fns, z_new, accepted), tree.root_steps.gather(1, parents) + steps,
                     gained[:, slots:])
    grown.insert(new, accepted, proposers.clamp(min=0), torch.where(by_policy, 0.0, risk).to(q_edge))
    idle = proposers < 0  # nothing was left to walk from: no candidate, which counts as no rejection
    return Verdict(accepted | idle, supported | idle, q_edge.masked_fill(idle, 1), std_edge.masked_fill(by_policy | idle, 0))


def _policy_parents(grown: _Growing, used: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Nodes [B, count] that the policies expand, those of least way so far, risk and way to go; and whose turn it is
    [B, count], -1 where a policy has walked from every node."""
    slots = used.shape[1]
    way = (grown.tree.root_steps + grown.risk + grown.steps_to_goal)[:, :slots]
    parents, proposers = [], []
    left = count
    for number in range(1, len(grown.expanded) + 1):
        mine = left // (len(grown.expanded) + 1 - number)
        left -= mine
        open_ways = way.masked_fill(~used | grown.expanded[number - 1][:, :slots], torch.inf)
        cost, nodes = open_ways.topk(min(mine, slots), largest=False)
        missing = (0, mine - cost.shape[1])  # a young tree has fewer nodes
        cost, nodes = F.pad(cost, missing, value=torch.inf), F.pad(nodes, missing)
        free = ~cost.isinf()
        sink = grown.tree.parents.shape[1] - 1
        grown.expanded[number - 1].scatter_(1, torch.where(free, nodes, sink), True)
        parents.append(nodes)
        proposers.append(torch.where(free, number, -1))
    return torch.cat(parents, 1), torch.cat(proposers, 1)


def _choose_leaf(grown: _Growing, goal_threshold: Tensor) -> tuple[Tensor, Tensor]:
    """End of the path (Eq. 8): the goal node of least steps and risk, or where there is none the node of least way to go and
    risk; the root only where it is alone. Slots [B] int64, and whether [B] a goal node was found."""
    tree = grown.tree
    used = torch.arange(tree.parents.shape[1], device=tree.size.device) < tree.size.unsqueeze(1)
    is_goal = used & (tree.goal_values > goal_threshold)
    nearest = (tree.root_steps + grown.risk).masked_fill(~is_goal, torch.inf).argmin(1)
    far = (grown.steps_to_goal + grown.risk).masked_fill(~used, torch.inf)
    far[:, 0] = torch.where(tree.size > 1, torch.inf, far[:, 0])
    reached = is_goal.any(1)
    return torch.where(reached, nearest, far.argmin(1)), reached
