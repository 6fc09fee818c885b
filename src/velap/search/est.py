"""Value-guided expansive latent trees: Algorithm 1 and the choice of the path (Eq. 8)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.registry import register_planner
from velap.search.expansion import Thresholds, Verdict, expand_, packs, thresholds
from velap.search.sampling import draw_noise
from velap.search.tree import new_tree, take, trace_back, trimmed
from velap.search.types import Plan, Rejections, RowGenerator, SearchFns, Tree
from velap.threads import one_thread

ROWS_A_THREAD = 256
"""Candidates of a round, over all environments, up to which one thread plans. ours: 67 → 52 ms for one environment."""


@register_planner("est")
@torch.inference_mode()
def plan(fns: SearchFns, z_root: Tensor, cfg: PlannerConfig, generator: RowGenerator) -> Plan:
    """Grow a tree of n_iter expansions from every root and choose a path in it.

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
        tree = new_tree(z_root, fns.value(z_root), cfg.n_iter + 1)
        for start in range(0, cfg.n_iter, cfg.candidates):
            part = noise.part(start, start + cfg.candidates)
            slots = int(tree.size.max()) if packs(z_root) else start + 1
            verdicts.append(expand_(tree, fns, cfg, limits, part, slots))
    tree = trimmed(tree)
    leaf, reached = choose_leaf(tree, limits.goal)
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


def choose_leaf(tree: Tree, goal_threshold: Tensor | float) -> tuple[Tensor, Tensor]:
    """End of g* (Eq. 8): the goal node nearest to the root, or where there is none the node of highest Q^g.

    Returns:
        slots [B] int64, and whether [B] a goal node was found (Q^g > goal_threshold).
    """
    is_goal = tree.goal_values > goal_threshold
    nearest = tree.root_steps.masked_fill(~is_goal, torch.inf).argmin(1)
    reached = is_goal.any(1)
    return torch.where(reached, nearest, tree.goal_values.argmax(1)), reached


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
