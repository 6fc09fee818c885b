"""PushT of gym-pusht from pixels: a disc pushes a T-shaped block onto its outline. Needs `pip install gym-pusht`.

`python -m studies.foreign.pusht` records episodes of a clumsy pusher and of random walks as one `.npz` file of arrays, with
the coverage of the outline after every step. Places are in the environment's units, 0 to 512. The environment gives its
coverage in `info["coverage"]`; its own success, 0.95, is out of this pusher's reach, so that README.md asks for 0.6.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gym_pusht  # noqa: F401 - registers the environment
import gymnasium as gym
import numpy as np
import tyro
from numpy.typing import NDArray

Vector = NDArray[np.float64]

ENV = "gym_pusht/PushT-v0"
REACH = 24.0
"""Way of the disc's target ahead of the disc in one step."""
ARM = 45.0
"""What weighs an angle [rad] against a way: about the block's radius of gyration."""
CLEAR = 32.0
"""From a contact to where a push begins, outside the block."""
AROUND = 125.0
"""Radius of the way round the block."""


def turned(points: Vector, angle: float) -> Vector:
    """points [..., 2] turned by an angle [rad]."""
    cos, sin = np.cos(angle), np.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def contacts(task: Any) -> tuple[Vector, Vector]:
    """Where the block can be pushed and which way, [C, 2] each, in its own frame from its centre of gravity."""
    stem, bar, half, thick = 120.0, 60.0, 15.0, 30.0
    places, ways = [], []
    for x in (-0.8, -0.4, 0.0, 0.4, 0.8):
        places.append((x * bar, 0.0))
        ways.append((0.0, 1.0))
    for side in (-1.0, 1.0):
        places += [(side * bar, thick / 2), (side * half, 60.0), (side * half, 85.0), (side * half, 110.0),
                   (side * 45.0, thick)]
        ways += [(-side, 0.0)] * 4 + [(0.0, -1.0)]
    places.append((0.0, stem))
    ways.append((0.0, -1.0))
    return np.array(places) - np.array(task.block.center_of_gravity), np.array(ways)


class Pusher:
    """Chooses the contact whose push moves the block most nearly as it is to move, goes there, and pushes for a while."""

    def __init__(self, task: Any, rng: np.random.Generator, noise: float) -> None:
        self.task, self.rng, self.noise = task, rng, noise
        self.places, self.ways = contacts(task)
        self.contact, self.pushing = 0, 0

    def error(self) -> tuple[Vector, float]:
        """How far the block's centre of gravity is to move [2] and to turn [rad]."""
        block, goal = self.task.block, self.task.goal_pose
        centre = np.array(block.center_of_gravity)
        wanted = goal[:2] + turned(centre, goal[2])
        angle = float((goal[2] - block.angle + np.pi) % (2 * np.pi) - np.pi)
        return wanted - np.array(block.local_to_world(block.center_of_gravity)), angle

    def choose(self) -> None:
        """The contact with the best direction of motion (way, turn), a quasi-static push taken for granted."""
        move, angle = self.error()
        local = turned(move, -self.task.block.angle)
        torque = self.places[:, 0] * self.ways[:, 1] - self.places[:, 1] * self.ways[:, 0]
        twist = np.column_stack([self.ways, torque / ARM])
        wanted = np.array([*local, ARM * angle])
        self.contact = int(np.argmax(twist @ wanted / np.linalg.norm(twist, axis=1)))

    def __call__(self) -> Vector:
        """The target of the disc [2]."""
        block, agent = self.task.block, np.array(self.task.agent.position)
        centre = np.array(block.local_to_world(block.center_of_gravity))
        place = centre + turned(self.places[self.contact], block.angle)
        way = turned(self.ways[self.contact], block.angle)
        begin = place - CLEAR * way
        if self.pushing > 0:
            self.pushing -= 1
            move, angle = self.error()
            left = float(np.linalg.norm([*move, ARM * angle]))
            target = agent + min(REACH, 6.0 + 0.5 * left) * way
            if self.pushing == 0:
                self.choose()
        elif np.linalg.norm(agent - begin) < 10.0:
            self.pushing = int(self.rng.integers(4, 9))
            target = agent + REACH * way
        else:
            if self.rng.random() < 0.1:
                self.choose()
            target = self.approach(agent, centre, begin)
        step = target - agent
        step *= min(1.0, REACH / max(float(np.linalg.norm(step)), 1e-6))
        return agent + step + self.rng.normal(0, self.noise, 2)

    def approach(self, agent: Vector, centre: Vector, begin: Vector) -> Vector:
        """Straight to where the push begins, or on a circle round the block where that is behind it."""
        here, there = agent - centre, begin - centre
        apart = float((np.arctan2(there[1], there[0]) - np.arctan2(here[1], here[0]) + np.pi) % (2 * np.pi) - np.pi)
        if abs(apart) < 0.5:
            return begin
        ahead = np.arctan2(here[1], here[0]) + np.sign(apart) * min(abs(apart), 0.35)
        return np.clip(centre + AROUND * np.array([np.cos(ahead), np.sin(ahead)]), 20, 492)


def walker(task: Any, rng: np.random.Generator) -> Any:
    """A random walk of the disc: its speed changes by Gaussian steps."""
    speed = rng.normal(0, REACH / 2, 2)

    def act() -> Vector:
        nonlocal speed
        speed = np.clip(speed + rng.normal(0, REACH / 3, 2), -REACH, REACH)
        return np.array(task.agent.position) + speed

    return act


def episode(env: gym.Env[Any, Any], seed: int, steps: int, share: float) -> dict[str, NDArray[Any]]:
    """One episode: a row a step, and a last row with the last picture, whose action leads nowhere."""
    rng = np.random.default_rng([seed, 7])
    frame, _ = env.reset(seed=seed)
    task = env.unwrapped
    policy = Pusher(task, rng, noise=rng.uniform(2, 10)) if rng.random() < share else walker(task, rng)
    if isinstance(policy, Pusher):
        policy.choose()
    frames, done = [frame], False
    actions: list[NDArray[np.float32]] = []
    coverage: list[float] = []
    while len(actions) < steps and not done:
        action = np.clip(policy(), 0, 512).astype(np.float32)
        frame, _, done, _, info = env.step(action)
        frames.append(frame)
        actions.append(action)
        coverage.append(info["coverage"])
    actions.append(actions[-1])
    coverage.append(coverage[-1])
    ends = np.arange(len(actions)) == len(actions) - 1
    return {"observations": np.stack(frames), "actions": np.stack(actions), "terminals": ends.astype(np.float32),
            "coverage": np.array(coverage, np.float32)}


@dataclass(frozen=True)
class Collection:
    """How much is recorded, and where."""

    out: Path = Path("pusht.npz")
    seed: int = 0
    episodes: int = 500
    steps: int = 80
    """Longest episode [steps]."""
    share: float = 0.8
    """Share of episodes by the pusher; the others are random walks."""


def collect(what: Collection) -> list[float]:
    """Record the episodes; gives the highest coverage of each."""
    env = gym.make(ENV, obs_type="pixels", max_episode_steps=what.steps)
    seeds = np.random.SeedSequence(what.seed).generate_state(what.episodes).tolist()
    episodes = [episode(env, seed, what.steps, what.share) for seed in seeds]
    arrays: dict[str, Any] = {name: np.concatenate([one[name] for one in episodes]) for name in episodes[0]}
    np.savez_compressed(what.out, **arrays)
    return [float(one["coverage"].max()) for one in episodes]


if __name__ == "__main__":
    settings = tyro.cli(Collection)
    highest = np.array(collect(settings))
    print(f"{len(highest)} episodes in {settings.out}; coverage of the outline reaches "
          + ", ".join(f"{least:g} in {int((highest >= least).sum())}" for least in (0.4, 0.5, 0.6, 0.7, 0.8, 0.95)))
