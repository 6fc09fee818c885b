"""`velap figure tasks`: what an agent sees of every task, where a test episode starts and where it has to get.

`velap figure tasks-widowx`: an expert's episode of each task of the WidowX arm, as an agent sees it. F frames.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from rich.console import Console

import velap.envs  # noqa: F401 - registers the tasks
from velap.errors import VelapError
from velap.evaluation.rollout import play_without_frames
from velap.runs import storage_errors
from velap.tasks import ROBOT_TASKS, TASKS, Task

SCALE = 4
"""Enlargement of the frames; a pixel stays a square."""
GAP = 10
"""White between the frames, and below the text under one [px]."""
CAPTION = 26
"""Height of a line of text [px]."""


FILM = 6
"""Frames of an episode that are shown, evenly spaced from start to success."""


@dataclass(frozen=True)
class Shots:
    """Two frames of a test episode of the expert, uint8 [H, W, 3]."""

    task: str
    start: NDArray[np.uint8]
    goal: NDArray[np.uint8]
    steps: int
    """From one to the other [steps]."""


def shoot(task: Task, seed: int = 0) -> Shots:
    """First and last frame of the expert's episode from the test start of that seed."""
    world: Any = gym.make(task.env_id).unwrapped
    world.start({"split": "test"}, seed)
    start = world.render()
    steps = play_without_frames(world, world.expert_action, seed, task.max_steps)
    if steps is None:
        raise VelapError(f"the expert of {task.name} does not solve test seed {seed}; expected success within "
                         f"{task.max_steps} steps. `velap study experts` tells how many seeds it solves; take another one.")
    return Shots(task.name, start, world.render(), steps)


def side_by_side(shots: Sequence[Shots]) -> Image.Image:
    """A column a task: its name, the start above, the goal state below."""
    side = SCALE * shots[0].start.shape[0]
    row = side + CAPTION + GAP
    sheet = Image.new("RGB", (len(shots) * (side + GAP) + GAP, CAPTION + 2 * row), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=17)
    for column, shot in enumerate(shots):
        left = GAP + column * (side + GAP)
        pen.text((left + side / 2, CAPTION / 2), shot.task, fill="black", font=font, anchor="mm")
        below = ((shot.start, "test start"), (shot.goal, f"goal state, {shot.steps} steps later"))
        for top, (frame, caption) in zip((CAPTION, CAPTION + row), below, strict=True):
            large = Image.fromarray(frame).resize((side, side), Image.Resampling.NEAREST)
            sheet.paste(large, (left, top))
            pen.text((left + side / 2, top + side + CAPTION / 2), caption, fill="black", font=font, anchor="mm")
    return sheet


def show_tasks(console: Console, path: Path, seed: int = 0) -> None:
    """Draw all tasks of the registry into a PNG."""
    shots = []
    for task in TASKS.values():
        with console.status(f"drawing {task.name}"):
            shots.append(shoot(task, seed))
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        side_by_side(shots).save(path)
    console.print(f"picture {path}", markup=False)


def film(task: Task, seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Frames [F, H, W, 3] of the expert's episode from the test start of that seed, and their times [F] [steps]."""
    steps = shoot(task, seed).steps
    times = np.linspace(0, steps, FILM).round().astype(np.int64)
    world: Any = gym.make(task.env_id).unwrapped
    frames = [world.reset(seed=seed)[0]]
    frames += [world.step(world.expert_action())[0] for _ in range(steps)]
    return np.stack(frames)[times], times


def strips(films: Mapping[str, tuple[NDArray[np.uint8], NDArray[np.int64]]]) -> Image.Image:
    """A row a task: its frames in order, their times under them."""
    side = SCALE * next(iter(films.values()))[0].shape[1]
    row = side + CAPTION + GAP
    sheet = Image.new("RGB", (FILM * (side + GAP) + GAP, GAP + len(films) * row), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=17)
    for number, (name, (frames, times)) in enumerate(films.items()):
        top = GAP + number * row
        for column, (frame, time) in enumerate(zip(frames, times, strict=True)):
            left = GAP + column * (side + GAP)
            sheet.paste(Image.fromarray(frame).resize((side, side), Image.Resampling.NEAREST), (left, top))
            text = f"{name}, test start" if column == 0 else f"step {time}" + (", success" if column == FILM - 1 else "")
            pen.text((left + side / 2, top + side + CAPTION / 2), text, fill="black", font=font, anchor="mm")
    return sheet


def show_episodes(console: Console, path: Path, seed: int = 0) -> None:
    """Draw an expert's episode of each robot task into a PNG."""
    films = {}
    for task in ROBOT_TASKS:
        with console.status(f"drawing {task.name}"):
            films[task.name] = film(task, seed)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        strips(films).save(path)
    console.print(f"picture {path}", markup=False)
