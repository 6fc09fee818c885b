"""Value-guided expansive latent trees: Algorithm 1, and the choice of the path (Eq. 8).

Several trees grow at once, K candidates each a round. Shapes are fixed and nothing is read back, with one exception: see
`velap.search.simulation.packs`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.models.horizon import q_from_steps, steps_from_q
from velap.registry import register_planner
from velap.search.neighbours import candidate_neighbours, first_come, gained_neighbours, incoming_q
from velap.search.sampling import Noise, draw_noise, node_distribution, sample_nodes
from velap.search.simulation import anchored, packs, simulate, snaps, value_where
from velap.search.tree import Candidates, free_slots, insert_, new_tree, take, trace_back, trimmed
from velap.search.types import Plan, Rejections, RowGenerator, SearchFns, Tree
from velap.threads import one_thread

ROWS_A_THREAD = 256
"""Candidates of a round, over all environments, up to which one thread plans. ours: 67 → 52 ms for one environment."""


@register_planner("est")
@torch.inference_mode()
def plan(fns: SearchFns, z_root: Tensor, cfg: PlannerConfig, generator: RowGenerator) -> Plan:
    """Algorithm 1 from every root, K candidates a round, and the choice of a path in its tree (Eq. 8).

    Args:
        fns: the model.
        z_root: [B, D] latents to plan from.
        cfg: n_iter, thresholds and mixtures of Algorithm 1.
        generator: one for all rows, or one a row; on any device.
    """
    if z_root.ndim != 2:
        raise ValueError(f"z_root has shape {tuple(z_root.shape)}; expected [B, D], one root a row.")
    noise = draw_noise(cfg, fns.noise_dim, z_root, generator)
    limits = thresholds(cfg, fns.discount, z_root)
    verdicts = []
    with one_thread(z_root.device, len(z_root) * cfg.candidates <= ROWS_A_THREAD):
        tree = new_tree(z_root, fns.value(z_root), cfg.n_iter + 1)  # Alg. 1, l. 2
        for start in range(0, cfg.n_iter, cfg.candidates):  # l. 3
            part = noise.part(start, start + cfg.candidates)
            slots = int(tree.size.max()) if packs(z_root) else start + 1
            verdicts.append(expand_(tree, fns, cfg, limits, part, slots))  # l. 4-18
    tree = trimmed(tree)
    leaf, reached = choose_leaf(tree, limits.goal)  # Eq. 8
    nodes, length = trace_back(tree.parents, leaf, depth=len(verdicts))
    return Plan(
        waypoints=take(tree.latents, nodes),
        length=length,
        cost=tree.root_steps.gather(1, leaf.unsqueeze(1)).squeeze(1),
        reached_goal=reached,
        nodes=nodes,
        tree=tree,
        rejections=count_rejections(verdicts, limits),
    )


def expand_(tree: Tree, fns: SearchFns, cfg: PlannerConfig, limits: Thresholds, noise: Noise, slots: int) -> Verdict:
    """One round of K candidates a tree, in place, on growing trees of which at most the first `slots` slots are in use.

    Batch processing of App. B.6: the candidates are simulated side by side and enter in the order of their numbers, so that
    one that is too close to an earlier candidate of the round is rejected by it, as it would be one round later.
    """
    used = torch.arange(slots, device=tree.size.device) < tree.size.unsqueeze(1)

    # Alg. 1, l. 4: sample z_exp from V given P_node.
    crowding = crowding_of(tree, slots, fns, cfg)
    distribution = node_distribution(crowding, tree.goal_values[:, :slots], used, cfg)  # Eq. 6, 7
    parents = sample_nodes(distribution, noise.node, tree.size)
    tree.expansions.scatter_add_(1, parents, torch.ones_like(parents))
    z_exp = take(tree.latents, parents)

    z_new, supported = anchored(fns, simulate(fns, z_exp, noise, cfg), cfg)  # l. 5-10, and anchors (ours)

    # l. 13: near enough to the node it was expanded from, and certain. That node is in V, so l. 14 holds for it as well.
    q_edge, std_edge = fns.reach(z_exp, z_new)
    feasible = (q_edge > limits.low) & (q_edge < limits.high) & (std_edge < limits.std) & supported

    # l. 14: no node of V is too close, of those within d_neigh (B.6); the nodes of V first, then the earlier candidates.
    near = candidate_neighbours(tree.latents[:, :slots], used, z_new, fns.d_neigh)
    q_in = incoming_q(fns, near, z_new, feasible, parents, q_edge)
    too_close = ~(q_in < limits.high)
    count = z_new.shape[1]
    novel = feasible & ~too_close[:, :, :-count].any(-1)
    target = free_slots(tree, first_come(novel, too_close[:, :, -count:]))
    accepted = target < tree.parents.shape[1] - 1

    # l. 16: V and E grow, with what the next rounds ask of a node: n^neigh (Eq. 6), Q^g (Eq. 7) and c of its path (Eq. 8).
    gained = gained_neighbours(fns, near, z_new, accepted, q_in, limits.neighbour)
    tree.neighbour_counts[:, :slots].add_(gained[:, :slots])
    root_steps = tree.root_steps.gather(1, parents) + steps_from_q(q_edge, fns.discount)
    values = value_where(fns, z_new, accepted)
    insert_(tree, Candidates(z_new, parents, values, root_steps, gained[:, slots:]), target)
    return Verdict(accepted, supported, q_edge, std_edge)


def crowding_of(tree: Tree, slots: int, fns: SearchFns, cfg: PlannerConfig) -> Tensor:
    """n^neigh of Eq. 6 for the first slots [B, slots]. Where candidates snap, expansions made from a node count as well
    (ours): they come to the few latents around it, and most are refused."""
    counts = tree.neighbour_counts[:, :slots]
    return counts + tree.expansions[:, :slots] if snaps(fns, cfg) else counts


def choose_leaf(tree: Tree, goal_threshold: Tensor | float) -> tuple[Tensor, Tensor]:
    """End of g* (Eq. 8): the goal node nearest to the root, or where there is none the node of highest Q^g.

    Returns:
        slots [B] int64, and whether [B] a goal node was found (Q^g > goal_threshold).
    """
    is_goal = tree.goal_values > goal_threshold  # the ends of the paths in G
    nearest = tree.root_steps.masked_fill(~is_goal, torch.inf).argmin(1)  # argmin over G of c(g), the root steps of its end
    reached = is_goal.any(1)
    return torch.where(reached, nearest, tree.goal_values.argmax(1)), reached


class Thresholds(NamedTuple):
    """Table 8 for one model: scalars [] [Q-value]."""

    high: Tensor
    low: Tensor
    std: Tensor
    neighbour: Tensor
    goal: Tensor


def thresholds(cfg: PlannerConfig, discount: float, like: Tensor) -> Thresholds:
    """τ of Table 8 for γ = discount, in the dtype and on the device of `like`."""
    low = cfg.n_sim if cfg.discard_low_exponent is None else cfg.discard_low_exponent
    values = (
        q_from_steps(cfg.discard_high_exponent, discount),
        q_from_steps(low, discount),
        1 - discount,
        q_from_steps(cfg.neighbour_exponent, discount),
        q_from_steps(cfg.goal_exponent, discount),
    )
    return Thresholds(*(like.new_full((), value) for value in values))


class Verdict(NamedTuple):
    """What decided about the candidates of a round."""

    accepted: Tensor
    """[B, K] bool."""
    supported: Tensor
    """[B, K] bool, near enough to the dataset's latents (ours)."""
    q_edge: Tensor
    """[B, K] Q_min^{exp,new} [Q-value]."""
    std_edge: Tensor
    """[B, K] Q_std^{exp,new} [Q-value]."""


def count_rejections(verdicts: Sequence[Verdict], limits: Thresholds) -> Rejections:
    """Rejected candidates of all rounds by the first reason that holds, in the order of `Rejections`."""
    accepted, supported, q_edge, std_edge = (torch.cat(parts, 1) for parts in zip(*verdicts, strict=True))
    above_low, certain = q_edge > limits.low, std_edge < limits.std
    return Rejections(
        unsupported=(~supported).sum(1),
        low=(supported & ~above_low).sum(1),
        std=(supported & above_low & ~certain).sum(1),
        high=(supported & above_low & certain & ~accepted).sum(1),
    )
