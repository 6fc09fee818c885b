"""Plane geometry of the block mazes (App. C.1): rectangles, free space of the block's centre, exact shortest paths.

No physics here. The block is an axis-aligned square that never turns, so its centre may be anywhere outside the walls grown
by half a block, and a shortest path bends only at convex corners of those grown walls. All lengths are in metres.

Letters: P points, N nodes (corners), W walls.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import csgraph_from_dense, dijkstra

TOUCH = 1e-9
"""Slack of a contact [m]: a path may slide along a wall."""

Points = NDArray[np.float64]


@dataclass(frozen=True)
class Rect:
    """A closed axis-aligned rectangle [m]."""

    x_min: float
    y_min: float
    x_max: float
    y_max: float

    def grown(self, margin: float) -> Rect:
        """The rectangle with `margin` [m] more on every side."""
        return Rect(self.x_min - margin, self.y_min - margin, self.x_max + margin, self.y_max + margin)

    def contains(self, points: Points) -> NDArray[np.bool_]:
        """points[*, 2] [m] -> bool[*]."""
        points = np.asarray(points)
        x, y = points[..., 0], points[..., 1]
        return (x >= self.x_min) & (x <= self.x_max) & (y >= self.y_min) & (y <= self.y_max)

    def nearest(self, points: Points) -> Points:
        """points[*, 2] -> the nearest points of the rectangle [*, 2] [m]."""
        return np.clip(points, (self.x_min, self.y_min), (self.x_max, self.y_max))

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Uniform points [count, 2] [m]."""
        return rng.uniform((self.x_min, self.y_min), (self.x_max, self.y_max), size=(count, 2))

    @property
    def centre(self) -> tuple[float, float]:
        """Its middle (x, y) [m]."""
        return (self.x_min + self.x_max) / 2, (self.y_min + self.y_max) / 2

    @property
    def half_size(self) -> tuple[float, float]:
        """Half its width and half its height [m]."""
        return (self.x_max - self.x_min) / 2, (self.y_max - self.y_min) / 2


@dataclass(frozen=True)
class Layout:
    """One maze: what stands where. Hashable, so that a compiled model can be kept for it."""

    workspace: Rect
    """All that the camera sees."""
    walls: tuple[Rect, ...]
    goal: Rect
    """Success is the block's centre in here; painted red on the floor."""
    test_starts: Rect
    """Where the block's centre starts in the test split."""
    block_half: float
    """Half the side of the block [m]."""

    @cached_property
    def _grown(self) -> Points:
        """[W, 4] walls grown by half a block: x_min, y_min, x_max, y_max [m]."""
        grown = [wall.grown(self.block_half) for wall in self.walls]
        return np.array([(r.x_min, r.y_min, r.x_max, r.y_max) for r in grown])

    @cached_property
    def reachable_goal(self) -> Rect:
        """The part of the goal where the block fits: the goal cut back from the walls that line it."""
        goal = self.goal
        for x_min, y_min, x_max, y_max in self._grown:
            if x_min >= goal.x_max or x_max <= goal.x_min or y_min >= goal.y_max or y_max <= goal.y_min:
                continue
            if y_min <= goal.y_min and y_max >= goal.y_max:
                left = x_min <= goal.x_min
                goal = Rect(x_max if left else goal.x_min, goal.y_min, goal.x_max if left else x_min, goal.y_max)
            elif x_min <= goal.x_min and x_max >= goal.x_max:
                below = y_min <= goal.y_min
                goal = Rect(goal.x_min, y_max if below else goal.y_min, goal.x_max, goal.y_max if below else y_min)
            else:
                raise ValueError(f"wall corner inside the goal {self.goal}; expected walls that line it. Move one of them.")
        return goal

    def is_free(self, points: Points) -> NDArray[np.bool_]:
        """Block centres points[*, 2] [m] -> bool[*]: inside the workspace, no wall overlapped (touching is free)."""
        points = np.asarray(points, dtype=np.float64)
        x, y = points[..., None, 0], points[..., None, 1]
        box = self._grown
        hit = (x > box[:, 0] + TOUCH) & (x < box[:, 2] - TOUCH) & (y > box[:, 1] + TOUCH) & (y < box[:, 3] - TOUCH)
        return ~hit.any(-1) & self.workspace.contains(points)

    def nearest_free(self, point: Points) -> Points:
        """point[2] [m] -> itself if free, else pushed out of each wall the shortest way; for points just inside a wall."""
        point = np.array(point, dtype=np.float64)
        for x_min, y_min, x_max, y_max in self._grown:
            depths = np.array([point[0] - x_min, x_max - point[0], point[1] - y_min, y_max - point[1]])
            if (depths > 0).all():
                side = int(depths.argmin())
                point[side // 2] += depths[side] * (-1 if side % 2 == 0 else 1)
        return point

    def sees(self, start: Points, end: Points) -> NDArray[np.bool_]:
        """Segments start[*, 2] -> end[*, 2] [m]: bool[*], True where the block can go straight (walls may be touched)."""
        start, end = np.broadcast_arrays(np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64))
        enter = np.zeros((*start.shape[:-1], len(self.walls)))
        leave = np.ones_like(enter)
        for axis in (0, 1):
            low, high = self._grown[:, axis] + TOUCH, self._grown[:, axis + 2] - TOUCH
            origin, delta = start[..., None, axis], (end - start)[..., None, axis]
            still, inside = delta == 0, (origin > low) & (origin < high)
            with np.errstate(divide="ignore", invalid="ignore"):
                first, second = (low - origin) / delta, (high - origin) / delta
            enter = np.maximum(enter, np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(first, second)))
            leave = np.minimum(leave, np.where(still, np.inf, np.maximum(first, second)))
        return np.asarray((enter >= leave).all(-1))

    @cached_property
    def corners(self) -> Points:
        """[N, 2] corners of the grown walls where the block fits [m]: the only places where a shortest path bends."""
        box = self._grown
        every = np.concatenate([box[:, [i, j]] for i in (0, 2) for j in (1, 3)])
        return np.unique(every[self.is_free(every)].round(12), axis=0)

    @cached_property
    def _corner_distance(self) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Outwards from the goal: distance [N] [m] (inf if cut off), next corner [N] (-1: straight to the goal)."""
        nodes = self.corners
        goal, target = len(nodes), self.reachable_goal.nearest(nodes)
        ways = np.full((goal + 1, goal + 1), np.inf)
        apart = np.linalg.norm(nodes[:, None] - nodes, axis=-1)
        ways[:goal, :goal] = np.where(self.sees(nodes[:, None], nodes[None]), apart, np.inf)
        ways[goal, :goal] = np.where(self.sees(nodes, target), np.linalg.norm(nodes - target, axis=-1), np.inf)
        distance, before = dijkstra(csgraph_from_dense(ways, null_value=np.inf), indices=goal, return_predecessors=True)
        return distance[:goal], np.where((before == goal) | (before < 0), -1, before)[:goal]

    def _first_leg(self, points: Points) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """points[P, 2] -> geodesic distance [P] [m] and the first corner on the way [P] (-1: straight to the goal)."""
        distance, _ = self._corner_distance
        target = self.reachable_goal.nearest(points)
        direct = np.where(self.sees(points, target), np.linalg.norm(points - target, axis=-1), np.inf)
        if not len(self.corners):
            return direct, np.full(len(points), -1)
        legs = np.linalg.norm(points[:, None] - self.corners[None], axis=-1)
        via = np.where(self.sees(points[:, None], self.corners[None]), legs, np.inf) + distance
        corner = via.argmin(-1)
        around = via[np.arange(len(points)), corner]
        return np.minimum(direct, around), np.where(direct <= around, -1, corner)

    def geodesic(self, points: Points) -> NDArray[np.float64]:
        """points[*, 2] [m] -> shortest path of the block's centre to the goal region [*] [m]; inf without one."""
        points = np.asarray(points, dtype=np.float64)
        return self._first_leg(points.reshape(-1, 2))[0].reshape(points.shape[:-1])

    def shortest_path(self, point: Points) -> Points:
        """point[2] [m] -> [L, 2] the shortest path to the goal, its ends included; raises ValueError if there is none."""
        point = np.asarray(point, dtype=np.float64)
        length, corner = self._first_leg(point[None])
        if not np.isfinite(length[0]):
            raise ValueError(f"no path from {point.tolist()} to the goal; expected a free position [m].")
        path, node = [point], int(corner[0])
        while node >= 0:
            path.append(self.corners[node])
            node = int(self._corner_distance[1][node])
        return np.array([*path, self.reachable_goal.nearest(path[-1])])

    def sample_free(self, rng: np.random.Generator, count: int) -> Points:
        """Block centres [count, 2] [m], uniform over the free space outside the goal."""
        found: list[Points] = []
        missing = count
        while missing > 0:
            points = self.workspace.sample(rng, 4 * missing + 16)
            points = points[self.is_free(points) & ~self.goal.contains(points)][:missing]
            found.append(points)
            missing -= len(points)
        return np.concatenate(found) if found else np.empty((0, 2))


def polyline_walls(vertices: Iterable[tuple[float, float]], thickness: float) -> tuple[Rect, ...]:
    """One wall per leg of an axis-aligned polyline [m], with square ends, so that neighbours share their corner square."""
    legs = pairwise(vertices)
    return tuple(Rect(min(a, c), min(b, d), max(a, c), max(b, d)).grown(thickness / 2) for (a, b), (c, d) in legs)


def frame_walls(workspace: Rect, thickness: float) -> tuple[Rect, ...]:
    """Four walls along the inside of the workspace's border [m]."""
    x0, y0, x1, y1 = workspace.x_min, workspace.y_min, workspace.x_max, workspace.y_max
    return (
        Rect(x0, y0, x1, y0 + thickness),
        Rect(x0, y1 - thickness, x1, y1),
        Rect(x0, y0, x0 + thickness, y1),
        Rect(x1 - thickness, y0, x1, y1),
    )
