"""Where the walls of SpiralMaze stand (App. C.1.1, Fig. 2a). ours: the paper gives no dimensions.

Drawn in pixels of the 64×64 frame, x to the right and y up, the origin in the lower left corner. Five by five cells of 10
px, inner walls of 2 px, outer walls of 3 px: the corridor runs two loops from the lower left cell to the middle one.
"""

from __future__ import annotations

from velap.envs.mazes.geometry import Layout, Rect, frame_walls, polyline_walls

PIXEL = 1 / 32
"""Side of a pixel of the 64×64 frame on the floor [m]; the frame is 2 m wide."""

FRAME = 64
"""Side of the frame [px]."""
OUTER_WALL = 3
"""Thickness of the walls round the room [px]."""
_INNER_WALL = 2
BLOCK = 4.5
"""Side of the block [px]. Not a whole number: without anti-aliasing its two edges then round to pixels at different places,
so that the frame tells its position to half a pixel. It leaves 5.5 px of freedom across the corridor."""
_INNER_CENTRELINE = ((0, 14), (50, 14), (50, 50), (14, 50), (14, 26), (38, 26), (38, 38), (26, 38))
_GOAL = (31.5, 27.0, 37.0, 37.0)
"""Inner end of the corridor, from wall to wall. Its depth sets the share of successful transitions, see Table 10: 0.12 %."""
_TEST_STARTS = (5.5, 5.5, 9.5, 10.5)
"""Block centres, in the lower left cell."""


def metres(rect: tuple[float, float, float, float]) -> Rect:
    """Pixels from the lower left corner -> metres from the middle."""
    x_min, y_min, x_max, y_max = ((value - FRAME / 2) * PIXEL for value in rect)
    return Rect(x_min, y_min, x_max, y_max)


def spiral_layout() -> Layout:
    """The one layout of SpiralMaze [m]."""
    workspace = metres((0, 0, FRAME, FRAME))
    centreline = [((x - FRAME / 2) * PIXEL, (y - FRAME / 2) * PIXEL) for x, y in _INNER_CENTRELINE]
    return Layout(
        workspace=workspace,
        walls=(*frame_walls(workspace, OUTER_WALL * PIXEL), *polyline_walls(centreline, _INNER_WALL * PIXEL)),
        goal=metres(_GOAL),
        test_starts=metres(_TEST_STARTS),
        block_half=BLOCK * PIXEL / 2,
    )
