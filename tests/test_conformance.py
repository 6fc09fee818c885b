"""What holds for every task of the registry: Gymnasium's contract, seeds, rewards, limits, contexts, and stored data."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import velap.envs  # noqa: F401 - registers the tasks
from velap.data import behaviours, worker
from velap.data import collection as collect
from velap.data.loading import load_store
from velap.data.minari_io import load_positions, open_dataset
from velap.evaluation.rollout import play_without_frames
from velap.tasks import TASKS, Recipe

pytestmark = pytest.mark.parametrize("task", list(TASKS))
FRAME = gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)


@cache
def made(task: str) -> gymnasium.Env[Any, Any]:
    """One environment a task; a reset has to forget what happened before."""
    return gymnasium.make(TASKS[task].env_id)


def context_of(world: Any) -> np.ndarray:
    """Where everything stands that no joint moves: what a context may change."""
    return np.concatenate([world.model.body_pos.ravel(), world.model.geom_pos.ravel()])


@pytest.mark.filterwarnings("error")
def test_gymnasiums_checker_is_content(task):
    check_env(gymnasium.make(TASKS[task].env_id).unwrapped)


def test_observations_are_frames_and_actions_are_bounded(task):
    env = made(task)
    assert env.observation_space == FRAME
    assert isinstance(env.action_space, gymnasium.spaces.Box)
    assert env.action_space.dtype == np.float32
    assert (env.action_space.low == -1).all() and (env.action_space.high == 1).all()
    assert env.spec.max_episode_steps == TASKS[task].max_steps


@pytest.mark.parametrize("split", ["train", "test"])
def test_a_seed_fixes_frames_and_physics(task, split):
    def run(env: gymnasium.Env[Any, Any], seed: int) -> tuple[np.ndarray, np.ndarray]:
        rng = np.random.default_rng(0)
        frames, states = [env.reset(seed=seed, options={"split": split})[0]], []
        for _ in range(6):
            frames.append(env.step(rng.uniform(-1, 1, env.action_space.shape).astype(np.float32))[0])
            states.append(np.concatenate([env.unwrapped.data.qpos, env.unwrapped.data.qvel]))
        return np.array(frames), np.array(states)

    first, again, other = run(made(task), 7), run(gymnasium.make(TASKS[task].env_id), 7), run(made(task), 8)
    for got, expected, different in zip(again, first, other, strict=True):
        np.testing.assert_array_equal(got, expected)
        assert not np.array_equal(different[0], expected[0])


def test_frames_are_owned_and_share_no_memory(task):
    env = made(task)
    frames = [env.reset(seed=0, options={"split": "train"})[0]]
    frames += [env.step(np.full(env.action_space.shape, 0.5, np.float32))[0] for _ in range(3)]
    frames += [env.unwrapped.render()]
    copies = [frame.copy() for frame in frames]
    env.step(np.full(env.action_space.shape, -1.0, np.float32))
    for index, frame in enumerate(frames):
        assert frame.flags.owndata and frame.flags.c_contiguous and frame.flags.writeable
        np.testing.assert_array_equal(frame, copies[index])
        assert not any(np.shares_memory(frame, other) for other in frames[:index])


def test_the_reward_comes_with_success_and_ends_the_episode(task):
    env = made(task)
    _, info = env.reset(seed=3)
    assert info["success"] is False
    outcomes = []
    while not outcomes or not (outcomes[-1][1] or outcomes[-1][2]):
        assert not env.unwrapped.succeeded()
        _, reward, terminated, truncated, info = env.step(env.unwrapped.expert_action())
        outcomes.append((reward, terminated, truncated, info["success"]))
    assert set(outcomes[:-1]) == {(0.0, False, False, False)}
    assert outcomes[-1] == (1.0, True, False, True)
    assert env.unwrapped.succeeded()


def test_the_time_limit_truncates(task, monkeypatch):
    env = made(task)
    monkeypatch.setattr(env.unwrapped, "render", lambda: np.zeros(FRAME.shape, np.uint8), raising=False)
    env.reset(seed=0)
    ends = [env.step(np.zeros(env.action_space.shape, np.float32))[1:4] for _ in range(TASKS[task].max_steps)]
    assert set(ends[:-1]) == {(0.0, False, False)}
    assert ends[-1] == (0.0, False, True)


def test_train_and_test_contexts_are_apart(task):
    world, count = made(task).unwrapped, TASKS[task].recipe.contexts

    def contexts(options: Sequence[dict[str, Any]]) -> np.ndarray:
        found = []
        for seed, each in enumerate(options):
            world.start(each, seed)
            found.append(context_of(world))
        return np.array(found)

    numbers = np.linspace(0, count - 1, 10).astype(int)
    train = contexts([{"split": "train", "context": number} for number in numbers])
    np.testing.assert_array_equal(train[::-1], contexts([{"split": "train", "context": int(k)} for k in numbers[::-1]]))
    test = contexts([{"split": "test"}] * 10 + [{"split": "test", "context": number} for number in numbers])
    if count == 1:
        assert np.ptp(np.concatenate([train, test]), axis=0).max() == 0
    else:
        assert len(np.unique(train, axis=0)) == len(train)
        assert len(np.unique(np.concatenate([train, test]), axis=0)) == len(train) + len(test)


def noisy_expert(env: gymnasium.Env[Any, Any], recipe: Recipe, rng: np.random.Generator) -> behaviours.Policy:
    """A behaviour that succeeds, with actions that differ from step to step."""
    world: Any = env.unwrapped
    shape = env.action_space.shape
    return lambda frame: np.clip(world.expert_action() + rng.normal(0, 0.1, shape), -1, 1).astype(np.float32)


def test_test_episodes_start_in_the_test_region_and_far_from_success(task):
    world: Any = made(task).unwrapped
    for seed in range(5):
        world.start({"split": "test"}, seed)
        assert world.in_test_region()
        assert not world.succeeded()


def test_a_stored_trajectory_replays_to_the_same_states_and_pixels(task, tmp_path, monkeypatch):
    """Action t leads from frame t to frame t + 1. Collected by the real thing, but in this process."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setattr(worker, "ProcessPoolExecutor", InThisProcess)
    monkeypatch.setattr(worker, "TEST_STARTS", 2)
    monkeypatch.setitem(behaviours.BEHAVIOURS, "noisy-expert", noisy_expert)
    recipe = Recipe(contexts=1, trajectories=1, max_steps=TASKS[task].max_steps, success_percent=1.0)
    alone = dataclasses.replace(TASKS[task], recipe=recipe, behaviours={"noisy-expert": 1.0})
    collect.collect(alone, seed=4, dataset_id="velap/Replay-v0")
    store, positions = load_store("velap/Replay-v0"), load_positions("velap/Replay-v0")
    kept = list(open_dataset("velap/Replay-v0").storage.get_episode_metadata([0]))
    assert store.rewards.sum() > 0
    env = made(task)
    for start, length, metadata in zip(store.episode_start, store.episode_length, kept, strict=True):
        frame, _ = env.reset(seed=int(metadata["seed"]), options=metadata["options"])
        for row in range(start, start + length):
            np.testing.assert_array_equal(frame, store.frames[row])
            np.testing.assert_array_equal(env.unwrapped.agent_position().astype(np.float32), positions[row])
            frame, reward, terminated, _, _ = env.step(store.actions[row])
            assert (reward, terminated) == (store.rewards[row], store.terminated[row])
        np.testing.assert_array_equal(frame, store.frames[start + length])
        np.testing.assert_array_equal(env.unwrapped.agent_position().astype(np.float32), positions[start + length])
        assert (np.ptp(store.frames[start : start + length + 1], axis=0) > 0).sum() > 20


class InThisProcess:
    """An executor without processes of its own."""

    def __init__(self, *_: Any, **__: Any) -> None:
        pass

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(function(*arguments))
        return done

    def shutdown(self, **_: Any) -> None:
        pass


@pytest.mark.parametrize("seed", [0, 1, 4321])
def test_the_expert_solves_test_starts_and_uniform_actions_do_not(task, seed):
    """A few of the episodes of `velap study experts`."""
    world: Any = made(task).unwrapped
    rng, space = np.random.default_rng(seed), world.action_space
    policies: list[Callable[[], Any]] = [world.expert_action, lambda: rng.uniform(space.low, space.high)]
    lengths = [play_without_frames(world, act, seed, TASKS[task].max_steps) for act in policies]
    assert lengths[0] is not None
    assert lengths[0] > 10
    assert lengths[1] is None
