"""`velap figure tasks` and `tasks-widowx`: expert's episodes as an agent sees them. F frames, H x W pixels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
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
"""Enlargement of the frames."""
GAP = 10
"""White between the frames, and below a caption [px]."""
CAPTION = 26
"""Height of a caption [px]."""

Shot = tuple[NDArray[np.uint8], str]
"""A frame uint8 [H, W, 3] and its caption."""


def film(task: Task, seed: int, count: int) -> list[Shot]:
    """`count` evenly spaced frames of the expert's episode from the test start of `seed` to success."""
    world: Any = gym.make(task.env_id).unwrapped
    frames: list[NDArray[np.uint8]] = []

    def act() -> NDArray[np.floating[Any]]:
        frames.append(world.render())
        return world.expert_action()

    steps = play_without_frames(world, act, seed, task.max_steps)
    if steps is None:
        raise VelapError(f"the expert of {task.name} does not solve test seed {seed}; expected success within "
                         f"{task.max_steps} steps. Take another seed: `velap study experts` tells how many it solves.")
    frames.append(world.render())
    captions = {0: f"{task.name}, test start", steps: f"success after {steps} steps"}
    return [(frames[step], captions.get(step, f"step {step}")) for step in np.linspace(0, steps, count).round().astype(int)]


def sheet(rows: Sequence[Sequence[Shot]]) -> Image.Image:
    """A grid of enlarged frames, each with its caption below."""
    side = SCALE * len(rows[0][0][0])
    width, height = side + GAP, side + CAPTION + GAP
    picture = Image.new("RGB", (len(rows[0]) * width + GAP, len(rows) * height + GAP), "white")
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(size=17)
    for row, shots in enumerate(rows):
        for column, (frame, caption) in enumerate(shots):
            left, top = GAP + column * width, GAP + row * height
            picture.paste(Image.fromarray(frame).resize((side, side), Image.Resampling.NEAREST), (left, top))
            pen.text((left + side / 2, top + side + CAPTION / 2), caption, fill="black", font=font, anchor="mm")
    return picture


def show_tasks(console: Console, path: Path, seed: int = 0) -> None:
    """Draw test start and success of every task, a column a task, into a PNG."""
    _draw(console, path, list(zip(*_films(console, TASKS.values(), seed, 2), strict=True)))


def show_episodes(console: Console, path: Path, seed: int = 0) -> None:
    """Draw an episode of each robot task, a row a task, into a PNG."""
    _draw(console, path, _films(console, ROBOT_TASKS, seed, 6))


def _films(console: Console, tasks: Iterable[Task], seed: int, count: int) -> list[list[Shot]]:
    films = []
    for task in tasks:
        with console.status(f"drawing {task.name}"):
            films.append(film(task, seed, count))
    return films


def _draw(console: Console, path: Path, rows: Sequence[Sequence[Shot]]) -> None:
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        sheet(rows).save(path)
    console.print(f"picture {path}", markup=False)
