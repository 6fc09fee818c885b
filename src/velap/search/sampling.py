"""The node distribution P_node (Eq. 6-7) and all the randomness of a plan, drawn before it starts."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.search.types import RowGenerator

TEMPERATURE_SPARSE = 1.0
"""T_sparse of Eq. 6 [neighbours]. ours: the paper gives no number."""
TEMPERATURE_VALUE = 0.1
"""T_value of Eq. 7 [Q-value]. ours: the paper gives no number."""


class Noise(NamedTuple):
    """Random numbers of n expansions."""

    node: Tensor
    """[B, n] uniform in [0, 1): picks the node to expand."""
    policy: Tensor
    """[B, n] uniform in [0, 1): π^g acts where it is below p^policy."""
    action: Tensor
    """[B, n, S, m] standard normal input of g; S is 1 where a simulation keeps its noise, else n_sim."""

    def part(self, start: int, stop: int) -> Noise:
        """The numbers of the expansions start ... stop - 1, as far as there are any."""
        return Noise(self.node[:, start:stop], self.policy[:, start:stop], self.action[:, start:stop])


def draw_noise(cfg: PlannerConfig, noise_dim: int, like: Tensor, generator: RowGenerator) -> Noise:
    """All random numbers of a plan for the roots `like` [B, D], in their dtype and on their device."""
    steps = 1 if cfg.coherent_noise else cfg.n_sim
    node, policy = uniform((2, cfg.n_iter), like, generator).unbind(1)
    return Noise(node, policy, normal((cfg.n_iter, steps, noise_dim), like, generator))


def uniform(shape: tuple[int, ...], like: Tensor, generator: RowGenerator) -> Tensor:
    """[B, *shape] uniform in [0, 1) for the rows of `like` [B, ...]."""
    return _draw(torch.rand, shape, like, generator)


def normal(shape: tuple[int, ...], like: Tensor, generator: RowGenerator) -> Tensor:
    """[B, *shape] standard normal for the rows of `like` [B, ...]."""
    return _draw(torch.randn, shape, like, generator)


def _draw(draw: Callable[..., Tensor], shape: tuple[int, ...], like: Tensor, generator: RowGenerator) -> Tensor:
    """Numbers in the dtype and on the device of `like`, drawn where the generator lives, row by row from a sequence."""
    rows = len(like)
    if isinstance(generator, torch.Generator):
        return draw(rows, *shape, generator=generator, dtype=like.dtype, device=generator.device).to(like.device)
    if len(generator) != rows:
        raise ValueError(f"got {len(generator)} generators for {rows} rows; expected one a row, or a single one.")
    drawn = [draw(*shape, generator=one, dtype=like.dtype, device=one.device) for one in generator]
    return torch.stack(drawn).to(like.device)


def node_distribution(crowding: Tensor, goal_values: Tensor, used: Tensor, cfg: PlannerConfig) -> Tensor:
    """P_node [B, N]: p^sparse of Eq. 6, p^value of Eq. 7, the rest uniform; 0 on unused slots.

    Args:
        crowding: [B, N] n^neigh of Eq. 6, to which our presets add expansions made [neighbours].
        goal_values: [B, N] Q^g [Q-value], -inf on unused slots.
        used: [B, N] bool.
        cfg: the mixture.
    """
    logits = (crowding / -TEMPERATURE_SPARSE).masked_fill_(~used, -torch.inf)
    sparse = logits.softmax(1, dtype=goal_values.dtype)
    value = (goal_values / TEMPERATURE_VALUE).softmax(1)
    mixture = cfg.p_sparse * sparse + cfg.p_value * value
    uniform_share = 1 - cfg.p_sparse - cfg.p_value
    return mixture + used * (uniform_share / used.sum(1, keepdim=True)) if uniform_share > 0 else mixture


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
