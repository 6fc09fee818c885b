"""Which nodes a candidate is compared with (App. B.6), and what they say about it.

K candidates of B trees, D latent; S = M + K: a candidate is compared with the M nearest nodes and with the K candidates of
its round.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.search.simulation import packs
from velap.search.tree import take
from velap.search.types import SearchFns

MAX_NEIGHBOURS = 16
"""M, nearest tree nodes that a candidate is compared with inside d_neigh. ours: the paper compares with all of them, which
is the same as long as no more than M lie within d_neigh."""


class Pairs(NamedTuple):
    """Candidate neighbours of a round, in a pool of n tree nodes followed by the K candidates."""

    pool: Tensor
    """[B, n + K, D]."""
    rows: Tensor
    """[B, K, S] int64 slots of the pool: the M nearest nodes, then every candidate."""
    near: Tensor
    """[B, K, S] bool: within d_neigh, in use and, among candidates, earlier in the round."""


def candidate_neighbours(latents: Tensor, used: Tensor, z: Tensor, d_neigh: float) -> Pairs:
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
    return Pairs(pool, torch.cat([index, others], 2), torch.cat([nearest <= bound, earlier], 2))


def incoming_q(fns: SearchFns, pairs: Pairs, z: Tensor, feasible: Tensor, parents: Tensor, q_edge: Tensor) -> Tensor:
    """Q_min^{i,new} [B, K, S] of the neighbours i of the feasible [B, K] candidates z [B, K, D], -inf elsewhere.

    That of the node a candidate was expanded from, slot `parents` [B, K], is known: q_edge [B, K].
    """
    from_parent = pairs.near & (pairs.rows == parents.unsqueeze(-1))
    q_in = _reach_where(fns, pairs, z, pairs.near & feasible.unsqueeze(-1) & ~from_parent, incoming=True)
    return torch.where(from_parent, q_edge.unsqueeze(-1), q_in)


def _reach_where(fns: SearchFns, pairs: Pairs, z: Tensor, mask: Tensor, incoming: bool) -> Tensor:
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


def gained_neighbours(fns: SearchFns, pairs: Pairs, z: Tensor, accepted: Tensor, q_in: Tensor, limit: Tensor) -> Tensor:
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
