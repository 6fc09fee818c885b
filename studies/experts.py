"""`velap study experts`: is every task solvable from its test starts, and hard for actions that know nothing?

Physics only, no frames: the scripted expert and uniform actions on the seeds of the test split.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from rich.console import Console

import velap.envs  # noqa: F401 - registers the tasks
from velap.evaluation.console import ProgressBar
from velap.evaluation.rollout import play_without_frames
from velap.evaluation.summary import markdown_rows
from velap.runs import write_atomic
from velap.tasks import TASKS, Task, get_task

EPISODES, QUICK_EPISODES = 100, 10


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


def try_task(task: Task, seeds: Sequence[int], on_episode: Callable[[int], object] = lambda seed: None) -> Trials:
    """Expert and uniform actions from the test starts of those seeds."""
    world: Any = gym.make(task.env_id).unwrapped
    lengths, lucky, space = [], 0, world.action_space
    for seed in seeds:
        length, rng = play_without_frames(world, world.expert_action, seed, task.max_steps), np.random.default_rng(seed)
        lengths += [] if length is None else [length]
        lucky += play_without_frames(world, lambda: rng.uniform(space.low, space.high), seed, task.max_steps) is not None  # noqa: B023
        on_episode(seed)
    return Trials(task=task.name, first_seed=seeds[0], episodes=len(seeds), max_steps=task.max_steps, expert=len(lengths),
                  expert_steps=float(np.mean(lengths)) if lengths else None, longest=max(lengths, default=0), random=lucky)


def study_experts(console: Console, quick: bool = False, first_seed: int = 0, write: Path | None = None,
                  json_path: Path | None = None, tasks: Sequence[str] = tuple(TASKS)) -> list[Trials]:
    """Try every task, print the report, and write it as a document and as JSON where asked."""
    count = QUICK_EPISODES if quick else EPISODES
    seeds, trials = range(first_seed, first_seed + count), list[Trials]()
    with ProgressBar(console, "experts", count * len(tasks)) as view:
        for name in tasks:
            trials.append(try_task(get_task(name), seeds,
                                   lambda seed: view.show(count * len(trials) + seed - first_seed + 1)))
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
    """A row a task, in Markdown."""
    head = ("task", "time limit [steps]", "expert", "mean steps", "longest", "uniform actions")
    return markdown_rows(head, [
        (each.task, str(each.max_steps), f"{each.expert} of {each.episodes}",
         "-" if each.expert_steps is None else f"{each.expert_steps:.1f}", str(each.longest),
         f"{each.random} of {each.episodes}") for each in trials])


def report(command: str, trials: Sequence[Trials]) -> str:
    """The document, in Markdown."""
    first, last = trials[0].first_seed, trials[0].first_seed + trials[0].episodes - 1
    return f"""# Experts

Written by `{command} --write docs/experts.md --json results/experts.json`; run it again after a change of a task.
Episodes start as in evaluation, seeds {first} to {last} of the test split, and end at success or at the time limit. The
experts read positions that agents have to see. They show that a task can be solved in time; uniform actions show that
chance does not solve it.

{table(trials)}
"""
