"""Drawing of the manipulation tasks: the same scene as Meta-World's geometry, from one view that shows what matters."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from itertools import product
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from studies.bake_meshes import SITES
from velap.envs import gl
from velap.envs.pixels import shared_renderer
from velap.envs.sawyer.scene import SHOWN_GROUPS, VIEW, SawyerScene, load_drawing
from velap.envs.sawyer.view import View
from velap.errors import RenderError
from velap.tasks import TASKS

JOINTS = {"WindowClose": ("window_slide", 0.2, 0.0, 40), "FaucetClose": ("knob_Joint_1", 0.0, -1.4, 20),
          "ButtonWall": ("btnbox_joint", 0.0, -0.06, 10), "DrawerButton": ("goal_slidey", -0.15, 0.0, 80)}
"""Joint of the object, its value at the start and when done [m or rad], and how many pixels that changes at least [px]."""

REFERENCE = Path(__file__).parent / "reference" / "sawyer_frames.npz"
"""Frames by the drawing that the datasets and checkpoints were made with, and the OpenGL that drew them."""

CODE = """
import gymnasium, hashlib, numpy as np, velap.envs
env = gymnasium.make("velap/WindowClose-v0").unwrapped
env.reset(seed=3)
rng = np.random.default_rng(0)
frames = [env.step(rng.uniform(-1, 1, 4).astype(np.float32))[0] for _ in range(10)]
print(hashlib.sha256(np.stack(frames).tobytes()).hexdigest())
"""


def make(task: str, seed: int = 0) -> Any:
    env: Any = gymnasium.make(TASKS[task].env_id).unwrapped
    env.reset(seed=seed)
    return env


@pytest.fixture(scope="module", params=sorted(JOINTS))
def env(request: pytest.FixtureRequest) -> Any:
    return make(request.param)


@pytest.fixture(scope="module")
def window() -> Any:
    return make("WindowClose")


def original_frame(env: Any) -> NDArray[np.int64]:
    """The same view of Meta-World's own geometry, without shadows, reflections and goal marks."""
    model, state = env.model.__copy__(), env.data.__copy__()
    for site in range(model.nsite):
        model.site_group[site] = 0 if model.site(site).name in SITES else SHOWN_GROUPS
    model.cam_fovy[0] = VIEW.fovy
    state.cam_xpos[0], state.cam_xmat[0] = VIEW.position, VIEW.axes.T.ravel()
    return shared_renderer(f"original {env.assets}", model, 64).draw(model, state).astype(int)


def scene_of(env: Any) -> SawyerScene:
    return SawyerScene(load_drawing(env.assets), env.model)


def changed(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> int:
    """Pixels that differ visibly."""
    return int((np.abs(first.astype(int) - second).max(-1) > 30).sum())


def cyan(frame: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Middle (column, row) of the left finger, the only cyan thing [px]."""
    red, green, blue = np.moveaxis(frame.astype(int), -1, 0)
    rows, columns = np.nonzero((blue > 100) & (green > 100) & (red < 60))
    assert len(rows) >= 3
    return np.array([columns.mean(), rows.mean()]) + 0.5


def place_hand(env: Any, position: tuple[float, float, float]) -> None:
    """Bring the hand to a position [m]."""
    env._settle(np.array(position))


def reference_frames(task: str) -> NDArray[np.uint8]:
    """Three states of a task, uint8 [3, 64, 64, 3]."""
    env: Any = gymnasium.make(TASKS[task].env_id).unwrapped
    frames = []
    for seed in range(3):
        env.reset(seed=seed, options={"split": "train"})
        for action in np.random.default_rng(seed).uniform(-1, 1, (5, 4)):
            env.advance(action)
        frames.append(env.render())
    return np.stack(frames)


def gl_version() -> str:
    """What draws here, once something was drawn."""
    from OpenGL import GL

    make("WindowClose").render()
    return b" ".join(GL.glGetString(name) for name in (GL.GL_RENDERER, GL.GL_VERSION)).decode()


@pytest.mark.parametrize("task", sorted(JOINTS))
def test_frames_are_those_of_the_released_datasets(task: str) -> None:
    """Pixel for pixel where the same OpenGL draws; other drivers round a few edges otherwise."""
    with np.load(REFERENCE) as file:
        expected, drawn_by = file[task], str(file["gl"])
    frames = reference_frames(task)
    if gl_version() == drawn_by:
        np.testing.assert_array_equal(frames, expected)
    assert np.abs(frames.astype(int) - expected).mean() < 0.3


def test_it_looks_like_metaworlds_own_geometry() -> None:
    env, differences = make("WindowClose"), []
    for seed in (50, 51):
        env.reset(seed=seed)
        for step in range(300):
            if step % 15 == 0:
                differences.append(np.abs(original_frame(env) - env.render()))
            if env.advance(env.expert_action()):
                break
        differences.append(np.abs(original_frame(env) - env.render()))
    assert len(differences) >= 10
    assert env.render().std() > 30
    assert np.mean(differences) < 3
    assert np.percentile(np.max(differences, -1), 99) < 40


def test_the_bound_notices_what_is_missing(window: Any) -> None:
    """The same measure on a frame without the arm is far outside of the bound."""
    original = original_frame(window)
    scene = scene_of(window)
    assert np.abs(original - scene.draw(window.model, window.data)).mean() < 3
    red = scene.model.mat_rgba[:, 0] == 0.5
    scene.model.mat_rgba[red] = 0
    bare = np.abs(original - scene.draw(window.model, window.data)).max(-1)
    assert np.percentile(bare, 99) > 80


def test_few_triangles_are_left(env: Any) -> None:
    scene = scene_of(env)
    shown = env.model.geom_group < SHOWN_GROUPS
    meshes = env.model.geom_dataid[shown & (env.model.geom_type == 7)]
    assert env.model.mesh_facenum[meshes].sum() > 60_000
    assert scene.model.mesh_facenum.sum() < 9_000
    scene.draw(env.model, env.data)
    drawn = scene.model.geom_dataid[(scene.model.geom_group == 0) & (scene.model.geom_dataid >= 0)]
    assert scene.model.mesh_facenum[drawn].sum() < 6_500
    assert scene.model.ngeom < 35


def test_frames_are_owned_and_repeat(env: Any) -> None:
    frames = [env.render() for _ in range(3)]
    for frame in frames:
        assert frame.shape == (64, 64, 3)
        assert frame.dtype == np.uint8
        assert frame.flags.owndata
        np.testing.assert_array_equal(frame, frames[0])
    assert not np.shares_memory(frames[0], frames[1])
    fresh = scene_of(env).draw(env.model, env.data)
    np.testing.assert_array_equal(fresh, frames[0])


def test_a_new_process_draws_the_same_frames() -> None:
    env = make("WindowClose", seed=3)
    rng = np.random.default_rng(0)
    frames = [env.step(rng.uniform(-1, 1, 4).astype(np.float32))[0] for _ in range(10)]
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == hashlib.sha256(np.stack(frames).tobytes()).hexdigest()


def test_drawing_does_not_touch_the_physics(env: Any) -> None:
    fields = [(env.data, name) for name in ("qpos", "qvel", "xpos", "mocap_pos", "geom_xpos", "cam_xpos", "time")]
    fields += [(env.model, name) for name in ("body_pos", "geom_group", "geom_rgba", "cam_fovy", "site_group")]
    before = [np.array(getattr(owner, name)) for owner, name in fields]
    env.render()
    original_frame(env)
    for (owner, name), value in zip(fields, before, strict=True):
        np.testing.assert_array_equal(getattr(owner, name), value, err_msg=name)


def test_the_state_of_the_object_shows(env: Any) -> None:
    joint, start, done, pixels = JOINTS[type(env).__name__]
    place_hand(env, (-0.35, 0.42, 0.2))
    frames = []
    for value in (start, done):
        env.set_joint(joint, value)
        gl.mujoco.mj_forward(env.model, env.data)
        frames.append(env.render())
    assert changed(*frames) >= pixels


def test_objects_are_drawn_where_the_episode_has_them(window: Any) -> None:
    scene = scene_of(window)
    frames = []
    for x in (-0.08, 0.08):
        window.model.body("window").pos = x, 0.8, 0.2
        gl.mujoco.mj_forward(window.model, window.data)
        frames.append(scene.draw(window.model, window.data))
        assert np.abs(original_frame(window) - frames[-1]).mean() < 3
    assert changed(*frames) > 150


def test_hands_stay_in_the_frame_and_fill_it(env: Any) -> None:
    low, high = env.hand_limits.low, env.hand_limits.high
    tips = np.array(list(product(*zip(low, high, strict=True)))) - [0.0, 0.0, 0.045]
    pixels = VIEW.pixels(tips, 64)
    assert pixels.min() > 2
    assert pixels.max() < 62
    assert np.ptp(pixels, axis=0).max() > 45


def test_the_camera_sees_the_finger_where_the_view_projects_it(window: Any) -> None:
    for position in ((-0.3, 0.5, 0.25), (0.0, 0.45, 0.1), (0.3, 0.55, 0.2)):
        place_hand(window, position)
        expected = VIEW.pixels(window.data.geom("leftpad_geom").xpos, 64)
        assert np.abs(cyan(window.render()) - expected).max() < 2


def test_a_way_along_each_axis_moves_the_hand_in_the_frame(window: Any) -> None:
    place_hand(window, (0.0, 0.5, 0.15))
    middle = cyan(window.render())
    moves = []
    for axis in range(3):
        position = np.array([0.0, 0.5, 0.15])
        position[axis] += 0.1
        place_hand(window, tuple(position))
        moves.append(cyan(window.render()) - middle)
    assert np.linalg.norm(moves, axis=1).min() > 4
    right, away, up = moves
    assert up[1] < -4  # right side up
    assert right[0] > 2 and right[1] > 2  # to the camera, which stands to the right: down in the frame
    assert away[0] > 4 and abs(away[1]) < abs(right[1])


def test_goal_marks_are_not_drawn(env: Any) -> None:
    """Meta-World's green balls would tell the agent where to go."""
    red, green, blue = np.moveaxis(env.render().astype(int), -1, 0)
    assert not ((green > 100) & (red < 60) & (blue < 60)).any()


def test_leaving_out_what_is_beside_the_frame_changes_no_pixel(env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, rng = scene_of(env), np.random.default_rng(0)
    left_out = 0
    for _ in range(5):
        place_hand(env, tuple(env.hand_limits.sample(rng)))
        fast = scene.draw(env.model, env.data)
        left_out += int((scene.model.geom_group > 0).sum())
        with monkeypatch.context() as patch:
            patch.setattr(View, "beside", lambda self, centres, *_: np.zeros(len(centres), bool))
            np.testing.assert_array_equal(scene.draw(env.model, env.data), fast)
    assert left_out > 0


def test_larger_frames_show_the_same_scene(window: Any) -> None:
    small, large = window.render(), window.render(256)
    assert large.shape == (256, 256, 3)
    assert np.median(np.abs(large[2::4, 2::4].astype(int) - small)) < 5
    np.testing.assert_array_equal(window.render(), small)


def test_the_backend_has_a_name_once_something_was_drawn(window: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    window.render()
    assert gl.working_backend() in gl.BACKENDS
    monkeypatch.setattr(gl, "_working", [])
    with pytest.raises(RenderError, match="nothing has been drawn yet"):
        gl.working_backend()
