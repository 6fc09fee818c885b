"""What Figures 5 and 6 share: trainings that differ in one thing, their records, and measurements in unseen scenes.

A variant is a change of the preset's config. A cell is a variant, a task and a training seed: a training in `runs/<study>`,
the episodes of VELAP and of π^g, and a file of measurements. `results/<study>/<variant>/<task>/` keeps
`<method>-<preset>/train<seed>.jsonl` and `train<seed>.json`. Table and picture come from these alone.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from studies.exact_latents import collect_states, without_drawing
from studies.objectives import known_phases
from studies.unseen import FIRST_SEED, measure, walks
from velap.api import make_dataset
from velap.config import Config, Phase
from velap.config.training import DYNAMICS_HORIZON
from velap.data.frames import FrameStore
from velap.data.loading import load_store
from velap.errors import ConfigError
from velap.evaluation.console import EpisodeBar, TrainingBar
from velap.evaluation.evaluate import Evaluation, code_version, evaluate, load_player
from velap.evaluation.records import read_records, record_path
from velap.evaluation.summary import markdown_rows, wilson, write_into
from velap.methods.base import get_method
from velap.models.checkpoint import MODEL, WEIGHTS_SHA256, load_checkpoint, shared_weights
from velap.runs import write_atomic
from velap.tasks import get_task, make_config
from velap.training.loop import train

TASKS = ("SpiralMaze", "ObstacleMaze", "WindowClose")
METHODS = {"velap": "VELAP", "td3bc": "π^g alone"}

@dataclass(frozen=True, kw_only=True)
class Variant:
    """One bar or line of a figure."""

    name: str
    """In paths."""
    label: str
    """In pictures and tables."""
    change: Callable[[Config], Config]
    """The preset's config of a task -> that of the variant."""
    states: bool = False
    """Learns from true states in place of frames."""


@dataclass(frozen=True, kw_only=True)
class Study:
    """One figure."""

    root: Path
    """Folder of all cells, `results/<study>`."""
    variants: tuple[Variant, ...]
    table: Callable[[Results], str]
    draw: Callable[[Results, Path], None]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is asked for."""

    study: Study
    tasks: tuple[str, ...] = TASKS
    seeds: tuple[int, ...] = (0, 1)
    """Training seeds."""
    updates: tuple[int, int] | None = None
    """Updates on frames and on frozen latents; None takes the preset's."""
    episodes: int = 100
    device: str = "auto"

    def __post_init__(self) -> None:
        if self.episodes < 1 or min(self.seeds, default=-1) < 0 or (self.updates and min(self.updates) < 1):
            raise ConfigError(f"got {self.episodes} episodes, the training seeds {self.seeds} and the updates "
                              f"{self.updates}; expected at least one episode, seeds of 0 or more, and 1 update or more of "
                              "both kinds.")
        for task in self.tasks:
            get_task(task)

    @property
    def cells(self) -> list[Cell]:
        """Every cell; an interruption leaves comparable ones: all variants of a task and seed come before the next."""
        return [Cell(variant, task, seed, self)
                for seed in self.seeds for task in self.tasks for variant in self.study.variants]


@dataclass(frozen=True)
class Cell:
    """One training with its episodes and measurements."""

    variant: Variant
    task: str
    seed: int
    plan: Plan

    def __str__(self) -> str:
        return f"{self.variant.name} {self.task} seed {self.seed}"

    @property
    def config(self) -> Config:
        """The variant's config with the updates asked for."""
        config = make_config(self.task)
        if self.plan.updates is not None:
            config = with_updates(config, *self.plan.updates)
        return self.variant.change(config)

    @property
    def run_dir(self) -> Path:
        """Folder of the training; another config has another one."""
        study = self.plan.study.root.name
        return Path("runs") / study / self.variant.name / self.task / f"seed{self.seed}-{self.config.hash()}"

    @property
    def records(self) -> Path:
        """Root of its episode records."""
        return self.plan.study.root / self.variant.name

    @property
    def measured(self) -> Path:
        """File of its measurements."""
        return self.records / self.task / f"train{self.seed}.json"

    def record_file(self, method: str) -> Path:
        """Episodes of a method."""
        return record_path(self.records, self.task, method, self.config.preset, self.seed)

    @property
    def state(self) -> str:
        """`done`, or what is there."""
        known = self._known
        if not known:
            return "training" if self.run_dir.exists() else "missing"
        if known["config_hash"] != self.config.hash():
            return "outdated"
        done = [self._episodes(method) for method in METHODS]
        return "done" if min(done) == self.plan.episodes else f"{sum(done)} of {len(done) * self.plan.episodes} episodes"

    @property
    def _known(self) -> dict[str, Any]:
        """The measurements; empty without any."""
        return json.loads(self.measured.read_text()) if self.measured.exists() else {}

    def _episodes(self, method: str) -> int:
        """Recorded episodes of those asked for, by the weights that were measured."""
        path, weights = self.record_file(method), self._known["checkpoints"][method]
        found = read_records(path) if path.exists() else []
        wanted = range(FIRST_SEED, FIRST_SEED + self.plan.episodes)
        return len({each.episode_seed for each in found if each.checkpoint == weights} & set(wanted))

    def run(self, console: Console, fresh: bool) -> None:
        """Train, measure and play what is missing; goes on after an interruption."""
        config = self.config
        device = "cpu" if self.variant.states else self.plan.device
        checkpoint = self.run_dir / MODEL
        if not checkpoint.exists():
            store = training_data(self.task, self.variant.states)
            with TrainingBar(console) as view:
                train(config, store, self.run_dir, seed=self.seed, device=device, resume=True, command=f"studies {self}",
                      loggers=(), on_progress=view)
        model, _, metadata = load_checkpoint(checkpoint)
        if self._known.get("config_hash") != config.hash():
            frames, latents = updates_of(config)
            about = {"variant": self.variant.name, "task": self.task, "train_seed": self.seed, "config_hash": config.hash(),
                     "updates_on_frames": frames, "updates_on_latents": latents,
                     "train_seconds": float(metadata["train_seconds"]), "code_version": code_version(),
                     "checkpoints": {method: metadata[WEIGHTS_SHA256] if get_method(method).whole_checkpoint
                                     else shared_weights(metadata) for method in METHODS}}
            measures = measure(model, config, walks(self.task, self.variant.states))
            write_atomic(self.measured, (json.dumps({**about, **measures}) + "\n").encode())
        for method in METHODS:
            self._play(console, method, checkpoint, device, fresh)

    def _play(self, console: Console, method: str, checkpoint: Path, device: str, fresh: bool) -> None:
        """The missing episodes of a method; with `fresh`, records of another config or training are moved aside first."""
        task, path = get_task(self.task), self.record_file(method)
        what = Evaluation(self.task, method=method, checkpoint=checkpoint, device=device)
        player = load_player(what)
        if self.variant.states:
            player = dataclasses.replace(player, make_env=lambda: gym.wrappers.TimeLimit(without_drawing(task),
                                                                                         task.max_steps))
        other = path.exists() and any(each.checkpoint != player.key.checkpoint for each in read_records(path))
        with EpisodeBar(console, f"{self}, {method}", self.plan.episodes) as view:
            evaluate(what, range(FIRST_SEED, FIRST_SEED + self.plan.episodes), self.records, fresh=fresh and other,
                     player=player, on_record=view)


def updates_of(config: Config) -> tuple[int, int]:
    """Updates on frames and on frozen latents."""
    on_frames, on_latents = (sum(phase.updates for phase in config.train.phases if phase.frozen == frozen)
                             for frozen in (False, True))
    return on_frames, on_latents


def with_updates(config: Config, on_frames: int, on_latents: int) -> Config:
    """The config with so many updates in its phases on frames and in those on frozen latents, in their proportions."""
    def scaled(phase: Phase) -> Phase:
        alike = [other.steps for other in config.train.phases if other.frozen == phase.frozen]
        wanted = on_latents if phase.frozen else on_frames
        return dataclasses.replace(phase, steps=max(1, round(wanted * phase.steps / sum(alike))))

    return with_phases(config, [scaled(phase) for phase in config.train.phases])


def with_phases(config: Config, phases: Sequence[Phase], **model: Any) -> Config:
    """The config with other phases and fields of the model."""
    return dataclasses.replace(config, model=dataclasses.replace(config.model, **model),
                               train=dataclasses.replace(config.train, phases=tuple(phases)))


@lru_cache(maxsize=2)
def training_data(task: str, states: bool) -> FrameStore:
    """The task's dataset, collected if it is missing; with true states in place of frames where asked."""
    return collect_states(get_task(task)) if states else load_store(make_dataset(task), min_length=DYNAMICS_HORIZON)


@dataclass(frozen=True, kw_only=True)
class Result:
    """A variant on a task: all of its training seeds."""

    variant: Variant
    task: str
    measures: tuple[Mapping[str, Any], ...]
    """Files of measurements, a training seed each."""
    outcomes: Mapping[str, tuple[tuple[int, int], ...]]
    """Method -> (solved, episodes) of each training seed that has records."""

    def success(self, method: str) -> tuple[float, float, float]:
        """Solved episodes of all training seeds and their 95 % Wilson interval [%]; NaN without records."""
        solved, episodes = (sum(column) for column in zip(*self.outcomes[method], strict=True)) if self.outcomes[method] \
            else (0, 0)
        if not episodes:
            return float("nan"), float("nan"), float("nan")
        low, high = wilson(solved, episodes)
        return 100 * solved / episodes, 100 * low, 100 * high

    def mean(self, name: str) -> NDArray[np.float64]:
        """A measurement and its interval, means over the training seeds: [3] or [HORIZON, 3]."""
        return np.mean([each[name] for each in self.measures], 0)


Numbers = Sequence[float] | NDArray[np.float64]
Results = Mapping[str, Sequence[Result]]
"""Task -> what its variants came to."""


def gather(folder_of_all: Path, variants: Sequence[Variant]) -> Results:
    """The results that are in the folder, whatever they were made with."""
    found: dict[str, list[Result]] = {}
    names = {path.name for variant in variants for path in (folder_of_all / variant.name).glob("*") if path.is_dir()}
    for task in sorted(names, key=lambda name: (TASKS.index(name) if name in TASKS else len(TASKS), name)):
        for variant in variants:
            folder = folder_of_all / variant.name / task
            measures = tuple(json.loads(path.read_text()) for path in sorted(folder.glob("train*.json")))
            if not measures:
                continue
            outcomes = {method: tuple(_outcome(path) for path in sorted(folder.glob(f"{method}-*/train*.jsonl")))
                        for method in METHODS}
            found.setdefault(task, []).append(Result(variant=variant, task=task, measures=measures, outcomes=outcomes))
    return found


def _outcome(path: Path) -> tuple[int, int]:
    """Solved episodes, and all."""
    episodes = read_records(path)
    return sum(each.success for each in episodes), len(episodes)


def budget(results: Results) -> str:
    """What the results were made with, in a sentence a task."""
    def spread(values: Sequence[int]) -> str:
        low, high = min(values), max(values)
        return f"{low:,}" if low == high else f"{low:,} to {high:,}"

    lines = []
    for task, of_task in results.items():
        each = [measures for result in of_task for measures in result.measures]
        episodes = [count for result in of_task for outcomes in result.outcomes.values() for _, count in outcomes]
        seeds = ", ".join(map(str, sorted({measures["train_seed"] for measures in each})))
        played = f"{spread(episodes)} episodes a method" if episodes else "no episodes yet"
        lines.append(f"- {task}: {spread([measures['updates_on_frames'] for measures in each])} updates on frames, "
                     f"{spread([measures['updates_on_latents'] for measures in each])} on frozen latents, "
                     f"training seeds {seeds}, {played}.")
    return "Made with:\n\n" + "\n".join(lines)


def text_of(values: Numbers, digits: int) -> str:
    """`1.23 (1.10 to 1.36)`."""
    mean, low, high = values
    return "–" if np.isnan(mean) else f"{mean:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def show(console: Console, plan: Plan, write: Path, *, dry_run: bool = False, no_run: bool = False,
         fresh: bool = False) -> None:
    """Complete the cells, print the table and draw; a page beside the picture gets the table too."""
    study = plan.study
    with known_phases():
        if dry_run:
            rows = [(str(cell), cell.state) for cell in plan.cells]
            console.print(markdown_rows(("cell", "state"), rows), markup=False, soft_wrap=True)
            return
        if not no_run:
            _run_cells(console, plan, fresh)
    results = gather(study.root, study.variants)
    if not results:
        raise ConfigError(f"found no measurements below {study.root}; expected those of one cell at least. Leave --no-run "
                          "out.")
    text = f"{budget(results)}\n\n{study.table(results)}"
    console.print(text, markup=False, soft_wrap=True)
    for path in (write, write.with_suffix(".pdf")):
        study.draw(results, path)
    console.print(f"pictures {write} and {write.with_suffix('.pdf').name}", markup=False)
    if (page := write.with_suffix(".md")).is_file():
        write_into(page, text)


COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7")
"""Okabe and Ito's, which colour-blind readers tell apart."""


def bars(axes: Any, names: Sequence[str], groups: Mapping[str, Sequence[Numbers]], colours: Sequence[str]) -> None:
    """Horizontal bars, the first name on top, with lines for intervals: `groups` has [mean, low, high] of each name."""
    height = 0.8 / len(groups)
    for number, (label, values) in enumerate(groups.items()):
        places = [place + height * (number - (len(groups) - 1) / 2) for place in range(len(names))]
        axes.barh(places, [value[0] for value in values], height, label=label, color=colours[number],
                  hatch="////" if number else "", edgecolor="white", linewidth=0)
        axes.hlines(places, [value[1] for value in values], [value[2] for value in values], color="black", linewidth=1.4)
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def success_bars(axes: Any, task: str, results: Sequence[Result]) -> None:
    """Success of both methods, a row a variant."""
    bars(axes, [each.variant.label for each in results],
         {label: [each.success(method) for each in results] for method, label in METHODS.items()}, COLOURS)
    axes.set(xlabel="success [%], 95 % intervals", xlim=(0, 103), title=task)
    axes.title.set_fontweight("bold")


def _run_cells(console: Console, plan: Plan, fresh: bool) -> None:
    """One after the other; raises ConfigError before the first where some belong to another config."""
    old = [str(cell) for cell in plan.cells if cell.state == "outdated"]
    if old and not fresh:
        raise ConfigError(f"{len(old)} cells below {plan.study.root} were made with another config or other updates: "
                          f"{', '.join(old[:3])}...; expected today's. Give the same --updates, or --fresh to make them "
                          "anew.")
    for number, cell in enumerate(plan.cells, start=1):
        if cell.state != "done":
            console.print(f"cell {number} of {len(plan.cells)}: {cell}", markup=False)
            cell.run(console, fresh)
