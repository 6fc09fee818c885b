"""SpiralMaze in MuJoCo: speed, walls, goal, expert, the share of successful transitions."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from velap.envs.mazes.env import MAX_SPEED, STEP_LENGTH, SpiralMaze
from velap.envs.mazes.spiral import PIXEL
from velap.errors import ConfigError
from velap.tasks import get_task


@pytest.fixture(scope="module")
def maze() -> SpiralMaze:
    return SpiralMaze()


def metres(x: float, y: float) -> np.ndarray:
    """Pixels from the lower left corner -> metres."""
    return (np.array([x, y]) - 32) * PIXEL


def overlap(maze: SpiralMaze) -> float:
    """How deep the block is in a wall, as a share of its side."""
    grown = np.array(
        [[r.x_min, r.y_min, r.x_max, r.y_max] for r in (w.grown(maze.layout.block_half) for w in maze.layout.walls)]
    )
    x, y = maze.agent_position()
    depth = np.min([x - grown[:, 0], grown[:, 2] - x, y - grown[:, 1], grown[:, 3] - y], axis=0)
    return max(0.0, depth.max()) / (2 * maze.layout.block_half)


@pytest.mark.parametrize(
    ("action", "speed"), [((1, 0), 1.0), ((1, 1), 1.0), ((0.3, 0.4), 0.5), ((7, 0), 1.0), ((0, 0), 0.0)]
)
def test_the_last_action_is_the_velocity_at_the_end_of_the_step(maze, action, speed):
    maze.set_agent_position(metres(7, 7))
    for _ in range(2):
        maze.advance(np.array(action, dtype=np.float32))
        assert np.linalg.norm(maze.data.qvel) == pytest.approx(speed * MAX_SPEED, abs=1e-3)


def test_actions_beyond_the_bounds_are_clipped_entry_by_entry(maze):
    ends = []
    for action in ([7.0, 0.5], [1.0, 0.5]):
        maze.set_agent_position(metres(7, 7))
        maze.advance(np.array(action))
        ends.append(maze.agent_position())
    np.testing.assert_array_equal(ends[0], ends[1])


def test_a_step_at_top_speed_is_one_step_length_long(maze):
    maze.set_agent_position(metres(20, 8))
    maze.advance(np.array([1, 0]))
    before = maze.agent_position()
    maze.advance(np.array([1, 0]))
    np.testing.assert_allclose(maze.agent_position() - before, [STEP_LENGTH, 0], atol=1e-5)
    maze.advance(np.array([-1, 0]))
    # turning round at top speed costs less than a fifth of the step
    assert 0 < (maze.agent_position() - before)[0] < 0.2 * STEP_LENGTH


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), angles=st.lists(st.floats(0, 2 * np.pi), min_size=3, max_size=3))
def test_walls_stop_the_block(maze, seed, angles):
    maze.set_agent_position(maze.free_positions(np.random.default_rng(seed), 1)[0])
    for angle in angles:
        for _ in range(9):
            before = maze.agent_position()
            maze.advance(np.array([np.cos(angle), np.sin(angle)]))
            assert overlap(maze) < 0.05
            # both ends inside one corridor and a step shorter than a wall is thick: nothing was tunnelled
            assert np.linalg.norm(maze.agent_position() - before) <= STEP_LENGTH * 1.02
            assert (
                abs(
                    maze.layout.geodesic(maze.layout.nearest_free(maze.agent_position()))
                    - maze.layout.geodesic(maze.layout.nearest_free(before))
                )
                < 2 * STEP_LENGTH
            )


def test_a_push_into_a_wall_for_a_hundred_steps_goes_nowhere(maze):
    maze.set_agent_position(metres(20, 10))
    for _ in range(100):
        maze.advance(np.array([0, 1]))
    np.testing.assert_allclose(maze.agent_position() / PIXEL + 32, [20, 10.75], atol=0.1)


@pytest.mark.parametrize(
    ("start", "action", "axis"), [((40, 53.25), (-1, -1), 0), ((30, 10.75), (1, 1), 0), ((41.25, 26), (-1, 1), 1)]
)
def test_the_block_slides_along_walls_and_past_their_corners(maze, start, action, axis):
    maze.set_agent_position(metres(*start))
    before = maze.agent_position()
    for _ in range(12):
        maze.advance(np.array(action))
    assert abs(maze.agent_position() - before)[axis] == pytest.approx(12 * STEP_LENGTH * np.sqrt(0.5), rel=0.03)


@pytest.mark.parametrize("action", [[np.nan, 0.0], [np.inf, 0.0], [0.0], [0.0, 0.0, 0.0]])
def test_actions_that_are_no_velocities_are_refused(maze, action):
    with pytest.raises(ConfigError, match="finite numbers"):
        maze.step(np.array(action))


def test_success_is_the_block_centre_in_the_red_region(maze):
    maze.set_agent_position(metres(30.5, 32))
    assert maze.advance(np.array([0, 0])) is False
    _, reward, terminated, truncated, info = maze.step(np.array([1, 0]))
    assert maze.layout.goal.contains(maze.agent_position())
    assert (reward, terminated, truncated, info["success"]) == (1.0, True, False, True)


@pytest.mark.parametrize("position", [(0.0, 5.0), metres(14, 14), metres(4, 8), (0.1,)])
def test_positions_where_the_block_does_not_fit_are_refused(maze, position):
    with pytest.raises(ConfigError, match="does not fit"):
        maze.set_agent_position(np.array(position))


def test_test_starts_lie_in_their_area_and_train_starts_everywhere(maze):
    tests, trains = [], []
    for seed in range(100):
        maze.reset(seed=seed)
        tests.append(maze.agent_position())
        maze.reset(seed=seed, options={"split": "train"})
        trains.append(maze.agent_position())
    assert maze.layout.test_starts.contains(np.array(tests)).all()
    assert np.ptp(tests, axis=0).min() > 2 * PIXEL
    steps = maze.geodesic_steps(np.array(trains))
    assert np.histogram(steps, bins=5, range=(0, 155))[0].min() >= 8
    assert not maze.layout.goal.contains(np.array(trains)).any()


@pytest.mark.parametrize("seed", range(3))
def test_an_expert_on_the_shortest_path_takes_150_steps(maze, seed):
    maze.reset(seed=seed)
    steps = next(step for step in range(1, 301) if maze.advance(maze.expert_action()))
    assert 135 <= steps <= 165


def test_random_walks_succeed_in_about_0_12_percent_of_transitions(maze):
    """The recipe of Table 10, without frames; the mean of many seeds is 0.12, its standard deviation over seeds 0.023."""
    recipe = get_task("SpiralMaze").recipe
    transitions = successes = 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        maze.reset(seed=seed)
        for _ in range(recipe.trajectories):
            maze.start({"split": "train"})
            action = rng.uniform(-1, 1, 2)
            for _ in range(recipe.max_steps):
                transitions += 1
                if maze.advance(action):
                    successes += 1
                    break
                action = np.clip(action + rng.normal(0, recipe.action_noise, 2), -1, 1)
    assert 0.08 <= 100 * successes / transitions <= 0.20
