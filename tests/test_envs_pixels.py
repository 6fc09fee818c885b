"""Frames, stacking, reset options, and what happens where nothing can be drawn."""

import os
import subprocess
import sys

import gymnasium
import numpy as np
import pytest

import velap.envs  # noqa: F401 - registers the tasks
from velap.envs import gl, pixels
from velap.envs.mazes.spiral import PIXEL
from velap.errors import ConfigError, RenderError
from velap.tasks import TASKS


def make(task: str) -> gymnasium.Env:
    return gymnasium.make(TASKS[task].env_id)


@pytest.mark.parametrize(
    "options", [{"split": "validation"}, {"spilt": "train"}, {"split": "train", "context": -1}, {"context": "a"}]
)
def test_unknown_reset_options_are_refused(options):
    with pytest.raises(ConfigError, match="expected split, one of"):
        make("SpiralMaze").reset(options=options)


def test_the_number_of_a_context_may_be_any_integer():
    env = make("SpiralMaze")
    frames = [env.reset(seed=0, options={"split": "train", "context": kind(3)})[0] for kind in (int, np.int64, np.uint8)]
    np.testing.assert_array_equal(frames[1:], frames[:1] * 2)
    with pytest.raises(ConfigError, match="an int from 0"):
        env.reset(options={"context": 1.0})


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
