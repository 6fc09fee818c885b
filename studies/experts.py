"""`velap study experts`: is every task solvable from its test starts, and hard for actions that know nothing?

Physics only, no frames: the scripted expert and uniform actions on the seeds of the test split. In the block mazes also a
block that goes straight. A action entries, P points.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

import velap.envs  # noqa: F401 - registers the tasks
from velap.envs.mazes.geometry import Layout
from velap.envs.protocol import Walled
from velap.evaluation.console import ProgressBar
from velap.evaluation.rollout import play_without_frames
from velap.runs import write_atomic
from velap.tasks import TASKS, Task, get_task

EPISODES, QUICK_EPISODES = 100, 10
OTHER_SEEDS = range(1000, 2000)
"""Further test starts for which a straight line is looked for; no frames and no physics, so that they cost little."""
HEADINGS = 36
"""Headings that are tried where the block holds one for a whole episode: every 10 degrees."""
_STALLED = 1e-4
"""A block that moves less in a step at top speed [m] is stuck for good."""


@dataclass(frozen=True, kw_only=True)
class Trials:
    """How one task went."""

    task: str
    first_seed: int
    episodes: int
    max_steps: int
    """Time limit [steps]."""
    expert: int
    """Episodes that the expert solved."""
    expert_steps: float | None
    """Mean length of those [steps]; None where there is none."""
    longest: int
    """Longest of those [steps]."""
    random: int
    """Episodes that uniform actions solved."""
    straight: int | None = None
    """Block mazes: test starts of the same seeds from which some straight line of sight ends in the goal."""
    held: int | None = None
    """Block mazes: test starts from which some heading, held at top speed for the whole episode, ends in the goal; the block
    slides along walls."""
    other_straight: int | None = None
    """`straight` for the seeds of `OTHER_SEEDS`."""


def uniform(space: gym.spaces.Box, seed: int) -> Callable[[], NDArray[np.floating[Any]]]:
    """Independent uniform actions [A]."""
    rng = np.random.default_rng(seed)
    return lambda: rng.uniform(space.low, space.high)


def goes_straight(layout: Layout, position: NDArray[np.float64]) -> bool:
    """Does some straight line from position [2] [m] end in the goal without a wall on the way? 256 points are tried."""
    goal, part = layout.reachable_goal, np.linspace(0.0, 1.0, 64)
    (x, y), (half_x, half_y) = goal.centre, goal.half_size
    along, zero = 2 * part - 1, np.ones(len(part))
    points = np.concatenate([np.stack([x + half_x * u, y + half_y * v], -1)
                             for u, v in ((along, zero), (along, -zero), (zero, along), (-zero, along))])
    return bool(layout.sees(position, points).any())


def heading_solves(world: Any, seed: int, max_steps: int) -> bool:
    """Does some heading, held at top speed from the test start of that seed, end in the goal?"""
    for angle in np.linspace(0.0, 2 * np.pi, HEADINGS, endpoint=False):
        world.start({"split": "test"}, seed)
        action, before = np.array([np.cos(angle), np.sin(angle)]), world.agent_position()
        for _ in range(max_steps):
            if world.advance(action):
                return True
            after = world.agent_position()
            if np.abs(after - before).max() < _STALLED:
                break
            before = after
    return False


def _sight_lines(world: Any, seeds: Sequence[int]) -> int:
    """Test starts of those seeds from which some straight line ends in the goal."""
    found = 0
    for seed in seeds:
        world.start({"split": "test"}, seed)
        found += goes_straight(world.layout, world.agent_position())
    return found


def try_task(task: Task, seeds: Sequence[int], on_episode: Callable[[int], object] = lambda seed: None) -> Trials:
    """Expert, uniform actions and straight lines from the test starts of those seeds."""
    world: Any = gym.make(task.env_id).unwrapped
    lengths, lucky, held = [], 0, 0
    maze = isinstance(world, Walled)
    for seed in seeds:
        length = play_without_frames(world, world.expert_action, seed, task.max_steps)
        lengths += [] if length is None else [length]
        lucky += play_without_frames(world, uniform(world.action_space, seed), seed, task.max_steps) is not None
        held += maze and heading_solves(world, seed, task.max_steps)
        on_episode(seed)
    lines: dict[str, int] = {}
    if maze:
        lines = {"straight": _sight_lines(world, seeds), "held": held, "other_straight": _sight_lines(world, OTHER_SEEDS)}
    return Trials(
        task=task.name,
        first_seed=seeds[0],
        episodes=len(seeds),
        max_steps=task.max_steps,
        expert=len(lengths),
        expert_steps=float(np.mean(lengths)) if lengths else None,
        longest=max(lengths, default=0),
        random=lucky,
        **lines)


def study_experts(console: Console, quick: bool = False, first_seed: int = 0, write: Path | None = None,
                  json_path: Path | None = None, tasks: Sequence[str] = tuple(TASKS)) -> list[Trials]:
    """Try every task, print the report, and write it as a document and as JSON where asked."""
    count = QUICK_EPISODES if quick else EPISODES
    seeds, done, trials = range(first_seed, first_seed + count), 0, []
    with ProgressBar(console, "experts", count * len(tasks)) as view:
        for name in tasks:
            trials.append(try_task(get_task(name), seeds, lambda seed: view.show(done + seed - first_seed + 1)))  # noqa: B023
            done += count
    command = "velap study experts" + (" --quick" if quick else "") + (f" --seed {first_seed}" if first_seed else "")
    console.print(table(trials), markup=False, soft_wrap=True)
    if write is not None:
        write_atomic(write, report(command, trials).encode())
        console.print(f"report {write}", markup=False)
    if json_path is not None:
        write_atomic(json_path, (json.dumps([asdict(entry) for entry in trials], indent=1) + "\n").encode())
        console.print(f"written to {json_path}", markup=False)
    return trials


def table(trials: Sequence[Trials]) -> str:
    """Markdown rows."""
    head = ("| task | time limit [steps] | expert | mean steps | longest | uniform actions | straight line | held heading "
            "| straight line, other seeds |\n" + "| --- " * 9 + "|")
    rows = [f"| {entry.task} | {entry.max_steps} | {entry.expert} of {entry.episodes} | "
            f"{'-' if entry.expert_steps is None else f'{entry.expert_steps:.1f}'} | "
            f"{entry.longest} | {entry.random} of {entry.episodes} | {_count(entry.straight, entry.episodes)} | "
            f"{_count(entry.held, entry.episodes)} | {_count(entry.other_straight, len(OTHER_SEEDS))} |" for entry in trials]
    return "\n".join([head, *rows])


def _count(number: int | None, total: int) -> str:
    return "-" if number is None else f"{number} of {total}"


def report(command: str, trials: Sequence[Trials]) -> str:
    """The document, in Markdown."""
    first, last = trials[0].first_seed, trials[0].first_seed + trials[0].episodes - 1
    return f"""# Experts

Written by `{command} --write docs/experts.md --json results/experts.json`; run it again after a change of a task.
Episodes start as in evaluation, seeds {first} to {last} of the test split, and end at success or at the time limit. The
experts read positions that agents have to see. They show that a task can be solved in time, uniform actions that it does
not solve itself.

{table(trials)}

The last three columns belong to the block mazes. *Straight line*: starts from which some straight line ends in the goal
without a wall on the way; on other seeds too, {OTHER_SEEDS.start} to {OTHER_SEEDS.stop - 1}. *Held heading*: starts
from which one of {HEADINGS} headings, held at top speed for the whole episode, ends in the goal, though the block may slide
along walls.
"""
