"""ObstacleMaze (App. C.1.2, Fig. 2b): across a room to its red wall, past two obstacles at random places near the centre.

ours: the paper gives no dimensions. Drawn in pixels of the 64×64 frame like SpiralMaze. The obstacles are bars that overlap
in the middle of the room, one above the other. On one side a bar leaves no gap that the block could pass, on the other side
it leaves the way open, the two bars on opposite sides: every way from the lower wall to the upper one is an S. The bars
stand at whole pixels, so that two contexts differ in the frame whenever they differ at all.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from velap.envs.mazes.env import BlockMaze
from velap.envs.mazes.geometry import Layout, frame_walls
from velap.envs.mazes.spiral import BLOCK, FRAME, OUTER_WALL, PIXEL, metres
from velap.errors import ConfigError

TRAIN_CONTEXTS = 250
"""Contexts of the training data (Table 10); all others are test contexts."""

_BAR = (38, 5)
"""Width and height of an obstacle [px]."""
_OUTER_ENDS = range(-1, 7)
"""Where a bar's outer end stands, from the side of the frame [px]. Up to 3 it stands in the side wall, beyond it leaves a
gap of 3 px at most, which the block of 4.5 px does not enter."""
_LOWER = range(17, 24)
"""Lower edge of the lower bar [px]."""
_UPPER = range(35, 42)
"""Lower edge of the upper bar [px]. Between the bars the block has 2.5 px of freedom at least."""
_PLACES = (2, len(_OUTER_ENDS), len(_OUTER_ENDS), len(_LOWER), len(_UPPER))
CONTEXTS = int(np.prod(_PLACES))
"""Contexts that there are: mirrored or not, and the places of both bars."""
_ORDER = np.random.default_rng(0).permutation(CONTEXTS)
"""Contexts in random order, the same one always: the first are those of the training data."""

_GOAL = (27, 57, 37, FRAME)
"""The red piece of the upper wall and of the floor in front of it [px]. A wall that is red from end to end would be reached
in 0.9 % of the transitions of the random walks, however thin the strip in front of it; Table 10 has 0.11 %."""
_POST = (2, 5)
"""Thickness of the posts on both sides of the red piece, and how far they stand out of the wall [px]: they keep the block
from sliding into the goal along the wall. Between them the block has 5.5 px of freedom, as in SpiralMaze's corridor."""
_TEST_STARTS = (5.5, 5.5, 58.5, 9.5)
"""Block centres [px], along the whole lower wall."""

Pixels = tuple[float, float, float, float]


def _mirrored(rect: Pixels) -> Pixels:
    """Left and right swapped."""
    x_min, y_min, x_max, y_max = rect
    return FRAME - x_max, y_min, FRAME - x_min, y_max


@lru_cache(maxsize=TRAIN_CONTEXTS)
def obstacle_layout(context: int) -> Layout:
    """The room of a context, 0 to CONTEXTS - 1 [m]; 0 to TRAIN_CONTEXTS - 1 are those of the training data."""
    mirror, lower_end, upper_end, lower, upper = np.unravel_index(_ORDER[context], _PLACES)
    width, height = _BAR

    def bar(outer_end: int, bottom: int) -> Pixels:
        return max(0, outer_end), bottom, outer_end + width, bottom + height

    bars = [bar(_OUTER_ENDS[lower_end], _LOWER[lower]), _mirrored(bar(_OUTER_ENDS[upper_end], _UPPER[upper]))]
    workspace, (thickness, depth) = metres((0, 0, FRAME, FRAME)), _POST
    posts = [(x, FRAME - OUTER_WALL - depth, x + thickness, FRAME) for x in (_GOAL[0] - thickness, _GOAL[2])]
    walls = [*posts, *(_mirrored(each) if mirror else each for each in bars)]
    return Layout(
        workspace=workspace,
        walls=(*frame_walls(workspace, OUTER_WALL * PIXEL), *(metres(wall) for wall in walls)),
        goal=metres(_GOAL),
        test_starts=metres(_TEST_STARTS),
        block_half=BLOCK * PIXEL / 2,
    )


class ObstacleMaze(BlockMaze):
    """From the lower wall to the red piece of the upper one, 39 to 69 steps away. A context is a place of the obstacles."""

    def _choose_layout(self, rng: np.random.Generator, split: str, context: int | None) -> Layout:
        first, count = (0, TRAIN_CONTEXTS) if split == "train" else (TRAIN_CONTEXTS, CONTEXTS - TRAIN_CONTEXTS)
        if context is None:
            context = int(rng.integers(count))
        if context >= count:
            raise ConfigError(f"context {context} in the {split} split of ObstacleMaze; expected 0 to {count - 1}.")
        return obstacle_layout(first + context)

    def true_state(self) -> NDArray[np.float32]:
        """The block's centre [2] and the centres of the lower and the upper bar [4] [m]."""
        lower, upper = self.layout.walls[-2:]
        return np.array([*self.agent_position(), *lower.centre, *upper.centre], np.float32)
