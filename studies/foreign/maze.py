"""A maze of another look than SpiralMaze: five corridors side by side, which have to be walked up and down to the last one.

`python -m studies.foreign.maze` records 1,000 random walks of 20 steps as the Minari dataset `foreign/long-way-v0`: Dict
observations, JPEG-encoded pictures. The maze is the unit square, x to the right, y down. T transitions of one walk.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import minari
import numpy as np
import tyro
from minari.data_collector import EpisodeBuffer
from numpy.typing import NDArray

SIDE = 96
"""Side of a picture [px]."""
STEP = 0.045
"""Way at action 1, along each axis."""
RADIUS = 0.035
"""Radius of the agent."""
WALLS = np.array([[0.19, 0.0, 0.22, 0.8], [0.39, 0.2, 0.42, 1.0], [0.59, 0.0, 0.62, 0.8], [0.79, 0.2, 0.82, 1.0]])
"""[W, 4]: least x and y, largest x and y of the walls between the corridors."""
GOAL_X, GOAL_Y = 0.82, 0.86
"""The goal is all of the last corridor beyond that x and y: its lower end."""
FLOOR, WALL, GOAL, AGENT = (206, 190, 160), (58, 92, 70), (170, 200, 214), (214, 84, 42)
"""Colours."""
IMAGE_KEY = "overhead"
DATASET = "foreign/long-way-v0"


def free(place: NDArray[np.float64]) -> bool:
    """Is there room for the agent at place [2]?"""
    low, high = WALLS[:, :2] - RADIUS, WALLS[:, 2:] + RADIUS
    inside = ((place > RADIUS) & (place < 1 - RADIUS)).all()
    return bool(inside and not ((place > low) & (place < high)).all(1).any())


class LongWay(gym.Env[dict[str, Any], NDArray[np.float32]]):
    """A disc starts at the upper end of the first corridor and has to reach the lower end of the last one: reward 1."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        self.render_mode = render_mode
        self.observation_space = gym.spaces.Dict({
            IMAGE_KEY: gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
            "clock": gym.spaces.Box(0.0, np.inf, (1,), np.float32),
        })
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        y, x = (np.mgrid[:SIDE, :SIDE] + 0.5) / SIDE
        self._pixels = np.stack([x, y], -1)
        self._background = self._empty_maze(x, y)
        self.place, self.steps = np.zeros(2), 0

    def reset(self, *, seed: int | None = None,
              options: dict[str, Any] | None = None) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start in the first corridor; with the option `anywhere` at any free place outside the goal."""
        super().reset(seed=seed)
        low, high = ((0, 0), (1, 1)) if (options or {}).get("anywhere") else ((0, 0), (0.19, 0.2))
        self.place, self.steps = self.np_random.uniform(low, high), 0
        while not free(self.place) or self.at_goal():
            self.place = self.np_random.uniform(low, high)
        return self.observation(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Move by action [2], along each axis as far as the walls let it."""
        way = STEP * np.clip(np.asarray(action, np.float64), -1, 1) / 3
        for axis in (0, 1, 0, 1, 0, 1):
            ahead = self.place.copy()
            ahead[axis] += way[axis]
            self.place = ahead if free(ahead) else self.place
        self.steps += 1
        reached = self.at_goal()
        return self.observation(), float(reached), reached, False, {}

    def at_goal(self) -> bool:
        """Is the agent in the goal region?"""
        return bool(self.place[0] > GOAL_X and self.place[1] > GOAL_Y)

    def observation(self) -> dict[str, Any]:
        """The picture, and the number of steps, which says nothing of use."""
        return {IMAGE_KEY: self.render(), "clock": np.array([self.steps], np.float32)}

    def render(self) -> NDArray[np.uint8]:
        """The maze from above, uint8 [96, 96, 3]."""
        distance = np.linalg.norm(self._pixels - self.place, axis=-1, keepdims=True)
        cover = np.clip((RADIUS - distance) * SIDE + 0.5, 0, 1)
        return (self._background * (1 - cover) + np.array(AGENT) * cover).astype(np.uint8)

    def _empty_maze(self, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
        """Floor with a grain of boards and specks, goal and walls [96, 96, 3]."""
        picture = np.broadcast_to(np.array(FLOOR, np.float64), (SIDE, SIDE, 3)).copy()
        picture[(x > GOAL_X) & (y > GOAL_Y)] = GOAL
        for left, top, right, bottom in WALLS:
            picture[(x > left) & (x < right) & (y > top) & (y < bottom)] = WALL
        grain = 6 * np.sin(40 * y + 3 * np.sin(9 * x)) + np.random.default_rng(5).normal(0, 4, (SIDE, SIDE))
        return np.clip(picture + grain[..., None], 0, 255)


gym.register("LongWay-v0", LongWay, max_episode_steps=300)


def random_walk(env: LongWay, seed: int, steps: int) -> EpisodeBuffer:
    """At most that many random steps from a random place; the walk ends at the goal."""
    rng = np.random.default_rng([seed, 7])
    observations = [env.reset(seed=seed, options={"anywhere": True})[0]]
    actions: list[NDArray[np.float32]] = []
    rewards: list[float] = []
    action = rng.uniform(-1, 1, 2)
    reached = False
    while len(actions) < steps and not reached:
        action = np.clip(action + rng.normal(0, 0.4, 2), -1, 1)
        observation, reward, reached, *_ = env.step(action.astype(np.float32))
        observations.append(observation)
        actions.append(action.astype(np.float32))
        rewards.append(reward)
    ends = np.arange(len(rewards)) == len(rewards) - 1
    columns = {key: np.stack([one[key] for one in observations]) for key in observations[0]}
    return EpisodeBuffer(observations=columns, actions=np.stack(actions), rewards=rewards,
                         terminations=list(ends & reached), truncations=list(ends & (not reached)))


@dataclass(frozen=True)
class Collection:
    """How much is recorded, and where."""

    seed: int = 0
    walks: int = 1000
    steps: int = 20
    """Longest walk [steps]."""
    dataset: str = DATASET
    """Minari id."""


def collect(what: Collection) -> int:
    """Record the walks; gives the number that reach the goal."""
    env = LongWay()
    seeds = np.random.SeedSequence(what.seed).generate_state(what.walks).tolist()
    buffers = [random_walk(env, seed, what.steps) for seed in seeds]
    minari.create_dataset_from_buffers(what.dataset, buffers, observation_space=env.observation_space,
                                       action_space=env.action_space, algorithm_name="random walk")
    return int(sum(buffer.rewards[-1] for buffer in buffers))


if __name__ == "__main__":
    settings = tyro.cli(Collection)
    print(f"{collect(settings)} of {settings.walks} walks reach the goal; dataset {settings.dataset}")
