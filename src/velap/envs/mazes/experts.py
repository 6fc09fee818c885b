"""Scripted experts: they know the state that the agents have to see."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from velap.envs.mazes.geometry import Layout

_CLEARANCE = 0.005
"""Room that the expert keeps to the walls [m], a tenth of a step: turning a corner it does not scrape along them."""


def follow_shortest_path(layout: Layout, position: NDArray[np.float64], step_length: float) -> NDArray[np.float32]:
    """The action [2] of a block at position[2] [m] that walks the shortest path at top speed, `step_length` [m] a step."""
    # from the nearest place where the larger block fits
    cautious = _cautious(layout)
    path = cautious.shortest_path(cautious.nearest_free(position))
    # Aim at the point one step ahead along the path: cutting the corner costs less way than stopping on it.
    target = _point_along(np.concatenate([position[None], path]), step_length)
    # A target nearer than a step is the end of the path: keep going, the goal region has room.
    heading = target - position
    return (heading / max(float(np.linalg.norm(heading)), 1e-9)).astype(np.float32)


@lru_cache(maxsize=16)
def _cautious(layout: Layout) -> Layout:
    """The layout with a slightly larger block; kept, since a layout computes its shortest paths once."""
    return replace(layout, block_half=layout.block_half + _CLEARANCE)


def _point_along(path: NDArray[np.float64], distance: float) -> NDArray[np.float64]:
    """The point [2] at `distance` [m] along a polyline path[L, 2]; its end if it is shorter."""
    for start, end in pairwise(path):
        length = float(np.linalg.norm(end - start))
        if length >= distance:
            return start + (end - start) * (distance / length)
        distance -= length
    return path[-1]
