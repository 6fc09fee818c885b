"""What search takes and gives back. Batch letters of the whole package:

B environments planned for at once, N nodes a tree holds (n_iter + 1), K candidates of one round, L nodes of the longest
possible path, D latent dimension, A action dimension, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.models.functions import SearchFns as SearchFns

RowGenerator = torch.Generator | Sequence[torch.Generator]
"""One generator for all rows, or one a row: then a row's numbers do not depend on the other rows."""


class Rejections(NamedTuple):
    """Candidates that a plan rejected, int64 [B] each, by the first reason that held; n_iter less `tree.size - 1` in all."""

    unsupported: Tensor
    """Farther than `ANCHOR_FACTOR` one-step distances from every dataset latent (ours)."""
    low: Tensor
    """Q_min^{exp,new} is not above τ_low: too far from the node it was expanded from (Alg. 1, line 13)."""
    std: Tensor
    """Q_std^{exp,new} is not below τ_std: the ensemble disagrees (Alg. 1, line 13)."""
    high: Tensor
    """Some Q_min^{i,new} is not below τ_high: a node of the tree, or an earlier one of the round, is too close (line 14)."""


@dataclass(frozen=True)
class Tree:
    """B trees of fixed capacity. Slot 0 is the root; slots are filled in order, a parent always before its children.

    Slots from `size` on are unused: latent 0, parent -1, goal value -inf, root steps inf, count 0.
    """

    latents: Tensor
    """[B, N, D]."""
    parents: Tensor
    """[B, N] int64 slot of the parent; -1 for the root."""
    goal_values: Tensor
    """[B, N] Q^g [Q-value]."""
    root_steps: Tensor
    """[B, N] sum of log_γ Q_min over the edges from the root (Eq. 8) [steps]."""
    neighbour_counts: Tensor
    """[B, N] int64 n^neigh, nodes within d_neigh that reach this one with Q_min > τ_neigh (Sec. 4, "Node sampling")."""
    expansions: Tensor
    """[B, N] int64 expansions made from the node so far, whatever became of them."""
    size: Tensor
    """[B] int64 nodes in use, at least 1."""


@dataclass(frozen=True)
class Path:
    """The path that every row is to follow."""

    waypoints: Tensor
    """[B, L, D] latents, root first, the last one repeated."""
    length: Tensor
    """[B] int64 nodes of the path, the root included: 1 means that there is nowhere to go."""


@dataclass(frozen=True)
class Plan(Path):
    """The chosen path g* (Eq. 8) of every row, and the tree it was found in."""

    cost: Tensor
    """[B] c(g*) [steps]."""
    reached_goal: Tensor
    """[B] bool: some node has Q^g > τ_goal; otherwise the path leads to the node of highest Q^g."""
    nodes: Tensor
    """[B, L] int64 slots of the waypoints in the tree."""
    tree: Tree
    rejections: Rejections


class Planner(Protocol):
    """Finds a path from every root; `velap.register_planner` makes one known by name."""

    def __call__(self, fns: SearchFns, z_root: Tensor, cfg: PlannerConfig, generator: RowGenerator) -> Path:
        """The model, latents [B, D] to plan from, the checkpoint's planner config, and one generator a row."""
        ...
