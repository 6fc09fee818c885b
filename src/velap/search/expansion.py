"""One round of Algorithm 1 for K candidates of B trees at once: simulate, reject, insert (App. B.6).

Shapes are fixed. The one exception is `_reach_where`, which evaluates on a CPU only the pairs that matter, because
there the critics are the cost and a data-dependent batch is free; elsewhere every pair is evaluated and masked.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.config import PlannerConfig
from velap.errors import ConfigError
from velap.models.horizon import q_from_steps, steps_from_q
from velap.search.sampling import Noise, node_distribution, sample_nodes
from velap.search.tree import Candidates, free_slots, head, insert_, take
from velap.search.types import Outcome, SearchFns, Tree


class Thresholds(NamedTuple):
    """Table 8 for one model, all [Q-value]."""

    high: float
    low: float
    std: float
    neighbour: float
    goal: float


def thresholds(cfg: PlannerConfig, discount: float) -> Thresholds:
    """τ of Table 8 for γ = discount."""
    low = cfg.n_sim if cfg.discard_low_exponent is None else cfg.discard_low_exponent
    return Thresholds(
        high=q_from_steps(cfg.discard_high_exponent, discount),
        low=q_from_steps(low, discount),
        std=1 - discount if cfg.discard_std is None else cfg.discard_std,
        neighbour=q_from_steps(cfg.neighbour_exponent, discount),
        goal=q_from_steps(cfg.goal_exponent, discount),
    )


def simulate(fns: SearchFns, z: Tensor, noise: Noise, cfg: PlannerConfig) -> Tensor:
    """Latents [B, K, D] n_sim steps after z [B, K, D] (Alg. 1, lines 5-10)."""
    by_policy = (noise.policy < cfg.p_policy).unsqueeze(-1)
    for step in range(cfg.n_sim):
        actions = fns.propose(z, noise.action[:, :, min(step, noise.action.shape[2] - 1)])
        if cfg.p_policy > 0:
            actions = torch.where(by_policy, fns.act_global(z), actions)
        z = fns.step(z, actions)
    return z


def anchored(fns: SearchFns, z: Tensor, cfg: PlannerConfig) -> tuple[Tensor, Tensor | None]:
    """Candidates [B, K, D] after anchoring to the dataset latents, and which [B, K] are supported (None: all, unasked)."""
    if cfg.anchor == "none":
        return z, None
    if fns.project is None:
        raise ConfigError(f"config field `anchor` is {cfg.anchor!r}, but the model keeps no dataset latents; "
                          "expected 'none'. Train with `bank_size` above 0 or set `anchor` to 'none'.")
    nearest, distance = fns.project(z)
    supported = distance <= cfg.anchor_factor * fns.step_distance
    return (nearest if cfg.anchor == "snap" else z), supported


class _Pairs(NamedTuple):
    """Candidate neighbours: for each candidate, S = M + K slots of a pool of n tree nodes followed by the K candidates."""

    pool: Tensor
    """[B, n + K, D]."""
    index: Tensor
    """[B, K, S] int64 rows of the pool: the M nearest nodes, then every candidate."""
    near: Tensor
    """[B, K, S] bool: within d_neigh, in use and, among candidates, earlier in the round."""


def _candidate_neighbours(tree: Tree, z: Tensor, d_neigh: float, most: int) -> _Pairs:
    """Nodes within d_neigh of z [B, K, D] (App. B.6), the `most` nearest at most, and earlier candidates within d_neigh."""
    batch, count, _ = z.shape
    nodes = tree.latents.shape[1]
    pool = torch.cat([tree.latents, z], 1)
    distance = torch.cdist(z, pool, compute_mode="donot_use_mm_for_euclid_dist")
    used = torch.arange(nodes, device=z.device) < tree.size.unsqueeze(1)
    to_nodes = distance[:, :, :nodes].masked_fill(~used.unsqueeze(1), torch.inf)
    nearest, index = to_nodes.topk(min(most, nodes), largest=False)
    others = torch.arange(nodes, nodes + count, device=z.device).expand(batch, count, count)
    earlier = (distance[:, :, nodes:] <= d_neigh).tril(-1)
    return _Pairs(pool, torch.cat([index, others], 2), torch.cat([nearest <= d_neigh, earlier], 2))


def _reach_where(fns: SearchFns, pairs: _Pairs, z: Tensor, mask: Tensor, incoming: bool) -> Tensor:
    """Q_min [B, K, S] of pool row → candidate (incoming) or candidate → pool row, -inf outside the mask [B, K, S]."""
    if z.device.type == "cpu" and not torch.compiler.is_compiling():
        q = z.new_full(mask.shape, -torch.inf)
        row, candidate, _ = chosen = mask.nonzero(as_tuple=True)
        if row.numel():
            ends = pairs.pool[row, pairs.index[chosen]], z[row, candidate]
            q[chosen] = fns.reach(*(ends if incoming else ends[::-1]))[0].to(q.dtype)
        return q
    ends = take(pairs.pool, pairs.index), z.unsqueeze(2).expand(*mask.shape, -1)
    return fns.reach(*(ends if incoming else ends[::-1]))[0].masked_fill(~mask, -torch.inf)


def first_come(novel: Tensor, blocks: Tensor) -> Tensor:
    """Accepted [B, K] bool: novel [B, K] bool and not blocked by an earlier accepted candidate.

    blocks [B, K, K] is strictly lower triangular: [b, k, j] says that j is too close for k. The accepted ones are the fixed
    point of `accepted = novel and not (blocks @ accepted)`; each pass settles at least one more candidate, K settle all.
    """
    weights = blocks.float()
    start = novel.unsqueeze(-1).float()
    accepted = start
    eager = novel.device.type == "cpu" and not torch.compiler.is_compiling()
    for _ in range(novel.shape[1] - 1):
        before, accepted = accepted, torch.baddbmm(start, weights, accepted, alpha=-1).clamp_(min=0)
        if eager and torch.equal(before, accepted):
            break
    return accepted.squeeze(-1) > 0


def expand_(tree: Tree, fns: SearchFns, cfg: PlannerConfig, noise: Noise, slots: int) -> Tensor:
    """One round on a growing tree of which at most the first `slots` slots are in use; outcomes [B, K] int64."""
    seen = head(tree, slots)
    limits = thresholds(cfg, fns.discount)
    parents = sample_nodes(node_distribution(seen, cfg), noise.node, seen.size)
    z_parent = take(seen.latents, parents)
    z, supported = anchored(fns, simulate(fns, z_parent, noise, cfg), cfg)
    q_edge, std_edge = fns.reach(z_parent, z)

    feasible = (q_edge > limits.low) & (std_edge < limits.std) & (q_edge < limits.high)
    if supported is not None:
        feasible &= supported
    pairs = _candidate_neighbours(seen, z, fns.d_neigh, cfg.max_neighbours)
    is_parent = pairs.index == parents.unsqueeze(-1)
    q_in = _reach_where(fns, pairs, z, pairs.near & feasible.unsqueeze(-1) & ~is_parent, incoming=True)
    q_in = torch.where(is_parent & pairs.near, q_edge.unsqueeze(-1), q_in)
    too_close = ~(q_in < limits.high)
    count = z.shape[1]
    novel = feasible & ~too_close[:, :, :-count].any(-1)
    accepted = first_come(novel, too_close[:, :, -count:])

    target = free_slots(tree, accepted)
    accepted = target < tree.parents.shape[1] - 1
    counts = _count_neighbours(fns, pairs, z, accepted, q_in, limits.neighbour)
    seen.neighbour_counts.add_(counts[:, :slots])
    root_steps = seen.root_steps.gather(1, parents) + steps_from_q(q_edge, fns.discount)
    insert_(tree, Candidates(z, parents, fns.value(z), root_steps, counts[:, slots:]), target)
    return _outcomes(accepted, supported, q_edge > limits.low, std_edge < limits.std)


def _count_neighbours(fns: SearchFns, pairs: _Pairs, z: Tensor, accepted: Tensor, q_in: Tensor, limit: float) -> Tensor:
    """Neighbours int64 [B, n + K] that the pool's rows gain by the accepted [B, K] candidates joining the tree."""
    count = z.shape[1]
    batch, rows, _ = pairs.pool.shape
    joins = torch.cat([accepted.new_ones(batch, rows - count), accepted], 1)
    both_join = joins.unsqueeze(1).expand(-1, count, -1).gather(2, pairs.index) & accepted.unsqueeze(-1)
    q_out = _reach_where(fns, pairs, z, pairs.near & both_join, incoming=False)
    gained = torch.zeros(batch, rows, dtype=torch.int64, device=z.device)
    gained.scatter_add_(1, pairs.index.flatten(1), (q_out > limit).flatten(1).long())
    gained[:, rows - count:] += ((q_in > limit) & both_join).sum(2)
    return gained


def _outcomes(accepted: Tensor, supported: Tensor | None, not_low: Tensor, not_std: Tensor) -> Tensor:
    """`Outcome` codes [B, K] int64: the first reason that holds."""
    outcome = torch.where(not_std, int(Outcome.HIGH), int(Outcome.STD))
    outcome = torch.where(not_low, outcome, int(Outcome.LOW))
    if supported is not None:
        outcome = torch.where(supported, outcome, int(Outcome.UNSUPPORTED))
    return torch.where(accepted, int(Outcome.ACCEPTED), outcome)
