"""Conformance of every registered task, frames, stacking, and what happens where nothing can be drawn."""

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import velap.envs  # noqa: F401 - registers the tasks
from velap.envs import gl, pixels
from velap.envs.spiral import PIXEL
from velap.errors import ConfigError, RenderError
from velap.tasks import TASKS

ALL_TASKS = sorted(TASKS)


def make(task: str) -> gymnasium.Env:
    return gymnasium.make(TASKS[task].env_id)


@pytest.mark.parametrize("task", ALL_TASKS)
@pytest.mark.filterwarnings("error")
def test_the_task_keeps_gymnasiums_contract(task):
    check_env(make(task).unwrapped)


@pytest.mark.parametrize("task", ALL_TASKS)
def test_observations_are_single_64_pixel_frames_and_actions_are_bounded(task):
    env = make(task)
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space.dtype == np.float32
    assert (env.action_space.low == -1).all()
    assert (env.action_space.high == 1).all()
    assert env.spec.max_episode_steps == TASKS[task].max_steps


@pytest.mark.parametrize("task", ALL_TASKS)
@pytest.mark.parametrize("split", ["train", "test"])
def test_a_seed_fixes_frames_and_physics(task, split):
    runs = []
    for _ in range(2):
        env = make(task)
        rng = np.random.default_rng(0)
        frames, positions = [env.reset(seed=7, options={"split": split})[0]], []
        for _ in range(20):
            frames.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0])
            positions.append(env.unwrapped.agent_position())
        runs.append((np.array(frames), np.array(positions)))
    np.testing.assert_array_equal(runs[0][0], runs[1][0])
    np.testing.assert_array_equal(runs[0][1], runs[1][1])
    env.reset(seed=8, options={"split": split})
    assert not np.array_equal(env.unwrapped.agent_position(), runs[0][1][0])


@pytest.mark.parametrize("task", ALL_TASKS)
def test_frames_are_owned_copies(task):
    env = make(task)
    frames = [env.reset(seed=0, options={"split": "train"})[0]]
    copies = [frames[0].copy()]
    for _ in range(3):
        frames.append(env.step(np.full(env.action_space.shape, 0.5, np.float32))[0])
        copies.append(frames[-1].copy())
    for i, frame in enumerate(frames):
        assert frame.flags.owndata
        assert frame.flags.c_contiguous
        np.testing.assert_array_equal(frame, copies[i])
        assert not any(np.shares_memory(frame, other) for other in frames[:i])


@pytest.mark.parametrize(
    "options", [{"split": "validation"}, {"spilt": "train"}, {"split": "train", "context": -1}, {"context": "a"}]
)
def test_unknown_reset_options_are_refused(options):
    with pytest.raises(ConfigError, match="expected split, one of"):
        make("SpiralMaze").reset(options=options)


def test_the_frame_shows_the_block_where_it_is_and_the_goal_in_red():
    env = make("SpiralMaze").unwrapped
    for position in env.free_positions(np.random.default_rng(0), 30):
        env.set_agent_position(position)
        frame = env.render().astype(int)
        blue = (frame[..., 2] > 150) & (frame[..., 0] < 100)
        rows, columns = np.nonzero(blue)
        left, right, bottom, top = env.extent
        x = left + (columns.mean() + 0.5) * (right - left) / 64
        y = top - (rows.mean() + 0.5) * (top - bottom) / 64
        assert 16 <= blue.sum() <= 25
        np.testing.assert_allclose([x, y], position, atol=0.51 * PIXEL)
    red = (frame[..., 0] > 150) & (frame[..., 1] < 100)
    goal = env.layout.goal
    assert red.sum() == pytest.approx((goal.x_max - goal.x_min) * (goal.y_max - goal.y_min) / PIXEL**2, abs=10)


def test_larger_frames_show_the_same_scene():
    env = make("SpiralMaze")
    small = env.reset(seed=0)[0]
    large = env.unwrapped.render(256)
    assert large.shape == (256, 256, 3)
    assert np.abs(large[2::4, 2::4].astype(int) - small).mean() < 3
    np.testing.assert_array_equal(env.unwrapped.render(), small)


def test_environments_of_one_kind_share_a_renderer():
    before = len(pixels._renderers)
    for _ in range(3):
        make("SpiralMaze").reset(seed=0)
    assert len(pixels._renderers) <= max(before, 1)


def test_forked_environments_draw_the_same_frames_as_their_parent():
    first = make("SpiralMaze").reset(seed=0)[0]
    vector = gymnasium.vector.AsyncVectorEnv([lambda: make("SpiralMaze")] * 2, context="fork")
    try:
        vector.reset_async(seed=[0, 0])
        frames, _ = vector.reset_wait(timeout=30)
    finally:
        vector.close(terminate=True)
    np.testing.assert_array_equal(frames, np.stack([first, first]))


def test_stacks_repeat_the_first_frame_then_slide():
    env = pixels.stack_frames(make("SpiralMaze"), 3)
    assert env.observation_space.shape == (3, 64, 64, 3)
    first, _ = env.reset(seed=0)
    np.testing.assert_array_equal(first, np.stack([first[2]] * 3))
    stacks = [env.step(np.array([1, 0], np.float32))[0] for _ in range(4)]
    newest = [first[2], *(stack[2] for stack in stacks)]
    np.testing.assert_array_equal(stacks[0], np.stack([newest[0], newest[0], newest[1]]))
    np.testing.assert_array_equal(stacks[3], np.stack(newest[2:5]))
    assert not np.array_equal(newest[3], newest[4])
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again, first)
    with pytest.raises(ConfigError, match="at least 1"):
        pixels.stack_frames(make("SpiralMaze"), 0)


def test_a_black_frame_is_an_error_that_names_the_packages(monkeypatch):
    env = make("SpiralMaze")
    monkeypatch.setattr(pixels.mujoco, "mjr_readPixels", lambda rgb, *_: rgb.fill(0))
    with pytest.raises(RenderError, match=r"one value, 0.*libegl1 libgl1-mesa-dri.*libosmesa6"):
        env.reset(seed=0)


def test_every_failed_backend_is_named_with_its_reason(monkeypatch):
    def broken(name: str) -> None:
        raise ImportError(f"no library for {name}")

    monkeypatch.setattr(gl, "_working", [])
    monkeypatch.setattr(gl, "_forget_platform", lambda platform: None)
    monkeypatch.setattr(gl.importlib, "import_module", broken)
    monkeypatch.setattr(gl, "backend_order", lambda: gl.BACKENDS)
    with pytest.raises(RenderError, match=r"mujoco\.egl;.*mujoco\.osmesa;.*mujoco\.glfw.*libosmesa6"):
        gl.make_context(None, 64)


@pytest.mark.parametrize(
    ("setting", "order"), [(None, gl.BACKENDS), ("", gl.BACKENDS), ("EGL", ("egl",)), ("osmesa", ("osmesa",))]
)
def test_mujoco_gl_decides_where_it_is_set(monkeypatch, setting, order):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if setting is not None:
        monkeypatch.setenv("MUJOCO_GL", setting)
    monkeypatch.setattr(gl, "_egl_draws", lambda: True)
    assert gl.backend_order() == order


def test_a_broken_egl_is_not_tried_where_osmesa_can_draw(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(gl, "_egl_draws", lambda: False)
    monkeypatch.setattr(gl.ctypes.util, "find_library", lambda name: "libOSMesa.so.8")
    assert gl.backend_order() == ("osmesa", "glfw")
    monkeypatch.setattr(gl.ctypes.util, "find_library", lambda name: None)
    assert gl.backend_order() == gl.BACKENDS


@pytest.mark.parametrize("setting", ["disable", "nonsense"])
def test_a_setting_that_cannot_draw_ends_in_a_render_error(setting):
    code = (
        "import gymnasium, velap.envs\nfrom velap.errors import RenderError\n"
        "try:\n    gymnasium.make('velap/SpiralMaze-v0').reset()\nexcept RenderError as error:\n    print(error)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "MUJOCO_GL": setting}, capture_output=True, text=True, check=True
    )
    assert repr(setting) in done.stdout
    assert "libegl1 libgl1-mesa-dri" in done.stdout


def test_importing_the_environments_loads_no_physics_and_draws_nothing():
    code = "import sys, velap.envs; print('mujoco' in sys.modules, 'OpenGL' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
