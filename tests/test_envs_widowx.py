"""The WidowX arm, its webcam, its two tasks and the data of their operator."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from velap.data.behaviours import run_trajectory
from velap.data.gamepad import gamepad_play, gamepad_purpose
from velap.envs.gl import mujoco
from velap.envs.pixels import Renderer
from velap.envs.widowx import rope
from velap.envs.widowx.arm import ACTION_SCALE, HOME, JOINTS, ROTATION_SCALE, Kinematics
from velap.envs.widowx.experts import go
from velap.envs.widowx.rope import Rope, lay
from velap.envs.widowx.sponge import REGION, Sponge
from velap.envs.widowx.task import LEASH, MAX_ROTATION, WidowXTask
from velap.envs.widowx.webcam import EXPOSURE_SPREAD, NOISE, Webcam
from velap.tasks import TASKS, make_config

LIMITS = np.radians([[-180, 180], [-80, 113], [-108, 93], [-100, 123], [-180, 180]])
"""Joint limits of Interbotix's wx200.urdf.xacro [rad]."""


@pytest.fixture(scope="module")
def sponge() -> Sponge:
    return Sponge()


@pytest.fixture(scope="module")
def roped() -> Rope:
    return Rope()


def hand_at(task: WidowXTask, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] [m] and axes [3, 3] of the end effector for joint angles [5] [rad]."""
    data = mujoco.MjData(task.model)
    for name, angle in zip(JOINTS, joints, strict=True):
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(task.model, data)
    return data.site("ee").xpos.copy(), data.site("ee").xmat.reshape(3, 3).copy()


def test_the_arm_has_the_links_and_joint_limits_of_a_widowx_200(sponge):
    position, axes = hand_at(sponge, np.zeros(5))
    np.testing.assert_allclose(position, [0.05 + 0.2 + 0.065 + 0.093575, 0, 0.072 + 0.03865 + 0.2], atol=1e-9)
    np.testing.assert_allclose(axes, np.eye(3), atol=1e-9)
    limits = [sponge.model.joint(name).range for name in JOINTS]
    np.testing.assert_allclose(limits, LIMITS, atol=1e-4)


@pytest.mark.parametrize("kind", [Sponge, Rope])
def test_inverse_kinematics_reaches_every_corner_of_the_workspace(kind):
    task, solver = kind(), Kinematics()
    for x in (kind.low[0], kind.high[0]):
        for y in (kind.low[1], kind.high[1]):
            for z in (kind.low[2], kind.high[2]):
                for rotation in (-MAX_ROTATION, 0.3, MAX_ROTATION):
                    joints = solver.solve(np.array([x, y, z]), rotation)
                    assert ((joints > LIMITS[:, 0]) & (joints < LIMITS[:, 1])).all()
                    position, axes = hand_at(task, joints)
                    np.testing.assert_allclose(position, [x, y, z], atol=1e-6)
                    np.testing.assert_allclose(axes[:, 0], [0, 0, -1], atol=1e-6)  # straight down
                    np.testing.assert_allclose(axes[:, 1], [-np.sin(rotation), np.cos(rotation), 0], atol=1e-6)


def test_a_pose_out_of_reach_stays_within_the_joint_limits():
    joints = Kinematics().solve(np.array([0.05, 0.0, 0.02]), 0.0)
    assert ((joints >= LIMITS[:, 0] - 1e-6) & (joints <= LIMITS[:, 1] + 1e-6)).all()
    assert not np.allclose(joints, HOME)


@pytest.mark.parametrize("axis", range(4))
def test_an_action_moves_the_hand_along_its_axis(sponge, axis):
    sponge.start({"split": "test"}, 5)
    sponge.set_hand(np.array([0.25, 0.0, 0.08]), 0.1)
    mujoco.mj_forward(sponge.model, sponge.data)
    action = np.zeros(4)
    action[axis] = -1.0
    for _ in range(4):
        sponge.advance(action)
    for _ in range(10):
        sponge.advance(np.zeros(4))
    moved = sponge.agent_position() - (0.25, 0.0, 0.08)
    across = sponge.data.site("ee").xmat.reshape(3, 3)[:, 1]
    turned = np.arctan2(-across[0], across[1]) - 0.1
    np.testing.assert_allclose(moved, 4 * ACTION_SCALE * action[:3], atol=1e-3)
    assert turned == pytest.approx(4 * ROTATION_SCALE * action[3], abs=5e-3)  # the wrist's friction


def test_the_command_stays_in_the_workspace_and_near_the_hand(roped):
    roped.start({"split": "test"}, 5)
    for _ in range(60):  # the taut rope holds the hand back
        roped.advance(np.array([1.0, 1.0, -1.0, 1.0]))
        position, rotation = roped.command()
        assert (np.abs(position - roped.agent_position()) < LEASH + ACTION_SCALE).all()
        assert (position >= roped.low).all() and (position <= roped.high).all()
        assert abs(rotation) <= MAX_ROTATION
    before = roped.agent_position()
    for _ in range(4):
        roped.advance(np.array([-1.0, -1.0, 0.0, 0.0]))
    assert (roped.agent_position() - before)[:2].max() < -0.01


def test_the_webcam_depends_on_seed_and_time_alone():
    grey = np.full((64, 64, 3), 128, np.uint8)

    def film(seed: int, looks: int) -> np.ndarray:
        webcam, frames = Webcam(seed), []
        for _ in range(5):
            frames.append([webcam.expose(grey) for _ in range(looks)][-1])
            webcam.tick()
        return np.array(frames)

    np.testing.assert_array_equal(film(3, 1), film(3, 4))
    assert not np.array_equal(film(3, 1), film(4, 1))
    assert not np.array_equal(*film(3, 1)[:2])


def test_the_webcam_has_slight_noise_and_a_slow_exposure():
    grey, means = np.full((64, 64, 3), 128, np.uint8), []
    for seed in range(60):
        webcam = Webcam(seed)
        frame = webcam.expose(grey)
        assert frame.std() == pytest.approx(NOISE, rel=0.1)
        means.append([])
        for _ in range(40):
            means[-1].append(webcam.expose(grey).mean() / 128 - 1)
            webcam.tick()
    exposure = np.array(means)
    assert exposure.std() == pytest.approx(EXPOSURE_SPREAD, rel=0.35)
    assert 0 < np.abs(np.diff(exposure, axis=1)).mean() < EXPOSURE_SPREAD / 4


def test_frames_have_shadows(sponge):
    sponge.start({"split": "test"}, 0)
    with_shadows, without = (Renderer(sponge.model, 64, side).draw(sponge.model, sponge.data) for side in (128, 0))
    darker = with_shadows.astype(int).sum(-1) < without.astype(int).sum(-1) - 60
    assert 0.02 < darker.mean() < 0.4


@pytest.mark.parametrize("kind", [Sponge, Rope])
def test_a_core_makes_many_steps_a_second_with_pixels(kind):
    """Processor time of this process, best of some rounds, so that other processes hardly matter."""
    task, rng, rounds = kind(), np.random.default_rng(0), []
    task.reset(seed=1000)
    for _ in range(6):
        began = time.process_time()
        for _ in range(50):
            task.step(rng.uniform(-1, 1, 4).astype(np.float32))
        rounds.append((time.process_time() - began) / 50)
    assert min(rounds[1:]) < 0.0125, "below 5 ms on a recent core, 6.3 ms on one without AVX-512"


@pytest.mark.parametrize("seed", range(1000, 1005))
def test_the_hand_starts_between_sponge_and_region(sponge, seed):
    sponge.start({"split": "test"}, seed)
    assert sponge.sponge()[1] + 0.03 < sponge.agent_position()[1] < REGION[1] - 0.03
    assert sponge.expert_distance() > 0.15
    assert sponge.data.ncon == 4  # the sponge on the table, nothing else


def test_going_straight_for_the_sponge_pushes_it_away_from_the_region(sponge):
    for seed in range(1000, 1003):
        sponge.start({"split": "test"}, seed)
        before = sponge.expert_distance()
        for _ in range(60):
            assert not sponge.advance(go(sponge, np.append(sponge.sponge()[:2], 0.03)))
        assert sponge.expert_distance() > before


@pytest.mark.parametrize("sweep", [-225, -90, 5, 60, 135])
def test_a_rope_is_laid_at_its_length_round_the_pole(sweep):
    angle, turned = -np.pi / 2, np.radians(sweep - 90)
    end = np.array([0.08 * np.cos(turned), 0.08 * np.sin(turned), 0.04])
    corners = lay(np.radians(sweep), rope.CLAMP, end, angle, 0.2)
    assert corners is not None
    np.testing.assert_allclose(corners[[0, -1]], [rope.CLAMP, end], atol=1e-9)
    links = np.linalg.norm(np.diff(corners, axis=0), axis=-1)
    np.testing.assert_allclose(links, 0.2 / rope.SEGMENTS, rtol=0.1)  # chords of a curve, the last hairpin's aside
    assert np.hypot(*corners[:, :2].T).min() > rope.POLE_RADIUS
    swept = np.unwrap(np.arctan2(corners[:, 1], corners[:, 0]))
    assert np.degrees(swept[-1] - swept[0]) == pytest.approx(sweep, abs=1e-6)


def test_a_rope_that_is_too_short_cannot_be_laid():
    assert lay(np.radians(-225), rope.CLAMP, np.array([0.1, 0.1, 0.04]), -np.pi / 2, 0.15) is None


def test_the_wrapped_rope_keeps_the_hand_out_of_the_region(roped):
    """It is held back by the rope; the arm does not tear it off or drag it over the pole."""
    for seed in range(1000, 1004):
        roped.start({"split": "test"}, seed)
        assert np.degrees(roped.sweep()) < -180 and not roped.unwound()
        for _ in range(60):
            assert not roped.advance(go(roped, np.append(roped.region()[:2], 0.035)))
        assert np.hypot(*(roped.agent_position() - roped.region())[:2]) > rope.REGION_RADIUS
        assert np.degrees(roped.sweep()) < -180
        assert np.linalg.norm(roped.data.site("tip").xpos - roped.agent_position()) < 0.005
        assert np.linalg.norm(np.diff(roped.points(), axis=0), axis=-1)[:-1] == pytest.approx(rope.LENGTH / rope.SEGMENTS)


def test_only_an_unwound_rope_on_the_region_is_a_success(roped):
    roped.start({"split": "test"}, 1000)
    while not roped.advance(roped.expert_action()):
        pass
    assert roped.unwound() and roped.sweep() > 0
    assert np.hypot(*(roped.agent_position() - roped.region())[:2]) <= rope.REGION_RADIUS
    for _ in range(4):
        lifted = roped.advance(np.array([0.0, 0.0, 1.0, 0.0]))
    assert not lifted


@pytest.mark.parametrize("behaviour", [gamepad_play, gamepad_purpose])
@pytest.mark.parametrize("name", ["Sponge", "Rope"])
def test_the_operator_has_a_gamepads_habits(request, behaviour: Callable[..., Any], name):
    world = request.getfixturevalue("sponge" if name == "Sponge" else "roped")
    actions = []
    for seed in range(6):
        world.start({"split": "train"}, seed)
        act = behaviour(world, TASKS[name].recipe, np.random.default_rng(seed))
        for _ in range(100):
            actions.append(act(np.zeros((64, 64, 3), np.uint8)))
            world.advance(actions[-1])
    pressed = np.array(actions)
    assert set(np.abs(pressed).ravel()) <= {0.0, 0.5, 1.0}
    assert (pressed != 0).sum(-1).max() == 2
    assert 0.02 < (pressed == 0).all(-1).mean() < 0.5
    held = (np.diff(pressed, axis=0) == 0).all(-1).mean()
    assert held > 0.5


@pytest.mark.parametrize("name", ["Sponge", "Rope"])
def test_successes_of_the_data_start_near_the_goal(request, monkeypatch, name):
    """A fifth of the dataset, without frames."""
    world = request.getfixturevalue("sponge" if name == "Sponge" else "roped")
    monkeypatch.setattr(world, "render", lambda: np.zeros((64, 64, 3), np.uint8))
    recipe, distances = TASKS[name].recipe, []
    start = type(world).start

    def started(options: Any = None, seed: Any = None) -> None:
        start(world, options, seed)
        distances.append(world.expert_distance())

    monkeypatch.setattr(world, "start", started)
    runs = [run_trajectory(world, recipe, TASKS[name].shares, 7, context, 0) for context in range(recipe.contexts // 5)]
    won = np.array([run["rewards"].max() for run in runs]) > 0
    assert 0.05 < won.mean() < 0.6
    assert np.array(distances)[won].max() <= recipe.expert_radius
    assert sum(np.array(distances) > recipe.expert_radius) > len(runs) / 4
    assert all(run["from_test"] == 0 for run in runs)
    steps = sum(int(run["length"][0]) for run in runs)
    assert steps * 5 == pytest.approx(15_000, rel=0.15)


@pytest.mark.parametrize("name", ["Sponge", "Rope"])
def test_the_tasks_have_no_recipe_of_their_own(name):
    config, foreign = make_config(name), make_config("someone/elses-v0")
    assert (config.model, config.train, config.planner, config.controller) == (
        foreign.model, foreign.train, foreign.planner, foreign.controller)
    assert config.model.frame_stack == 3


def test_true_states_tell_what_frames_show(sponge, roped):
    sponge.start({"split": "train"}, 3)
    np.testing.assert_allclose(sponge.true_state()[4:7], sponge.sponge(), rtol=1e-6)
    np.testing.assert_allclose(sponge.objects(), sponge.sponge()[None])
    roped.start({"split": "test"}, 3)
    state = roped.true_state()
    np.testing.assert_allclose(state[4:-4].reshape(-1, 3) + roped.pole(), roped.points() + roped.pole(), atol=1e-6)
    np.testing.assert_allclose(state[-2:], roped.region()[:2], rtol=1e-6)
    assert roped.subtasks() == (False, False)
