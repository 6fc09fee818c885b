"""The node distribution P_node (Eq. 6-7) and all the randomness of a plan, drawn before it starts."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.config import PlannerConfig
from velap.search.types import RowGenerator, Tree


class Noise(NamedTuple):
    """Random numbers of n expansions."""

    node: Tensor
    """[B, n] uniform in [0, 1): picks the node to expand."""
    policy: Tensor
    """[B, n] uniform in [0, 1): π^g acts where it is below p^policy."""
    action: Tensor
    """[B, n, S, m] standard normal input of g; S is 1 where a simulation keeps its noise, else n_sim."""

    def part(self, start: int, stop: int) -> Noise:
        """The numbers of the expansions start ... stop - 1."""
        return Noise(self.node[:, start:stop], self.policy[:, start:stop], self.action[:, start:stop])


def draw_noise(cfg: PlannerConfig, noise_dim: int, like: Tensor, generator: RowGenerator) -> Noise:
    """All random numbers of a plan for the roots `like` [B, D], in their dtype and on their device.

    A sequence of generators, one a row, makes a row's numbers independent of the other rows.
    """
    steps = 1 if cfg.coherent_noise else cfg.n_sim
    if isinstance(generator, torch.Generator):
        return _draw(cfg.n_iter, steps, noise_dim, like, generator, like.shape[0])
    if len(generator) != like.shape[0]:
        raise ValueError(f"got {len(generator)} generators for {like.shape[0]} rows; expected one a row, or a single one.")
    rows = [_draw(cfg.n_iter, steps, noise_dim, like, row_generator, 1) for row_generator in generator]
    return Noise(*(torch.cat(parts) for parts in zip(*rows, strict=True)))


def _draw(n: int, steps: int, noise_dim: int, like: Tensor, generator: torch.Generator, rows: int) -> Noise:
    options = {"generator": generator, "dtype": like.dtype, "device": generator.device}
    node, policy = torch.rand(2, rows, n, **options).to(like.device)
    return Noise(node, policy, torch.randn(rows, n, steps, noise_dim, **options).to(like.device))


def node_distribution(tree: Tree, cfg: PlannerConfig) -> Tensor:
    """P_node [B, N]: p^sparse of Eq. 6, p^value of Eq. 7, the rest uniform; 0 on unused slots."""
    used = torch.arange(tree.parents.shape[1], device=tree.size.device) < tree.size.unsqueeze(1)
    crowding = tree.neighbour_counts.to(tree.goal_values.dtype) / -cfg.temperature_sparse
    sparse = crowding.masked_fill_(~used, -torch.inf).softmax(1)
    value = (tree.goal_values / cfg.temperature_value).softmax(1)
    uniform = used / tree.size.unsqueeze(1)
    return cfg.p_sparse * sparse + cfg.p_value * value + max(0.0, 1 - cfg.p_sparse - cfg.p_value) * uniform


def sample_nodes(distribution: Tensor, uniform: Tensor, size: Tensor) -> Tensor:
    """Slots [B, K] int64 drawn by inverting the cumulative distribution.

    Args:
        distribution: [B, N] weights, positive sum a row.
        uniform: [B, K] in [0, 1).
        size: [B] int64 slots in use; rounding cannot pick beyond them.
    """
    cumulative = distribution.cumsum(1)
    slots = torch.searchsorted(cumulative, uniform * cumulative[:, -1:], right=True)
    return torch.minimum(slots, size.unsqueeze(1) - 1)
