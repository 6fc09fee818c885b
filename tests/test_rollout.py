"""Rollouts: every seed once, the result of an episode independent of its batch, observers, foreign environments."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from toy_env import SIDE, ToyEnv, ToyModel, toy_config, toy_env
from velap.data.success import Success
from velap.errors import ConfigError, DatasetError
from velap.evaluation.rollout import Episode, FrameReader, Moment, Rollout, make_envs
from velap.methods.base import Agent, make_agent
from velap.methods.random import RandomAgent


def toy_agent(method: str = "velap", **planner: object) -> Agent:
    return make_agent(method, ToyModel(), toy_config(**planner), ToyEnv().action_space)


def play(agent: Agent, seeds: range, batch: int, **options: Any) -> dict[int, Episode]:
    envs = make_envs(toy_env, batch)
    rollout = Rollout(envs, agent, FrameReader(envs[0], SIDE), **options)
    episodes = list(rollout.run(seeds))
    assert sorted(episode.seed for episode in episodes) == list(seeds), "every seed exactly once"
    return {episode.seed: episode for episode in episodes}


def test_velap_gets_round_the_wall_that_greed_cannot() -> None:
    solved = play(toy_agent(n_iter=300), range(3), 3)
    assert all(episode.success and not episode.truncated for episode in solved.values())
    assert all(16 <= episode.steps <= 32 for episode in solved.values()), "the shortest way to the goal is 16 steps"
    assert all(len(episode.plan_ms) in (2, 3) for episode in solved.values()), "a plan every 10 steps until the goal is near"
    assert all(10 <= episode.plan_steps < episode.steps for episode in solved.values()), "π^g takes the last steps"
    stuck = play(toy_agent("td3bc"), range(3), 3)
    assert all(episode.plan_steps is None for episode in stuck.values()), "there is no tree"
    assert all(not episode.success and episode.truncated and episode.steps == 60 for episode in stuck.values())
    assert all(episode.plan_ms == () for episode in stuck.values())


@pytest.mark.parametrize("method", ["random", "velap"])
def test_results_do_not_depend_on_the_batch(method: str) -> None:
    def outcome(batch: int) -> dict[int, tuple[bool, int]]:
        episodes = play(toy_agent(method), range(10, 15), batch, max_steps=25)
        return {seed: (episode.success, episode.steps) for seed, episode in episodes.items()}

    assert outcome(1) == outcome(2) == outcome(8)


def test_actions_do_not_depend_on_the_batch() -> None:
    def positions(batch: int) -> dict[int, np.ndarray]:
        seen: dict[int, list[np.ndarray]] = {}

        def watch(moment: Moment) -> None:
            seen.setdefault(moment.seed, []).append(moment.env.unwrapped.agent_position())  # type: ignore[attr-defined]

        play(toy_agent(), range(5), batch, max_steps=15, observer=watch)
        return {seed: np.stack(path) for seed, path in seen.items()}

    alone, together = positions(1), positions(3)
    for seed, path in alone.items():
        assert path.shape == (16, 2), "each state before its action, and the last one"
        np.testing.assert_allclose(together[seed], path, atol=1e-5)


def test_frames_are_stacked_with_the_first_one_repeated() -> None:
    seen: list[np.ndarray] = []

    class Watcher(RandomAgent):
        def act(self, frames: np.ndarray) -> np.ndarray:
            seen.append(frames.copy())
            return super().act(frames)

    play(Watcher(ToyEnv().action_space, frame_stack=3), range(1), 1, max_steps=4)
    stacks = np.stack([frames[0, :, 0, 0] for frames in seen])
    assert seen[0].shape == (1, 3, SIDE, SIDE, 3)
    np.testing.assert_array_equal(stacks[0], np.stack([stacks[0, 2]] * 3))
    np.testing.assert_array_equal(stacks[1, :2], np.stack([stacks[0, 2]] * 2))
    np.testing.assert_array_equal(stacks[3, :2], stacks[2, 1:])
    np.testing.assert_array_equal(stacks[3, 0], stacks[1, 2])


def test_max_steps_ends_an_episode_as_truncated() -> None:
    episode = play(toy_agent("random"), range(1), 1, max_steps=7)[0]
    assert (episode.steps, episode.truncated, episode.success) == (7, True, False)


@pytest.mark.parametrize(("rule", "steps"), [(None, 20), ("reward>=-1", 1), ("info:steps>=3", 3), ("reward>=0.5", 20)])
def test_success_is_what_the_rule_of_the_checkpoint_says(rule: str | None, steps: int) -> None:
    class Walk(ToyEnv):
        def step(self, action: np.ndarray) -> Any:
            observation, *_ = super().step(action)
            self.taken = getattr(self, "taken", 0) + 1
            return observation, -1.0 if rule else 0.0, False, False, {"steps": self.taken}

    env = Walk()
    agent = RandomAgent(env.action_space, 1)
    rollout = Rollout([env], agent, FrameReader(env, SIDE), max_steps=20, success=rule and Success.parse(rule))
    (episode,) = rollout.run([0])
    assert (episode.steps, episode.success) == (steps, steps < 20)


class Foreign(gym.Env[Any, Any]):
    """Channel-first grey images under a key, 16 pixels wide."""

    def __init__(self, dtype: type = np.uint8) -> None:
        self.observation_space = gym.spaces.Dict({
            "camera": gym.spaces.Box(0, 255, (1, 16, 16), np.uint8), "speed": gym.spaces.Box(-1, 1, (2,), np.float32)})
        self.action_space = gym.spaces.Box(-1, 1, (2,), np.float64)
        self.dtype = dtype
        self.options: list[dict[str, Any] | None] = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self.options.append(options)
        return self._observe(), {}

    def _observe(self) -> dict[str, np.ndarray]:
        return {"camera": np.full((1, 16, 16), 40, self.dtype), "speed": np.zeros(2, np.float32)}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert action.dtype == np.float64
        return self._observe(), 1.0, False, False, {}


def test_a_foreign_environment_is_read_by_the_rules_of_datasets() -> None:
    env = Foreign()
    episodes = list(Rollout([env], RandomAgent(env.action_space, 1), FrameReader(env, 8, "camera")).run([3]))
    assert episodes == [Episode(seed=3, success=True, steps=1, truncated=False, plan_ms=())]
    assert env.options == [None]
    image = FrameReader(env, 8)(env._observe())
    assert (image.shape, image.dtype, int(image.max())) == ((8, 8, 3), np.uint8, 40)


class Reusing(Foreign):
    """Writes each picture into the memory of the one before, takes no options, and gives rewards of one entry."""

    def __init__(self) -> None:
        super().__init__()
        self.memory, self.time = np.zeros((1, 16, 16), np.uint8), 0

    def reset(self, *, seed: int | None = None) -> tuple[Any, dict[str, Any]]:  # type: ignore[override]
        self.time = 0
        return self._observe(), {}

    def _observe(self) -> dict[str, np.ndarray]:
        self.memory[:] = 10 * self.time
        return {"camera": self.memory, "speed": np.zeros(2, np.float32)}

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        self.time += 1
        return self._observe(), self.reward(), False, False, {}

    def reward(self) -> Any:
        return np.array([float(self.time == 4)])


class Watching(RandomAgent):
    """Random actions; keeps the brightness of what it sees."""

    def __init__(self) -> None:
        super().__init__(gym.spaces.Box(-1, 1, (2,), np.float64), 2)
        self.seen: list[list[int]] = []

    def act(self, frames: np.ndarray) -> np.ndarray:
        self.seen.append(frames[0, :, 0, 0, 0].tolist())
        return super().act(frames)


def test_an_environment_may_reuse_the_memory_of_its_pictures() -> None:
    env, agent = Reusing(), Watching()
    (episode,) = Rollout([env], agent, FrameReader(env, 16)).run([0])
    assert episode.success and episode.steps == 4
    assert agent.seen == [[0, 0], [0, 10], [10, 20], [20, 30]], "a state keeps the pictures as they were"


@pytest.mark.parametrize("reward", [None, np.zeros(2), "one"])
def test_a_reward_that_is_no_number_is_named(reward: Any) -> None:
    env = Reusing()
    env.reward = lambda: reward
    with pytest.raises(ConfigError, match=r"reward .*expected one number"):
        list(Rollout([env], Watching(), FrameReader(env, 16)).run([0]))


def test_wrong_images_and_keys_are_named() -> None:
    with pytest.raises(DatasetError, match=r"no observation key 'eye'.*camera"):
        FrameReader(Foreign(), 8, "eye")
    liar = Foreign(np.float32)
    with pytest.raises(ConfigError, match=r"float32\[1, 16, 16\].*promises uint8\[1, 16, 16\]"):
        FrameReader(liar, 8)(liar._observe())
    with pytest.raises(ConfigError, match="Discrete"):
        make_envs(lambda: gym.make("CartPole-v1").unwrapped, 1)
