"""`velap figure sawyer-drawing`: the simplified drawing of the manipulation tasks beside Meta-World's own geometry.

Letters: N states, H×W frame [px].
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from studies.bake_meshes import SITES
from velap.envs.pixels import FRAME_SIZE, Frame, shared_renderer
from velap.envs.sawyer.scene import SHOWN_GROUPS, VIEW
from velap.envs.sawyer.view import View
from velap.evaluation.summary import markdown_rows
from velap.runs import storage_errors
from velap.tasks import get_task

TASKS = ("WindowClose", "FaucetClose", "ButtonWall", "DrawerButton")
SEEDS = range(4)
"""Test episodes of the expert that a comparison walks through."""
EVERY = 10
"""Steps between two compared states [steps]."""
GAIN = 4
"""How much brighter the picture shows a difference."""


_numbers = count()


class OriginalScene:
    """The same view of Meta-World's own geometry, without shadows, reflections and goal marks; slow, to compare with."""

    def __init__(self, model: Any, view: View = VIEW) -> None:
        self.model, self.view = model.__copy__(), view
        for site in range(model.nsite):
            self.model.site_group[site] = 0 if model.site(site).name in SITES else SHOWN_GROUPS
        self.model.cam_fovy[0] = view.fovy
        self._assets = f"original scene {next(_numbers)}"

    def draw(self, model: Any, data: Any, size: int = FRAME_SIZE) -> Frame:
        """The view of a state of the model, an owned uint8 [size, size, 3]."""
        state = data.__copy__()
        state.cam_xpos[0], state.cam_xmat[0] = self.view.position, self.view.axes.T.ravel()
        return shared_renderer(self._assets, self.model, size).draw(self.model, state, camera=0)


@dataclass(frozen=True)
class Comparison:
    """Both drawings of some states of a task."""

    task: str
    originals: NDArray[np.uint8]
    """[N, H, W, 3] Meta-World's own geometry: same camera, same lights, no shadows."""
    ours: NDArray[np.uint8]
    """[N, H, W, 3] as the task draws."""

    @property
    def differences(self) -> NDArray[np.int64]:
        """[N, H, W, 3] absolute differences, of 255."""
        return np.abs(self.originals.astype(np.int64) - self.ours)

    @property
    def mean(self) -> float:
        """Mean difference, of 255."""
        return float(self.differences.mean())

    @property
    def percentile99(self) -> float:
        """99th percentile over pixels of the largest difference of their channels, of 255."""
        return float(np.percentile(self.differences.max(-1), 99))


def compare(task: str, seeds: Sequence[int] = SEEDS, every: int = EVERY) -> Comparison:
    """Draw test episodes of the expert both ways at regular steps, start and success included."""
    env: Any = gym.make(f"velap.envs:{get_task(task).env_id}").unwrapped
    original = OriginalScene(env.model)
    pairs = [(original.draw(env.model, env.data), env.render()) for seed in seeds for _ in _states(env, seed, every)]
    originals, ours = (np.stack(frames) for frames in zip(*pairs, strict=True))
    return Comparison(task, originals, ours)


def _states(env: Any, seed: int, every: int) -> Iterator[int]:
    """Walk the environment through an episode of its expert; stops at regular steps and at its end."""
    env.reset(seed=seed)
    yield 0
    for step in range(1, 300):
        done = env.advance(env.expert_action())
        if done or step % every == 0:
            yield step
        if done:
            return


def drawing_figure(path: Path, comparisons: Sequence[Comparison]) -> None:
    """First and last state of each task: Meta-World's geometry, ours, and the difference."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 2.25 * len(comparisons)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(comparisons), 6, squeeze=False)
    for row, found in zip(grid, comparisons, strict=True):
        row[0].set_ylabel(f"{found.task}\nmean {found.mean:.1f}, p99 {found.percentile99:.0f}")
        for first, state in ((0, 0), (3, len(found.ours) - 1)):
            shown = np.minimum(255, GAIN * found.differences[state]).astype(np.uint8)
            for axes, frame in zip(row[first : first + 3], (found.originals[state], found.ours[state], shown), strict=True):
                axes.imshow(frame, interpolation="nearest")
                axes.set(xticks=[], yticks=[])
    for axes, title in zip(grid[0], ("Meta-World", "velap", f"difference × {GAIN}") * 2, strict=True):
        axes.set_title(title)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, dpi=100)


def show_drawing(console: Console, path: Path) -> None:
    """Compare all tasks, print the differences and write the picture."""
    comparisons = []
    for task in TASKS:
        with console.status(f"drawing {task}"):
            comparisons.append(compare(task))
    rows = [(found.task, str(len(found.ours)), f"{found.mean:.2f}", f"{found.percentile99:.0f}") for found in comparisons]
    head = ("task", "frames", "mean difference (of 255, 64 × 64 px)", "99th percentile")
    drawing_figure(path, comparisons)
    console.print(markdown_rows(head, rows), markup=False, soft_wrap=True)
    console.print(f"picture {path}", markup=False)
