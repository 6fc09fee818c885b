"""`velap inspect`: what is measured on data with known answers, and each fault by its name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from velap.cli import main
from velap.data.frames import FrameStore
from velap.data.survey import survey
from velap.report.inspect import find_problems, inspect, inspection_text, save_inspection

pytestmark = pytest.mark.filterwarnings("ignore:.*(go on after|end without a flag|bounds are taken)")

SIDE, EPISODES, STEPS, HELD = 32, 60, 60, 3
GOAL = 24
"""Column that succeeds [px]."""


def picture(x: float, y: float, scene: int = 0) -> np.ndarray:
    """A blob on a striped ground; each scene has a block of its own in the upper rows."""
    frame = np.full((SIDE, SIDE, 3), 120, np.uint8)
    frame[:, ::4] = 90
    frame[:6, (5 * scene) % 26 : (5 * scene) % 26 + 6] = (200, 40 + 30 * (scene % 6), 40)
    column, row = round(x), round(y)
    frame[row : row + 6, column : column + 6] = (30, 60, 230)
    return frame


def walks(scenes: int = 1, together: int = 10, seed: int = 0) -> FrameStore:
    """Random walks of a blob that is moved by held actions of two entries; reaching GOAL ends an episode with success."""
    rng = np.random.default_rng(seed)
    frames, actions, rewards, length = [], [], [], []
    for episode in range(EPISODES):
        scene = episode // together % scenes
        place, held = np.array([rng.uniform(0, GOAL - 4), rng.uniform(8, 24)]), np.zeros(2)
        frames.append(picture(*place, scene))
        for step in range(STEPS):
            held = rng.uniform(-1, 1, 2) if step % HELD == 0 else held
            place = np.clip(place + 2 * held, (0, 8), (SIDE - 6, SIDE - 6))
            frames.append(picture(*place, scene))
            won = place[0] >= GOAL
            actions.append(held)
            rewards.append(float(won))
            if won or step == STEPS - 1:
                actions.append(np.zeros(2))
                rewards.append(0.0)
                length.append(step + 1)
                break
    ends, last = np.cumsum(np.array(length) + 1) - 2, np.array(rewards)
    truncated = np.zeros(len(frames), bool)
    truncated[ends] = last[ends] == 0
    return FrameStore.from_arrays(frames=np.stack(frames), actions=np.stack(actions), rewards=last, terminated=last > 0,
                                  truncated=truncated, episode_length=length, action_low=[-1, -1], action_high=[1, 1])


def names(store: FrameStore) -> set[str]:
    """Problems but that the data of a test are few."""
    return {problem.name for problem in find_problems(store, survey(store))} - {"few-transitions"}


@pytest.fixture(scope="module")
def good() -> FrameStore:
    return walks()


def test_sound_data_have_no_problem(good: FrameStore) -> None:
    assert names(good) == set()


def test_measurements_of_known_data(good: FrameStore) -> None:
    found = survey(good)
    # an action that is held for 3 steps correlates by 2/3, 1/3 and 0 with those 1, 2 and 3 steps later
    np.testing.assert_allclose(found.actions.autocorrelation[:4], [1, 2 / 3, 1 / 3, 0], atol=0.06)
    np.testing.assert_allclose(found.actions.at_bound, 0.02, atol=0.01)  # both hundredths at the ends of uniform actions
    assert found.scenes.count == 1
    assert found.coverage is not None
    assert found.coverage.in_reach > 0.9
    assert found.coverage.lonely < 0.1


@pytest.mark.parametrize(("scenes", "together"), [(3, 20), (6, 10)])
def test_scenes_are_counted(scenes: int, together: int) -> None:
    found = survey(walks(scenes, together)).scenes
    assert found.count == scenes
    assert all(len({*found.labels[found.episodes // together == block]}) == 1 for block in range(EPISODES // together))
    changes = np.flatnonzero(np.diff(found.episodes) == 1)
    expected = np.mean([episode // together == (episode + 1) // together for episode in found.episodes[changes]])
    assert found.together == pytest.approx(expected)


def test_a_moving_camera_leaves_scenes_unknown(good: FrameStore) -> None:
    rng = np.random.default_rng(0)
    found = survey(replace(good, frames=rng.integers(0, 256, good.frames.shape, np.uint8))).scenes
    assert (found.count, found.still < 0.01) == (0, True)
    assert np.isnan(found.together)


# one fault each


def constant(store: FrameStore) -> FrameStore:
    actions = store.actions.copy()
    actions[:, 1] = 0.25
    return replace(store, actions=actions)


def clipped(store: FrameStore) -> FrameStore:
    return replace(store, actions=np.clip(10 * store.actions, -1, 1))


def jittery(store: FrameStore) -> FrameStore:
    return replace(store, actions=np.random.default_rng(0).uniform(-1, 1, store.actions.shape).astype(np.float32))


def frozen(store: FrameStore) -> FrameStore:
    return replace(store, frames=np.broadcast_to(store.frames[:1], store.frames.shape).copy())


def frozen_episodes(store: FrameStore) -> FrameStore:
    return replace(store, frames=store.frames[store.first])


def repeated(store: FrameStore) -> FrameStore:
    return replace(store, frames=store.frames[np.maximum(np.arange(len(store.frames)) // 3 * 3, store.first)])


def blank(store: FrameStore) -> FrameStore:
    return replace(store, frames=store.frames // 60)


def reset_frames(store: FrameStore) -> FrameStore:
    """The frame after success is the next episode's first one."""
    frames = store.frames.copy()
    won = np.flatnonzero(np.bincount(store.episode_of, weights=store.rewards) > 0)
    frames[(store.episode_start + store.episode_length)[won]] = picture(0, 8)
    return replace(store, frames=frames)


def unseen_success(store: FrameStore) -> FrameStore:
    """All start at one place; a success shows that place again, slowly, and nobody else comes back to it."""
    frames = store.frames.copy()
    won = np.bincount(store.episode_of, weights=store.rewards) > 0
    for episode, (start, steps) in enumerate(zip(store.episode_start, store.episode_length, strict=True)):
        count = int(steps) + 1
        away = np.concatenate([np.zeros(1), 8 + np.arange(count - 1)])
        if won[episode]:
            away = np.minimum(away, np.arange(count)[::-1])
        frames[start : start + count] = [picture(min(x, 26), 10) for x in away]
    return replace(store, frames=frames)


def apart(store: FrameStore) -> FrameStore:
    """Successful episodes are recorded in another place than the others."""
    frames = store.frames.copy()
    won = np.bincount(store.episode_of, weights=store.rewards) > 0
    frames[won[store.episode_of]] = frames[won[store.episode_of]][:, ::-1, :, ::-1] // 2
    return replace(store, frames=frames)


def few(store: FrameStore) -> FrameStore:
    rewards = store.rewards.copy()
    rewards[np.flatnonzero(rewards)[4:]] = 0
    return replace(store, rewards=rewards)


@pytest.mark.parametrize(("fault", "name"), [
    (constant, "constant-actions"), (clipped, "clipped-actions"), (jittery, "jittery-actions"),
    (lambda store: replace(store, action_low=store.action_low * 20, action_high=store.action_high * 20), "small-actions"),
    (frozen, "constant-frames"), (frozen_episodes, "constant-frames"), (repeated, "repeated-frames"),
    (blank, "blank-frames"), (reset_frames, "success-frame-jumps"), (unseen_success, "success-looks-like-start"),
    (apart, "success-out-of-reach"), (few, "few-successes"),
])
def test_a_fault_has_its_name(good: FrameStore, fault: Callable[[FrameStore], FrameStore], name: str) -> None:
    assert name in names(fault(good))


def cut(store: FrameStore, length: int) -> FrameStore:
    """The first steps of each episode; those that were successful succeed at their last one."""
    rows = np.concatenate([np.arange(start, start + min(length, steps) + 1)
                           for start, steps in zip(store.episode_start, store.episode_length, strict=True)])
    kept = np.minimum(store.episode_length, length)
    rewards = np.zeros(len(rows))
    won = np.bincount(store.episode_of, weights=store.rewards) > 0
    rewards[(np.cumsum(kept + 1) - 2)[won]] = 1
    return FrameStore.from_arrays(frames=store.frames[rows], actions=store.actions[rows], rewards=rewards,
                                  terminated=rewards > 0, truncated=store.truncated[rows], episode_length=kept,
                                  action_low=store.action_low, action_high=store.action_high)


def test_short_episodes_and_successes_at_once(good: FrameStore) -> None:
    assert {"short-episodes", "success-at-once"} <= names(cut(good, 1))
    (stopping,) = (problem for problem in find_problems(cut(good, 2), survey(cut(good, 2))) if problem.stops)
    assert (stopping.name, stopping.got) == ("short-episodes", "the longest episode has 2 transitions")
    assert "short-episodes" not in names(cut(good, 3))


def test_an_episode_a_scene() -> None:
    store = walks()
    frames = store.frames.copy()
    shelves = np.random.default_rng(0).choice([0, 255], (EPISODES, 6, SIDE, 1))
    frames[:, :6] = shelves[store.episode_of]
    assert "one-episode-a-scene" in names(replace(store, frames=frames))


def test_thin_coverage(good: FrameStore) -> None:
    """Every episode is lit in its own way, so that none comes near another."""
    light = np.linspace(0.3, 1.6, good.n_episodes)[good.episode_of]
    frames = (good.frames * light[:, None, None, None]).clip(0, 255).astype(np.uint8)
    assert "thin-coverage" in names(replace(good, frames=frames))


# files


def arrays_of(store: FrameStore, path: Path, rewards: np.ndarray | None = None, **changes: np.ndarray) -> Path:
    """The store as OGBench's arrays."""
    ends = np.zeros(len(store.frames))
    ends[store.episode_start + store.episode_length] = 1
    arrays = {"observations": store.frames, "actions": store.actions, "terminals": ends,
              "rewards": store.rewards if rewards is None else rewards, **changes}
    np.savez(path, **arrays)
    return path


def test_the_command_writes_page_figures_and_pictures(good: FrameStore, tmp_path: Path,
                                                      capsys: pytest.CaptureFixture[str]) -> None:
    source = arrays_of(good, tmp_path / "walks.npz")
    assert main(["inspect", str(source), "--image-size", str(SIDE), "--out", str(tmp_path / "out")]) == 0
    said = capsys.readouterr().out
    won = int(good.rewards.sum())
    assert f"success: rule `reward>=1`, {won} of {EPISODES} episodes" in said
    assert "one scene among" in said
    figures = json.loads((tmp_path / "out" / "inspection.json").read_text())
    assert (figures["episodes"], figures["success"]["episodes"], figures["scenes"]["count"]) == (EPISODES, won, 1)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "coverage.png", "frames.png", "inspection.json", "inspection.md", "scenes.png"]
    for path in (tmp_path / "out").glob("*.png"):
        assert np.asarray(Image.open(path)).std() > 10
    assert (tmp_path / "out" / "inspection.md").read_text().startswith("# Inspection of")


@pytest.mark.parametrize(("rewards", "text"), [
    (np.zeros, r"STOPS  no-success: every reward of .* is 0; expected two values, .*Say what success is"),
    (lambda count: np.linspace(-1, 0, count), r"STOPS  no-success: .* rewards, from -1 to 0.*--success 'reward>=0'"),
])
def test_data_without_success_are_measured_all_the_same(good: FrameStore, tmp_path: Path,
                                                        rewards: Callable[[int], np.ndarray], text: str) -> None:
    found = inspect(str(arrays_of(good, tmp_path / "none.npz", rewards(len(good.frames)))), image_size=SIDE)
    assert re.search(text, inspection_text(found))
    assert found.store is not None and found.store.rewards.sum() == 0
    assert found.survey is not None and found.survey.scenes.count == 1
    paths = save_inspection(found, tmp_path / "out")
    assert all(path.is_file() for path in paths) and len(paths) == 5


def test_a_rule_that_never_holds(good: FrameStore, tmp_path: Path) -> None:
    found = inspect(str(arrays_of(good, tmp_path / "rule.npz")), image_size=SIDE, success="reward>=2")
    assert found.problems[0].name == "no-success" and "by the rule reward>=2" in found.problems[0].got


def test_unreadable_data_are_one_problem(good: FrameStore, tmp_path: Path) -> None:
    actions = good.actions.copy()
    actions[7, 0] = np.nan
    found = inspect(str(arrays_of(good, tmp_path / "nan.npz", actions=actions)), image_size=SIDE)
    (problem,) = found.problems
    assert (problem.name, problem.stops, problem.expected) == ("unreadable", True, "finite numbers")
    assert "the action of step 7" in problem.got and problem.do.startswith("Repair the value")
    paths = save_inspection(found, tmp_path / "out")
    assert [path.name for path in paths] == ["inspection.md", "inspection.json"]
    assert json.loads(paths[1].read_text())["problems"][0]["name"] == "unreadable"
