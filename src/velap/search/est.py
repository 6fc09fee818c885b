"""Value-guided expansive latent trees: Algorithm 1 and the choice of the path (Eq. 8)."""

from __future__ import annotations

import torch
from torch import Tensor

from velap.config import PlannerConfig
from velap.search.expansion import expand_, thresholds
from velap.search.sampling import draw_noise
from velap.search.tree import head, new_tree, take, trace_back
from velap.search.types import Outcome, Plan, Rejections, RowGenerator, SearchFns, Tree


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
    tree = new_tree(z_root, fns.value(z_root), cfg.n_iter + 1)
    outcomes = []
    for start in range(0, cfg.n_iter, cfg.candidates):
        stop = min(start + cfg.candidates, cfg.n_iter)
        outcomes.append(expand_(tree, fns, cfg, noise.part(start, stop), slots=start + 1))
    tree = head(tree, cfg.n_iter + 1)
    leaf, reached = choose_leaf(tree, thresholds(cfg, fns.discount).goal)
    nodes, length = trace_back(tree.parents, leaf, depth=len(outcomes))
    return Plan(
        waypoints=take(tree.latents, nodes),
        length=length,
        cost=tree.root_steps.gather(1, leaf.unsqueeze(1)).squeeze(1),
        reached_goal=reached,
        nodes=nodes,
        tree=tree,
        rejections=_count_rejections(torch.cat(outcomes, 1)),
    )


def choose_leaf(tree: Tree, goal_threshold: float) -> tuple[Tensor, Tensor]:
    """End of g* (Eq. 8): the goal node nearest to the root, or where there is none the node of highest Q^g.

    Returns:
        slots [B] int64, and whether [B] a goal node was found (Q^g > goal_threshold).
    """
    is_goal = tree.goal_values > goal_threshold
    nearest = tree.root_steps.masked_fill(~is_goal, torch.inf).argmin(1)
    reached = is_goal.any(1)
    return torch.where(reached, nearest, tree.goal_values.argmax(1)), reached


def _count_rejections(outcomes: Tensor) -> Rejections:
    """Outcomes [B, n_iter] → counts [B]."""
    return Rejections(**{field: (outcomes == Outcome[field.upper()]).sum(1) for field in Rejections._fields})
