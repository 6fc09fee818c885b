"""Plane geometry of the mazes: free space, exact shortest paths, the 150 steps of SpiralMaze."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from velap.envs.mazes.env import STEP_LENGTH
from velap.envs.mazes.geometry import Layout, Rect, frame_walls, polyline_walls
from velap.envs.mazes.spiral import PIXEL, spiral_layout


@pytest.fixture(scope="module")
def spiral() -> Layout:
    return spiral_layout()


def one_wall() -> Layout:
    """A block of half side 1 in a 20 × 20 room, a wall from the left to x = 10 at y = 9..11, the goal above it."""
    space = Rect(0, 0, 20, 20)
    return Layout(space, (*frame_walls(space, 1), Rect(0, 9, 10, 11)), Rect(2, 15, 4, 18), Rect(2, 2, 4, 4), block_half=1.0)


def test_shortest_path_round_one_wall_is_the_hand_computed_one():
    layout = one_wall()
    start = np.array([3.0, 8.0])
    # corners of the grown wall: (11, 8) and (11, 12); from there to the goal's lower right corner (4, 15)
    expected = 8.0 + 4.0 + np.hypot(7, 3)
    assert layout.geodesic(start) == pytest.approx(expected, abs=1e-12)
    np.testing.assert_allclose(layout.shortest_path(start), [[3, 8], [11, 8], [11, 12], [4, 15]])


def test_straight_paths_end_at_the_nearest_point_of_the_goal():
    layout = one_wall()
    np.testing.assert_allclose(
        layout.geodesic(np.array([[10.0, 16.0], [3.0, 16.0], [7.0, 13.0]])), [6.0, 0.0, np.hypot(3, 2)]
    )


def test_free_space_is_the_room_less_half_a_block():
    layout = one_wall()
    points = np.array(
        [[2.0, 2.0], [1.99, 2.0], [11.0, 10.0], [10.99, 10.0], [5.0, 8.0], [5.0, 8.01], [-3.0, 2.0], [18.0, 18.0]]
    )
    assert layout.is_free(points).tolist() == [True, False, True, False, True, False, False, True]


def test_segments_may_slide_along_walls_but_not_cross_them():
    layout = one_wall()
    starts = np.array([[3.0, 8.0], [3.0, 8.1], [3.0, 5.0], [11.0, 5.0], [10.9, 5.0], [3.0, 3.0]])
    ends = np.array([[11.0, 8.0], [11.0, 8.1], [3.0, 15.0], [11.0, 15.0], [10.9, 15.0], [3.0, 3.0]])
    assert layout.sees(starts, ends).tolist() == [True, False, False, True, False, True]


def test_a_sealed_room_has_no_path():
    space = Rect(0, 0, 20, 20)
    layout = Layout(
        space, (*frame_walls(space, 1), Rect(0, 9, 20, 11)), Rect(2, 15, 4, 18), Rect(2, 2, 4, 4), block_half=1.0
    )
    assert np.isinf(layout.geodesic(np.array([5.0, 5.0])))
    with pytest.raises(ValueError, match="no path"):
        layout.shortest_path(np.array([5.0, 5.0]))


def test_a_goal_that_holds_a_wall_corner_is_refused():
    space = Rect(0, 0, 20, 20)
    layout = Layout(space, (Rect(9, 9, 11, 11),), Rect(10, 10, 15, 15), Rect(2, 2, 4, 4), block_half=1.0)
    with pytest.raises(ValueError, match="wall corner inside the goal"):
        _ = layout.reachable_goal


def test_polyline_walls_overlap_at_their_corners():
    first, second = polyline_walls([(0, 0), (10, 0), (10, 5)], thickness=2)
    assert first == Rect(-1, -1, 11, 1)
    assert second == Rect(9, -1, 11, 6)


def test_every_test_start_is_150_steps_from_the_goal(spiral):
    starts = spiral.test_starts.sample(np.random.default_rng(0), 5000)
    area = spiral.test_starts
    corners = [[x, y] for x in (area.x_min, area.x_max) for y in (area.y_min, area.y_max)]
    starts = np.concatenate([starts, corners])
    assert spiral.is_free(starts).all()
    steps = spiral.geodesic(starts) / STEP_LENGTH
    assert steps.min() >= 140
    assert steps.max() <= 160


def test_paths_are_free_and_as_long_as_the_distance_says(spiral):
    for start in spiral.sample_free(np.random.default_rng(1), 100):
        path = spiral.shortest_path(start)
        legs = np.linalg.norm(np.diff(path, axis=0), axis=-1)
        assert legs.sum() == pytest.approx(spiral.geodesic(start), abs=1e-9)
        between = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in pairwise(path)])
        assert spiral.is_free(between).all()
        assert spiral.goal.contains(path[-1])


def test_the_distance_agrees_with_dijkstra_on_a_fine_grid(spiral):
    """Eight-connected grid paths are longer than straight ones, by at most a factor of 1 / cos(π/8)."""
    spacing = PIXEL / 2
    axis = np.arange(-0.9, 0.9, spacing)
    grid = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1)
    free = spiral.is_free(grid)
    number = np.where(free, np.cumsum(free).reshape(free.shape) - 1, -1)
    rows, columns, weights = [], [], []
    for dx, dy in ((1, 0), (0, 1), (1, 1), (1, -1)):
        a = number[: len(axis) - dx, max(0, -dy) : len(axis) - max(0, dy)]
        b = number[dx:, max(0, dy) : len(axis) - max(0, -dy)]
        pairs = (a >= 0) & (b >= 0)
        rows.append(a[pairs])
        columns.append(b[pairs])
        weights.append(np.full(pairs.sum(), spacing * np.hypot(dx, dy)))
    graph = coo_array((np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns))), shape=(free.sum(),) * 2)
    points = grid[free]
    goals = np.flatnonzero(spiral.goal.contains(points))
    by_grid = dijkstra(graph.tocsr(), directed=False, indices=goals, min_only=True)
    exact = spiral.geodesic(points)
    assert np.isfinite(by_grid).all()
    assert (by_grid >= exact - 1e-9).all()
    assert (by_grid <= exact / np.cos(np.pi / 8) + 30 * spacing).all()


def test_distance_changes_by_no_more_than_the_way(spiral):
    rng = np.random.default_rng(2)
    points = spiral.sample_free(rng, 2000)
    moved = points + rng.normal(0, 0.03, points.shape)
    straight = spiral.is_free(moved) & spiral.sees(points, moved)
    assert straight.sum() > 1000
    change = np.abs(spiral.geodesic(points[straight]) - spiral.geodesic(moved[straight]))
    assert (change <= np.linalg.norm(points[straight] - moved[straight], axis=-1) + 1e-9).all()


def test_free_samples_are_free_uniform_and_outside_the_goal(spiral):
    points = spiral.sample_free(np.random.default_rng(3), 20_000)
    assert points.shape == (20_000, 2)
    assert spiral.is_free(points).all()
    assert not spiral.goal.contains(points).any()
    pixels = points / PIXEL + 32
    # free cell of 5.5 × 5.5 px at the start against the straight of 43.5 × 5.5 px beside it: shares as their areas
    corner = ((pixels < 10.75) & (pixels > 5.25)).all(-1).mean()
    bottom = ((pixels[:, 1] < 10.75) & (pixels[:, 0] > 10.75) & (pixels[:, 0] < 53.25)).mean()
    assert corner / bottom == pytest.approx(5.5 / 42.5, rel=0.1)
    assert spiral.sample_free(np.random.default_rng(0), 0).shape == (0, 2)


def test_nearest_free_pushes_a_point_out_of_a_wall(spiral):
    inside = (np.array([5.0, 8.0]) - 32) * PIXEL
    np.testing.assert_allclose(spiral.nearest_free(inside) / PIXEL + 32, [5.25, 8.0])
    free = (np.array([8.0, 8.0]) - 32) * PIXEL
    np.testing.assert_array_equal(spiral.nearest_free(free), free)
