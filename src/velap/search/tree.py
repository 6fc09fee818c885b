"""Fixed-capacity trees: slots are handed out by a cumulative sum of the mask, so no shape depends on what was accepted.

While a tree grows it has one slot more than its capacity, the sink, which takes the rejected candidates.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from velap.search.types import Tree


@dataclass(frozen=True)
class Candidates:
    """K new nodes of one round."""

    latents: Tensor
    """[B, K, D]."""
    parents: Tensor
    """[B, K] int64 slots."""
    goal_values: Tensor
    """[B, K] Q^g [Q-value]."""
    root_steps: Tensor
    """[B, K] [steps]."""
    neighbour_counts: Tensor
    """[B, K] int64."""


def take(rows: Tensor, index: Tensor) -> Tensor:
    """rows [B, N, D] at index [B, ...] int64 → [B, ..., D]."""
    flat = index.flatten(1).unsqueeze(-1).expand(-1, -1, rows.shape[-1])
    return rows.gather(1, flat).view(*index.shape, rows.shape[-1])


def new_tree(z_root: Tensor, goal_value: Tensor, capacity: int) -> Tree:
    """Growing trees of one node each: z_root [B, D], goal_value [B] → a Tree with `capacity` slots and the sink."""
    batch, dim = z_root.shape
    slots = (batch, capacity + 1)
    tree = Tree(
        latents=z_root.new_zeros(*slots, dim),
        parents=torch.full(slots, -1, dtype=torch.int64, device=z_root.device),
        goal_values=z_root.new_full(slots, -torch.inf),
        root_steps=z_root.new_full(slots, torch.inf),
        neighbour_counts=torch.zeros(slots, dtype=torch.int64, device=z_root.device),
        expansions=torch.zeros(slots, dtype=torch.int64, device=z_root.device),
        size=torch.ones(batch, dtype=torch.int64, device=z_root.device),
    )
    tree.latents[:, 0] = z_root
    tree.goal_values[:, 0] = goal_value
    tree.root_steps[:, 0] = 0
    return tree


def trimmed(tree: Tree) -> Tree:
    """A view without the sink."""
    fields = {f.name: getattr(tree, f.name)[:, :-1] for f in dataclasses.fields(tree) if f.name != "size"}
    return Tree(size=tree.size, **fields)


def free_slots(tree: Tree, accepted: Tensor) -> Tensor:
    """Slots [B, K] int64 for the accepted [B, K] bool candidates of a growing tree; the sink where rejected or full."""
    sink = tree.parents.shape[1] - 1
    slots = tree.size.unsqueeze(1) + accepted.cumsum(1) - 1
    return torch.where(accepted, slots, sink).clamp_(max=sink)


def insert_(tree: Tree, candidates: Candidates, slots: Tensor) -> None:
    """Write candidates to `slots` [B, K] of a growing tree, in place; what lands in the sink counts for nothing."""
    sink = tree.parents.shape[1] - 1
    tree.latents.scatter_(1, slots.unsqueeze(-1).expand_as(candidates.latents), candidates.latents)
    for name in ("parents", "goal_values", "root_steps", "neighbour_counts"):
        getattr(tree, name).scatter_(1, slots, getattr(candidates, name))
    tree.size.add_((slots < sink).sum(1))


def trace_back(parents: Tensor, leaf: Tensor, depth: int) -> tuple[Tensor, Tensor]:
    """Paths from the root to the leaves, root first.

    Args:
        parents: [B, N] int64.
        leaf: [B] int64 slots.
        depth: most edges a path can have.

    Returns:
        nodes [B, depth + 1] int64, the leaf repeated at the end; length [B] int64, nodes of each path.
    """
    path = [leaf.unsqueeze(1)]
    for _ in range(depth):
        path.append(parents.gather(1, path[-1]).clamp_(min=0))
    upwards = torch.cat(path, 1)
    length = (upwards != 0).sum(1) + 1
    downwards = length.unsqueeze(1) - 1 - torch.arange(depth + 1, device=leaf.device)
    return upwards.gather(1, downwards.clamp_(min=0)), length
