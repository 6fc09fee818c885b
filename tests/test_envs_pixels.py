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


FORKED = """
import gymnasium, numpy as np, velap.envs
make = lambda: gymnasium.make("velap/SpiralMaze-v0")
first = make().reset(seed=0)[0]
vector = gymnasium.vector.AsyncVectorEnv([make] * 2, context="fork")
frames, _ = vector.reset(seed=[0, 0])
vector.close()
print(first.std() > 0, np.array_equal(frames, [first, first]))
"""


def test_forked_environments_draw_the_same_frames_as_their_parent():
    """A process of its own is forked: this one has threads, and a lock that one of them holds stays held in a child."""
    done = subprocess.run([sys.executable, "-c", FORKED], capture_output=True, text=True, timeout=110)
    assert done.stdout.split() == ["True", "True"], done.stderr


def test_a_black_frame_is_an_error_that_names_the_packages(monkeypatch):
    env = make("SpiralMaze")
    monkeypatch.setattr(pixels.mujoco, "mjr_readPixels", lambda rgb, *_: rgb.fill(0))
    with pytest.raises(RenderError, match=r"one value, 0.*libegl1 libgl1-mesa-dri.*libosmesa6"):
        env.reset(seed=0)


def failing(*broken: str):
    return lambda backend: f"no library for {backend}" if backend in broken else None


def test_the_first_backend_that_draws_is_chosen_and_set(monkeypatch):
    for broken, chosen in ((), "egl"), (("egl",), "osmesa"), (("egl", "osmesa"), "glfw"):
        monkeypatch.setenv("MUJOCO_GL", "on")
        monkeypatch.setattr(gl, "_probe", failing(*broken))
        assert gl.choose_backend() == chosen == os.environ["MUJOCO_GL"]


def test_every_failed_backend_is_named_with_its_reason(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL")
    monkeypatch.setattr(gl, "_probe", failing(*gl.BACKENDS))
    with pytest.raises(RenderError, match=r"library for egl; osmesa: .*; glfw: .*\(MUJOCO_GL is unset.*libosmesa6"):
        gl.choose_backend()
    assert "MUJOCO_GL" not in os.environ


def test_the_setting_decides_where_it_names_a_backend(monkeypatch):
    monkeypatch.setattr(gl, "_probe", failing(*gl.BACKENDS))
    for setting in ("EGL", " osmesa"):
        monkeypatch.setenv("MUJOCO_GL", setting)
        assert gl.choose_backend() == setting.lower().strip()


def test_a_probe_says_why_a_backend_does_not_draw(monkeypatch):
    assert gl._probe(gl.working_backend()) is None
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "99")
    monkeypatch.setenv("DISPLAY", "")
    assert "MUJOCO_EGL_DEVICE_ID" in gl._probe("egl")


def test_a_backend_that_fails_after_all_is_an_error_that_names_it(monkeypatch):
    monkeypatch.setattr(gl, "_working", ["none"])
    with pytest.raises(RenderError, match=r"backend none does not work here: ModuleNotFoundError.*libosmesa6"):
        gl.make_context(None, 64)


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
