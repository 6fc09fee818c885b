"""An exact world for the search: points in the plane, a wall, Q = γ^(geodesic distance).

The wall is the half-line x = 0, y <= TIP, so the shortest way between two points is straight or bends once, at its tip.
The goal value knows nothing of the wall: climbing it ends behind the wall, which only a search gets around.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.search.types import SearchFns

DISCOUNT = 0.96
TIP = 6.0
GOAL = (6.0, 0.0)
START = (-6.0, 0.0)
HALF_WIDTH = 10.0
"""The world is a square around the origin."""
SPEED = 0.97
"""Longest step; not 1, so that no distance between nodes equals a threshold of Table 8."""


def crosses_wall(start: Tensor, end: Tensor) -> Tensor:
    """Whether the segment start [*, 2] → end [*, 2] touches the wall: bool [*]."""
    (x0, y0), (x1, y1) = start.unbind(-1), end.unbind(-1)
    sides_differ = x0 * x1 < 0
    at_wall = torch.where(sides_differ, x0 / torch.where(sides_differ, x0 - x1, 1), 0)
    return sides_differ & (y0 + at_wall * (y1 - y0) <= TIP)


def geodesic(start: Tensor, end: Tensor) -> Tensor:
    """Length [*] of the shortest way; exact."""
    tip = start.new_tensor([0.0, TIP])
    around = (start - tip).norm(dim=-1) + (tip - end).norm(dim=-1)
    return torch.where(crosses_wall(start, end), around, (start - end).norm(dim=-1))


def move(z: Tensor, action: Tensor) -> Tensor:
    """One step by `action`, at most of length 1, times SPEED; a step into the wall stays where it was."""
    length = action.norm(dim=-1, keepdim=True)
    end = (z + SPEED * action / length.clamp(min=1)).clamp(-HALF_WIDTH, HALF_WIDTH)
    return torch.where(crosses_wall(z, end).unsqueeze(-1), z, end)


def straight_to_goal(z: Tensor) -> Tensor:
    """Direction of the goal, wall or not [*, 2]."""
    towards = z.new_tensor(GOAL) - z
    return towards / towards.norm(dim=-1, keepdim=True).clamp(min=1)


def misleading_value(z: Tensor) -> Tensor:
    """γ^(straight distance to the goal) [*]: as if there were no wall."""
    return DISCOUNT ** (z - z.new_tensor(GOAL)).norm(dim=-1)


def unit(noise: Tensor) -> Tensor:
    """Directions [*, 2], uniform for standard normal noise."""
    return noise / noise.norm(dim=-1, keepdim=True)


def reach(start: Tensor, end: Tensor) -> tuple[Tensor, Tensor]:
    """Exact Q, without doubt."""
    q = DISCOUNT ** geodesic(start, end)
    return q, torch.zeros_like(q)


def toy_fns(**changes: object) -> SearchFns:
    """The world as callables; `changes` replaces some."""
    fns = SearchFns(
        propose=lambda z, noise: unit(noise),
        act_global=straight_to_goal,
        step=move,
        reach=reach,
        value=misleading_value,
        q=lambda z, action: misleading_value(move(z, action)) * DISCOUNT,
        noise_dim=2,
        discount=DISCOUNT,
        d_neigh=3.0,
        step_distance=1.0,
    )
    return fns._replace(**changes)


def algorithm_1(**changes: Any) -> PlannerConfig:
    """Algorithm 1 without what is ours but coherent noise; `changes` replaces fields."""
    plain: dict[str, Any] = {
        "provenance": False, "n_iter": 250, "n_sim": 5, "candidates": 50, "discard_low_exponent": None,
        "anchor": "none"}
    return PlannerConfig(**{**plain, **changes})


def roots(batch: int, spread: float = 0.0, seed: int = 0) -> Tensor:
    """Starts [B, 2] in float64, `spread` around START."""
    offsets = torch.rand(batch, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1
    return torch.tensor([START], dtype=torch.float64) + spread * offsets


def row_generators(batch: int, first_seed: int = 0) -> list[torch.Generator]:
    """One generator a row."""
    return [torch.Generator().manual_seed(first_seed + row) for row in range(batch)]
