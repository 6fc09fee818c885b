"""Plans are rehearsed before one is followed (ours): π^l walks every path of the tree in the model.

An expansion that leaks through a wall because h errs there once in a hundred times is found by a search of five hundred, and
every path behind it starts with that luck. The controller does not have it: it pushes against the wall. The same controller,
simulated by the same h from the root on, shows that, the more so with noise in its actions.

B environments, N nodes of a tree, L nodes of the longest path, R paths walked at once, D latent, A action dimension.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.errors import ConfigError
from velap.models.horizon import q_from_steps, steps_from_q
from velap.search.tree import take, trace_back
from velap.search.types import Plan, RowGenerator, SearchFns

SLACK = 1.5
"""A path may take this many times its length by Q^l. ours."""
SPARE = 10.0
"""And this many steps more [steps]. ours."""
LOOK_EVERY = 2
"""Simulated steps from one look at the waypoints to the next [steps]."""


@torch.inference_mode()
def rehearse(fns: SearchFns, plan: Plan, cfg: PlannerConfig, waypoint_exponent: float, generator: RowGenerator) -> Plan:
    """The plan with the path of each row that does best when π^l walks it.

    All paths are walked once; the `rehearsal_paths` best of them `rehearsals` times with noise. A walk costs its steps and
    those that Q^g sees ahead where it ends: at the path's end, or when its time is up.

    Args:
        fns: the model; `act_local` is needed.
        plan: of B roots.
        cfg: rehearsals, rehearsal_paths, rehearsal_noise.
        waypoint_exponent: a waypoint counts as reached from Q_min > γ^this on.
        generator: one for all rows, or one a row.
    """
    if fns.act_local is None:
        raise ConfigError("config field `rehearsals` asks for π^l and the model gives none; expected 0.")
    count = len(plan.length)
    generators = [generator] * count if isinstance(generator, torch.Generator) else generator
    leaves = [_best_leaf(fns, plan, row, cfg, waypoint_exponent, generators[row]) for row in range(count)]
    leaf = torch.tensor(leaves, device=plan.length.device)
    tree = plan.tree
    nodes, length = trace_back(tree.parents, leaf, depth=plan.nodes.shape[1] - 1)
    threshold = q_from_steps(cfg.goal_exponent, fns.discount)
    return dataclasses.replace(
        plan,
        waypoints=take(tree.latents, nodes),
        length=length,
        cost=tree.root_steps.gather(1, leaf.unsqueeze(1)).squeeze(1),
        reached_goal=tree.goal_values.gather(1, leaf.unsqueeze(1)).squeeze(1) > threshold,
        nodes=nodes,
    )


def _best_leaf(
    fns: SearchFns, plan: Plan, row: int, cfg: PlannerConfig, waypoint_exponent: float, generator: torch.Generator
) -> int:
    """Slot of the node whose path does best in one row; the root's where it is alone."""
    tree, size = plan.tree, int(plan.tree.size[row])
    if size == 1:
        return 0
    leaf = torch.arange(1, size, device=plan.length.device)
    nodes, length = trace_back(tree.parents[row].expand(len(leaf), -1), leaf, depth=plan.nodes.shape[1] - 1)
    paths, limit = tree.latents[row][nodes], SLACK * tree.root_steps[row, 1:size] + SPARE
    cost = walk(fns, paths, length, limit, waypoint_exponent)
    best = cost.topk(min(cfg.rehearsal_paths, len(leaf)), largest=False).indices
    again = best.repeat_interleave(cfg.rehearsals)
    costs = walk(fns, paths[again], length[again], limit[again], waypoint_exponent, cfg.rehearsal_noise, generator)
    return int(leaf[best[costs.view(len(best), -1).mean(1).argmin()]])


def walk(
    fns: SearchFns, paths: Tensor, length: Tensor, limit: Tensor, waypoint_exponent: float, noise: float = 0.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Cost [R] of walking each path by π^l under h: its steps, and those that Q^g sees ahead from where it ends [steps].

    Args:
        fns: the model.
        paths: [R, L, D] latents, root first.
        length: [R] int64 nodes of each path, at least 2.
        limit: [R] a walk that takes longer ends there [steps].
        waypoint_exponent: see `rehearse`.
        noise: deviation of what is added to every action.
        generator: of that noise.
    """
    assert fns.act_local is not None
    reached = q_from_steps(waypoint_exponent, fns.discount)
    cost = torch.full_like(limit, torch.inf)
    walking, current, z, step = torch.arange(len(paths), device=paths.device), torch.ones_like(length), paths[:, 0], 0
    while len(walking):
        step += 1
        target = paths[walking, current]
        action = fns.act_local(z, target)
        if noise > 0:
            drawn = torch.randn(action.shape, generator=generator, dtype=action.dtype)
            action = (action + noise * drawn.to(action.device)).clamp(-1, 1)
        z = fns.step(z, action)
        if step % LOOK_EVERY:
            continue
        near = fns.reach(z, target)[0] > reached
        at_end = current >= length[walking] - 1
        over = (near & at_end) | (step > limit[walking])
        if over.any():
            cost[walking[over]] = step + steps_from_q(fns.value(z[over]), fns.discount).to(cost.dtype)
        going = ~over
        current = torch.where(near & ~at_end, current + 1, current)[going]
        walking, z = walking[going], z[going]
    return cost
