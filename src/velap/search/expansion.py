"""One round of Algorithm 1 for K candidates of B trees at once: simulate, reject, insert (App. B.6).

S = M + K: a candidate is compared with the M nearest nodes and with the K candidates of its round. Shapes are fixed and
nothing is read back, with one exception: on a CPU (`packs`) the networks see only the rows that matter, trees are looked
at as far as they are filled, and loops stop when they are done. That changes no result, costs nothing there, and saves
most of the critics' work.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.errors import ConfigError
from velap.models.horizon import q_from_steps, steps_from_q
from velap.search.sampling import Noise, node_distribution, sample_nodes
from velap.search.tree import Candidates, free_slots, insert_, take
from velap.search.types import SearchFns, Tree

MAX_NEIGHBOURS = 16
"""M, nearest tree nodes that a candidate is compared with inside d_neigh. ours: the paper compares with all of them, which
is the same as long as no more than M lie within d_neigh."""
ANCHOR_FACTOR = 1.0
"""Largest distance of a candidate to a dataset latent, in upper 5-percentiles of one-step distances. ours."""


class Thresholds(NamedTuple):
    """Table 8 for one model: scalars [] [Q-value]."""

    high: Tensor
    low: Tensor
    std: Tensor
    neighbour: Tensor
    goal: Tensor


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


def packs(z: Tensor) -> bool:
    """Whether shapes may depend on data: on a CPU outside of a compiled graph."""
    return z.device.type == "cpu" and not torch.compiler.is_compiling()


def thresholds(cfg: PlannerConfig, discount: float, like: Tensor) -> Thresholds:
    """τ of Table 8 for γ = discount, in the dtype and on the device of `like`."""
    low = cfg.n_sim if cfg.discard_low_exponent is None else cfg.discard_low_exponent
    values = (
        q_from_steps(cfg.discard_high_exponent, discount),
        q_from_steps(low, discount),
        1 - discount if cfg.discard_std is None else cfg.discard_std,
        q_from_steps(cfg.neighbour_exponent, discount),
        q_from_steps(cfg.goal_exponent, discount),
    )
    return Thresholds(*(like.new_full((), value) for value in values))


def simulate(fns: SearchFns, z: Tensor, noise: Noise, cfg: PlannerConfig) -> Tensor:
    """Latents [B, K, D] n_sim steps after z [B, K, D], by π^g where the noise says so, else by g (Alg. 1, lines 5-10)."""
    by_policy = noise.policy < cfg.p_policy
    if packs(z):
        return _simulate_packed(fns, z, noise.action, by_policy, cfg.n_sim)
    for step in range(cfg.n_sim):
        proposed = fns.propose(z, noise.action[:, :, min(step, noise.action.shape[2] - 1)])
        z = fns.step(z, torch.where(by_policy.unsqueeze(-1), fns.act_global(z), proposed))
    return z


def _simulate_packed(fns: SearchFns, z: Tensor, noise: Tensor, by_policy: Tensor, n_sim: int) -> Tensor:
    """`simulate` with the rows of π^g moved to the front, so that each model sees its own rows only."""
    order = by_policy.flatten().argsort(descending=True)
    split, steps = int(by_policy.sum()), noise.shape[2]
    rows = z.flatten(0, 1).index_select(0, order)
    noise = noise.flatten(0, 1).index_select(0, order[split:])
    for step in range(0 if fns.rollout is not None else n_sim):
        actions = []
        if split > 0:
            actions.append(fns.act_global(rows[:split]))
        if split < len(rows):
            actions.append(fns.propose(rows[split:], noise[:, min(step, steps - 1)]))
        rows = fns.step(rows, torch.cat(actions))
    if fns.rollout is not None:
        parts = (rows[:split], None), (rows[split:], noise)
        rows = torch.cat([fns.rollout(part, drawn, n_sim) for part, drawn in parts if len(part)])
    return torch.empty_like(rows).index_copy_(0, order, rows).view_as(z)


def anchored(fns: SearchFns, z: Tensor, cfg: PlannerConfig) -> tuple[Tensor, Tensor]:
    """Candidates [B, K, D] after anchoring to the dataset's latents, and which of them [B, K] bool are supported (ours)."""
    if cfg.anchor == "none":
        return z, torch.ones(z.shape[:-1], dtype=torch.bool, device=z.device)
    if fns.project is None:
        raise ConfigError(f"config field `anchor` is {cfg.anchor!r}, but the model keeps no dataset latents; "
                          "expected 'none'. Train with `bank_size` above 0 or set `anchor` to 'none'.")
    nearest, distance = fns.project(z)
    return nearest, distance <= ANCHOR_FACTOR * fns.step_distance


class _Pairs(NamedTuple):
    """Candidate neighbours of a round, in a pool of n tree nodes followed by the K candidates."""

    pool: Tensor
    """[B, n + K, D]."""
    rows: Tensor
    """[B, K, S] int64 slots of the pool: the M nearest nodes, then every candidate."""
    near: Tensor
    """[B, K, S] bool: within d_neigh, in use and, among candidates, earlier in the round."""


def _candidate_neighbours(latents: Tensor, used: Tensor, z: Tensor, d_neigh: float) -> _Pairs:
    """Used [B, n] nodes of latents [B, n, D] within d_neigh of z [B, K, D] (App. B.6), the M nearest, and candidates.

    Squared distances come from one product, less |z|², which does not change who is nearest.
    """
    batch, nodes, _ = latents.shape
    count = z.shape[1]
    pool = torch.cat([latents, z], 1)
    norms = pool.square().sum(-1)
    bound = d_neigh**2 - norms[:, nodes:].unsqueeze(-1)
    norms[:, :nodes].masked_fill_(~used, torch.inf)
    distance = torch.baddbmm(norms.unsqueeze(1), z, pool.mT, alpha=-2)
    nearest, index = distance[:, :, :nodes].topk(min(MAX_NEIGHBOURS, nodes), largest=False, sorted=False)
    others = torch.arange(nodes, nodes + count, device=z.device).expand(batch, count, count)
    earlier = (distance[:, :, nodes:] <= bound).tril_(-1)
    return _Pairs(pool, torch.cat([index, others], 2), torch.cat([nearest <= bound, earlier], 2))


def _reach_where(fns: SearchFns, pairs: _Pairs, z: Tensor, mask: Tensor, incoming: bool) -> Tensor:
    """Q_min [B, K, S] of pool row → candidate (incoming) or candidate → pool row, -inf outside the mask [B, K, S]."""
    if not packs(z):
        ends = take(pairs.pool, pairs.rows), z.unsqueeze(2).expand(*mask.shape, -1)
        return fns.reach(*(ends if incoming else ends[::-1]))[0].masked_fill(~mask, -torch.inf)
    q = z.new_full(mask.shape, -torch.inf)
    chosen = mask.flatten().nonzero().squeeze(1)
    if len(chosen):
        candidate = chosen // mask.shape[2]
        row = pairs.rows.flatten().index_select(0, chosen) + candidate // z.shape[1] * pairs.pool.shape[1]
        ends = pairs.pool.flatten(0, 1).index_select(0, row), z.flatten(0, 1).index_select(0, candidate)
        q.view(-1).index_copy_(0, chosen, fns.reach(*(ends if incoming else ends[::-1]))[0].to(q.dtype))
    return q


def _value_where(fns: SearchFns, z: Tensor, mask: Tensor) -> Tensor:
    """Q^g [B, K] of z [B, K, D]; where rows can be picked, -inf outside the mask [B, K]."""
    if not packs(z):
        return fns.value(z)
    values = z.new_full(mask.shape, -torch.inf)
    chosen = mask.flatten().nonzero().squeeze(1)
    if len(chosen):
        values.view(-1).index_copy_(0, chosen, fns.value(z.flatten(0, 1).index_select(0, chosen)).to(values.dtype))
    return values


def first_come(novel: Tensor, blocks: Tensor) -> Tensor:
    """Accepted [B, K] bool: novel [B, K] bool and not blocked by an earlier accepted candidate.

    blocks [B, K, K] is strictly lower triangular: [b, k, j] says that j is too close for k. The accepted ones are the fixed
    point of `accepted = novel and not (blocks @ accepted)`; each pass settles at least one more candidate, K - 1 settle all.
    """
    weights, start = blocks.float(), novel.unsqueeze(-1).float()
    accepted = start
    for _ in range(novel.shape[1] - 1):
        before, accepted = accepted, torch.baddbmm(start, weights, accepted, alpha=-1).clamp_(min=0)
        if packs(novel) and torch.equal(before, accepted):
            break
    return accepted.squeeze(-1) > 0


def expand_(tree: Tree, fns: SearchFns, cfg: PlannerConfig, limits: Thresholds, noise: Noise, slots: int) -> Verdict:
    """One round, in place, on a growing tree of which at most the first `slots` slots are in use."""
    used = torch.arange(slots, device=tree.size.device) < tree.size.unsqueeze(1)
    crowding = tree.neighbour_counts[:, :slots] + cfg.expansion_weight * tree.expansions[:, :slots]
    distribution = node_distribution(crowding, tree.goal_values[:, :slots], used, cfg)
    parents = sample_nodes(distribution, noise.node, tree.size)
    tree.expansions.scatter_add_(1, parents, torch.ones_like(parents))
    z_parent = take(tree.latents, parents)
    z, supported = anchored(fns, simulate(fns, z_parent, noise, cfg), cfg)
    q_edge, std_edge = fns.reach(z_parent, z)

    feasible = (q_edge > limits.low) & (q_edge < limits.high) & (std_edge < limits.std) & supported
    pairs = _candidate_neighbours(tree.latents[:, :slots], used, z, fns.d_neigh)
    from_parent = pairs.near & (pairs.rows == parents.unsqueeze(-1))
    q_in = _reach_where(fns, pairs, z, pairs.near & feasible.unsqueeze(-1) & ~from_parent, incoming=True)
    q_in = torch.where(from_parent, q_edge.unsqueeze(-1), q_in)
    too_close = ~(q_in < limits.high)
    count = z.shape[1]
    novel = feasible & ~too_close[:, :, :-count].any(-1)

    target = free_slots(tree, first_come(novel, too_close[:, :, -count:]))
    accepted = target < tree.parents.shape[1] - 1
    gained = _gained_neighbours(fns, pairs, z, accepted, q_in, limits.neighbour)
    tree.neighbour_counts[:, :slots].add_(gained[:, :slots])
    root_steps = tree.root_steps.gather(1, parents) + steps_from_q(q_edge, fns.discount)
    insert_(tree, Candidates(z, parents, _value_where(fns, z, accepted), root_steps, gained[:, slots:]), target)
    return Verdict(accepted, supported, q_edge, std_edge)


def _gained_neighbours(fns: SearchFns, pairs: _Pairs, z: Tensor, accepted: Tensor, q_in: Tensor, limit: Tensor) -> Tensor:
    """Incoming neighbours int64 [B, n + K] that each row of the pool gains when the accepted [B, K] candidates join."""
    count = z.shape[1]
    batch, rows, _ = pairs.pool.shape
    joint = pairs.near & accepted.unsqueeze(-1)
    joint[:, :, -count:] &= accepted.unsqueeze(1)
    q_out = _reach_where(fns, pairs, z, joint, incoming=False)
    gained = torch.zeros(batch, rows, dtype=torch.int64, device=z.device)
    gained.scatter_add_(1, pairs.rows.flatten(1), (q_out > limit).flatten(1).long())
    gained[:, -count:] += ((q_in > limit) & joint).sum(2)
    return gained
