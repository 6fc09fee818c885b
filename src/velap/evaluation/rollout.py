"""Seeded episodes, several environments at a time.

Episode seed s resets the environment and seeds the agent's row, so an episode does not depend on the row or batch it ran
in. B environments, N stacked frames, H x W pixels, A action dimensions.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from velap.data.frames import stack_indices
from velap.data.images import Fit, find_images, side_by_side
from velap.data.state import find_state
from velap.data.success import Success, success_of
from velap.errors import ConfigError
from velap.methods.base import Agent, FollowsTree

NO_PIXELS = "make the environment with the argument that gives pixels, such as --env-kwargs obs_type=pixels"


@dataclass(frozen=True)
class Episode:
    """How one episode went."""

    seed: int
    success: bool
    steps: int
    """Environment steps taken [steps]."""
    truncated: bool
    """Ended by the time limit without success."""
    plan_ms: tuple[float, ...]
    """Planning time of every plan of this row [ms]."""
    plan_steps: int | None = None
    """Steps whose action followed an edge of the current tree [steps]; None for agents without a tree."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """One state of a running episode: each before its action, and the last one."""

    row: int
    seed: int
    """Of the episode."""
    env: gym.Env[Any, Any]
    """In this state."""
    agent: Agent
    frame: NDArray[np.uint8]
    """What the agent sees, uint8 [H, W, 3]."""
    outcome: Episode | None = None
    """How the episode went, in its last state; None before."""


Observer = Callable[[Moment], None]
"""Receives every state of every running episode."""


class FrameReader:
    """Observations of one environment -> frames uint8 [side, side, 3], by the rules that datasets are read by; several
    cameras stand side by side."""

    def __init__(self, env: gym.Env[Any, Any], side: int, image_key: str | None = None, fit: Fit | None = None,
                 state_key: str | None = None, state_dim: int = 0) -> None:
        """Find the cameras, and the state under `state_key`, with `state_dim` entries S where the agent takes one.

        `fit` is how the dataset's oblong images became square.
        """
        self._name = env.spec.id if env.spec is not None else type(env.unwrapped).__name__
        self._layouts = find_images(env.observation_space, image_key, self._name, NO_PIXELS, fit)
        self._side, self._fit = side, fit
        self._state = find_state(env.observation_space, state_key, self._name, state_dim)
        self.size = (side, side * len(self._layouts))
        """Height and width of the frames [px]."""

    def __call__(self, observation: Any) -> NDArray[np.uint8]:
        """The frame of one observation, a copy: environments may write the next one into the same memory."""
        images = [layout.of(observation) for layout in self._layouts]
        for image, layout in zip(images, self._layouts, strict=True):
            if image.dtype != layout.dtype or image.shape != layout.shape:
                raise ConfigError(f"{self._name} returned {image.dtype}{list(image.shape)}; its observation space promises "
                                  f"{layout.dtype}{list(layout.shape)}. Mend the environment.")
        return side_by_side([image[None] for image in images], self._layouts, self._side, self._fit)[0]


    def state(self, observation: Any) -> NDArray[np.float32] | None:
        """The state [S] of one observation; None for agents that take none."""
        return None if self._state is None else self._state.of(observation)


@dataclass
class _Running:
    """One row's episode in progress."""

    seed: int
    frames: list[NDArray[np.uint8]]
    state: NDArray[np.float32] | None
    plan_ms: list[float] = field(default_factory=list)
    plan_steps: int | None = None

    @property
    def steps(self) -> int:
        return len(self.frames) - 1

    def stacked(self, frame_stack: int) -> NDArray[np.uint8]:
        """The last N frames [N, H, W, 3], oldest first, the first frame repeated at the start."""
        rows = stack_indices(np.array(self.steps), np.array(0), frame_stack)
        return np.stack([self.frames[row] for row in rows])


class Rollout:
    """Runs an agent through episodes in B environments; a row that finishes takes the next seed.

    Without seeds left, a finished row keeps its last state, and its actions are ignored.
    """

    def __init__(self, envs: Sequence[gym.Env[Any, Any]], agent: Agent, read: FrameReader, *,
                 reset_options: dict[str, Any] | None = None, max_steps: int | None = None,
                 success: Success | None = None, observer: Observer | None = None) -> None:
        self._envs = list(envs)
        self._agent = agent
        self._tree = agent if isinstance(agent, FollowsTree) else None
        self._read = read
        self._options = reset_options
        self._max_steps = max_steps
        self._success = success
        self._observer = observer

    def run(self, seeds: Iterable[int]) -> Iterator[Episode]:
        """Run every seed once; yields episodes in the order of finishing."""
        queue = deque(seeds)
        batch = min(len(self._envs), len(queue))
        rows: list[_Running | None] = [None] * batch
        stacks: list[NDArray[np.uint8]] = [np.empty(0, np.uint8)] * batch
        states: list[NDArray[np.float32] | None] = [None] * batch
        while queue or any(row is not None for row in rows):
            self._start(rows, queue)
            for index, row in enumerate(rows):
                if row is not None:
                    stacks[index], states[index] = row.stacked(self._agent.frame_stack), row.state
            held = [state for state in states if state is not None]  # of all rows or of none
            actions = self._agent.act(np.stack(stacks), np.stack(held)) if held else self._agent.act(np.stack(stacks))
            by_plan = None if self._tree is None else self._tree.by_plan
            for index, row in enumerate(rows):
                if row is not None and by_plan is not None:
                    row.plan_steps = (row.plan_steps or 0) + int(by_plan[index])
                episode = None if row is None else self._step(index, row, actions[index])
                if episode is not None:
                    rows[index] = None
                    yield episode

    def _start(self, rows: list[_Running | None], queue: deque[int]) -> None:
        """Start the next seed in every free row."""
        mask = np.zeros(len(rows), bool)
        seeds = np.zeros(len(rows), np.int64)
        for index, row in enumerate(rows):
            if row is None and queue:
                seed = queue.popleft()
                options = {} if self._options is None else {"options": self._options}  # not every environment takes some
                observation, _ = self._envs[index].reset(seed=seed, **options)
                rows[index] = _Running(seed, [self._read(observation)], self._read.state(observation))
                mask[index], seeds[index] = True, seed
        if mask.any():
            self._agent.reset(mask, seeds)

    def _step(self, index: int, row: _Running, action: NDArray[np.float32]) -> Episode | None:
        """One transition of row `index`; returns the episode if it ended."""
        env = self._envs[index]
        if np.isfinite(self._agent.last_plan_ms[index]):
            row.plan_ms.append(float(self._agent.last_plan_ms[index]))
        if self._observer is not None:
            self._observer(Moment(row=index, seed=row.seed, env=env, agent=self._agent, frame=row.frames[-1]))
        observation, reward, terminated, truncated, info = env.step(action.astype(env.action_space.dtype))
        row.frames.append(self._read(observation))
        row.state = self._read.state(observation)
        success = success_of(_number(reward), info, self._success, bool(terminated))
        out_of_time = truncated or (self._max_steps is not None and row.steps >= self._max_steps)
        if not (success or terminated or out_of_time):
            return None
        gave_up = bool(out_of_time and not success and not terminated)
        outcome = Episode(row.seed, success, row.steps, gave_up, tuple(row.plan_ms), row.plan_steps)
        if self._observer is not None:
            self._observer(Moment(row=index, seed=row.seed, env=env, agent=self._agent, frame=row.frames[-1],
                                  outcome=outcome))
        return outcome


def _number(reward: Any) -> float:
    """An environment's reward, also where it is an array of one entry."""
    value = np.asarray(reward)
    if value.size != 1 or value.dtype.kind not in "fiub":
        raise ConfigError(f"the environment gave the reward {str(reward)[:80]}; expected one number. Mend its `step`.")
    return float(value.item())


def make_envs(make: Callable[[], gym.Env[Any, Any]], count: int) -> list[gym.Env[Any, Any]]:
    """`count` environments of one kind, with a continuous action space."""
    envs: list[gym.Env[Any, Any]] = []
    try:
        for _ in range(count):
            envs.append(make())
            space = envs[-1].action_space
            if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
                raise ConfigError(f"the environment's action space is {space}; expected a one-dimensional Box.")
    except BaseException:
        for env in envs:
            env.close()
        raise
    return envs


def play_without_frames(world: Any, act: Callable[[], NDArray[np.floating[Any]]], seed: int, max_steps: int) -> int | None:
    """Steps to success in a task of velap from the test start of that seed; None without success in `max_steps` [steps]."""
    world.start({"split": "test"}, seed)
    return next((step for step in range(1, max_steps + 1) if world.advance(act())), None)
