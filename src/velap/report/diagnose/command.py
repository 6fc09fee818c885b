"""`velap diagnose`: measures what a model has learnt and where its episodes fail, and writes pictures and a page."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from rich.console import Console

from velap.config import Config, override
from velap.data import minari_io
from velap.errors import ConfigError, DatasetError
from velap.evaluation.evaluate import Evaluation, Player, load_player
from velap.models.checkpoint import load_checkpoint, released_checkpoint
from velap.models.velap import LatentModel
from velap.report.diagnose import figures
from velap.report.diagnose.failures import Failures, watch
from velap.report.diagnose.model import (
    ActionValues,
    Recorded,
    RolloutError,
    StatePairs,
    ValueCurve,
    action_values,
    encode_states,
    open_recorded,
    other_pairs,
    real_states_of,
    rewarded_curves,
    rollout_error,
)
from velap.report.diagnose.plans import Starts, Trees, diagnose_trees
from velap.report.diagnose.text import checks, page
from velap.report.diagnose.world import Scene, expert_curves, first_states, has_layout, look_at_scene
from velap.report.figures import RealStates, can_probe, probe, strip_figure
from velap.runs import only_writer, write_atomic
from velap.storage import folder_name
from velap.tasks import TASKS, get_task, task_of
from velap.training.diagnostics import horizons
from velap.training.loop import pick_device

FIRST_SEED = 1000
"""Test episodes, 0 to 99, are for results alone."""
TEST_SEEDS = range(100)
STARTS = 5
"""Plans. ours."""
SCENES = 3
"""Scenes and expert's episodes. ours."""
LONGEST = 20
"""Longest rollout [steps]. ours."""
PAGE = "report.md"


@dataclass(frozen=True, kw_only=True)
class Request:
    """What to diagnose."""

    task: str | None = None
    """Task name; any label with `dataset` or `env`, or None: the dataset's task."""
    checkpoint: Path | None = None
    """None takes the task's released one."""
    dataset: str | None = None
    """Minari id; None takes the task's own."""
    out: Path | None = None
    """Folder of the report; None takes `runs/diagnosis/<task>`."""
    episodes: int = 10
    first_seed: int = FIRST_SEED
    device: str = "auto"
    changes: Mapping[str, dict[str, Any]] | None = None
    """Config fields to replace."""
    env: str | None = None
    """Gymnasium id instead of the task's own."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    image_key: str | None = None
    max_steps: int | None = None
    """Time limit where the environment has none, or a shorter one [steps]."""
    success: str | None = None
    """What counts as success, a rule of `velap.data.success`."""
    command: str = "velap diagnose"


@dataclass(frozen=True, kw_only=True)
class Diagnosis:
    """All results; text and pictures read it."""

    subject: str
    command: str
    origin: str
    """Which checkpoint, dataset and episodes were examined."""
    left_out: tuple[str, ...]
    discount: float
    """γ."""
    arrived_steps: float
    """A state at most this far by Q^l counts as arrived, `controller.waypoint_exponent` [steps]."""
    simulated: int
    """Simulated steps of an expansion, `planner.n_sim` [steps]."""
    rollout: RolloutError
    pairs: tuple[StatePairs, ...]
    curves: tuple[ValueCurve, ...]
    actions: ActionValues
    scenes: tuple[Scene, ...]
    trees: Trees
    failures: Failures | None


class _Subject(NamedTuple):
    """What a request refers to."""

    name: str
    checkpoint: Path
    dataset_id: str
    evaluation: Evaluation | None
    """None without an environment."""


def resolve(request: Request) -> _Subject:
    """Find checkpoint, dataset and environment; raises an error that says how to get a missing one."""
    task, env = request.task, request.env
    if task is None:
        if request.dataset is None:
            raise ConfigError("got neither a task nor a dataset; expected `velap diagnose TASK`, or `velap diagnose "
                              "--dataset ID --checkpoint FILE`.")
        task = task_of(request.dataset)
    if request.dataset is None:
        get_task(task)
    if env is not None or task in TASKS:
        _check_seeds(request, task in TASKS and env is None)
    checkpoint = request.checkpoint
    if checkpoint is None:
        if task not in TASKS:
            raise ConfigError(f"got no checkpoint for {task!r}; expected --checkpoint with the `model.safetensors` of a "
                              f"run. Make one with `velap train --dataset {request.dataset}`.")
        checkpoint = released_checkpoint(task)
    dataset_id = request.dataset or TASKS[task].dataset_id
    if task in TASKS and dataset_id == TASKS[task].dataset_id and not minari_io.exists(dataset_id):
        raise DatasetError(f"the dataset {dataset_id} is not on this machine; a diagnosis compares the model with recorded "
                           f"episodes. Make it with `velap collect {task}`, or name another one with --dataset.")
    evaluation = None
    if env is not None or task in TASKS:
        changes = dict(request.changes or {})
        evaluation = Evaluation(task, checkpoint=checkpoint, env=env, env_kwargs=request.env_kwargs,
                                image_key=request.image_key, max_steps=request.max_steps,
                                success=request.success, device=request.device, changes=changes)
    return _Subject(task, checkpoint, dataset_id, evaluation)


def _check_seeds(request: Request, ours: bool) -> None:
    """Raises ConfigError for no episodes, or for test episodes of our tasks."""
    if request.episodes < 1:
        raise ConfigError(f"got {request.episodes} episodes; expected at least one.")
    last = request.first_seed + max(request.episodes, STARTS) - 1
    if request.first_seed < 0 or (ours and request.first_seed in TEST_SEEDS):
        raise ConfigError(f"got seeds {request.first_seed} to {last}; seeds {TEST_SEEDS.start} to {TEST_SEEDS.stop - 1} are "
                          f"the test episodes, on which nothing is tuned. Take others, such as --first-seed {FIRST_SEED}.")


def run_diagnose(console: Console, request: Request) -> Diagnosis:
    """Measure, draw and write; prints the checks and the path of the report."""
    began = time.monotonic()
    subject = resolve(request)
    model, config, metadata = load_checkpoint(subject.checkpoint, pick_device(request.device))
    config = override(config, **dict(request.changes or {}))
    player = None if subject.evaluation is None else load_player(subject.evaluation)
    with console.status(f"reading {subject.dataset_id}"):
        recorded = open_recorded(subject.dataset_id, request.image_key, model, config, metadata, request.success)
    out = request.out or Path("runs/diagnosis") / folder_name(subject.name)
    with only_writer(out, "a diagnosis"):
        diagnosis = _measure(console, request, subject, model, config, recorded, player)
        with console.status("drawing"):
            pictures = _draw(diagnosis, out)
        write_atomic(out / PAGE, page(diagnosis, pictures).encode())
    for each in checks(diagnosis):
        console.print(f"{each.mark:>4}  {each.title}: {each.numbers}", markup=False, soft_wrap=True)
    console.print(f"report {out / PAGE}, {time.monotonic() - began:.0f} s", markup=False, soft_wrap=True)
    return diagnosis


def _measure(console: Console, request: Request, subject: _Subject, model: LatentModel, config: Config, recorded: Recorded,
             player: Player | None) -> Diagnosis:
    """All results."""
    rng = np.random.default_rng(0)
    longest = int(recorded.store.episode_length[recorded.episodes].max())
    with console.status("rollouts and distances on recorded episodes"):
        rollout = rollout_error(horizons(model, recorded.sampler, recorded.spans, range(1, min(LONGEST, longest) + 1), None))
        pairs = other_pairs(model, recorded, config.train.group_reach, rng)
        real_states, held_out = real_states_of(model, recorded, rng), encode_states(model, recorded.sampler, recorded.rows)
    world = _World() if player is None else _look_at_world(console, request, model, player)
    starts = world.starts or _recorded_starts(recorded)
    with console.status("plans"):
        seeds = range(request.first_seed, request.first_seed + len(starts.labels))
        trees = diagnose_trees(model, config, starts, seeds=seeds, real_states=real_states, scenery=world.scenery,
                               held_out=held_out.cpu().numpy(), one_step=rollout.one_step)
    curves = world.curves or tuple(rewarded_curves(model, recorded))
    failures = None
    if player is not None:
        with console.status(f"{request.episodes} episodes at once"):
            failures = watch(player, range(request.first_seed, request.first_seed + request.episodes), recorded.fastest)
    return Diagnosis(
        subject=subject.name,
        command=request.command,
        origin=_origin(subject, recorded, config),
        left_out=_left_out(world, player),
        discount=model.discount,
        arrived_steps=config.controller.waypoint_exponent,
        simulated=config.planner.n_sim,
        rollout=rollout,
        pairs=tuple(pairs),
        curves=curves,
        actions=action_values(model, recorded, held_out),
        scenes=world.scenes,
        trees=trees,
        failures=failures)


class _World(NamedTuple):
    """Measured in an environment."""

    starts: Starts | None = None
    curves: tuple[ValueCurve, ...] = ()
    scenes: tuple[Scene, ...] = ()
    scenery: RealStates | None = None


def _look_at_world(console: Console, request: Request, model: LatentModel, player: Player) -> _World:
    """Starts, expert's episodes and scenes of the first seeds."""
    env: gym.Env[Any, Any] = player.make_env()
    seeds, frame_stack = range(request.first_seed, request.first_seed + STARTS), player.config.model.frame_stack
    try:
        read = player.frames_of(env)
        with console.status("the expert's episodes"):
            curves = expert_curves(model, env, frame_stack, seeds[:SCENES])
        scenes, around = [], None
        with console.status("test scenes"):
            if has_layout(env):
                scenes = [look_at_scene(model, env, read, frame_stack, seed) for seed in seeds[:SCENES]]
            if can_probe(env):
                around = probe(model, env, read, frame_stack=frame_stack, rng=np.random.default_rng(seeds[0]), seed=seeds[0])
        return _World(first_states(player, env, seeds), tuple(curves), tuple(scenes), around)
    finally:
        env.close()


def _recorded_starts(recorded: Recorded) -> Starts:
    """First states of the examined episodes."""
    picked = recorded.episodes[:STARTS]
    rows = recorded.sampler.starts.new_tensor(recorded.store.episode_start[picked])
    return Starts(tuple(f"episode {episode} of the data" for episode in picked), recorded.sampler.stacks(rows).cpu().numpy())


def _origin(subject: _Subject, recorded: Recorded, config: Config) -> str:
    """Which checkpoint, dataset and episodes were examined."""
    kind = "were not trained on" if recorded.held_out else "were trained on: the dataset is too small to keep any out"
    return (f"Checkpoint `{subject.checkpoint.name}` (task {config.task}, preset {config.preset}), dataset "
            f"{subject.dataset_id} with {recorded.store.n_episodes} episodes; the {len(recorded.episodes)} examined "
            f"ones {kind}.")


def _left_out(world: _World, player: Player | None) -> tuple[str, ...]:
    """What could not be measured, and why."""
    if player is None:
        return ("true distances, the expert's path and episodes: there is no environment (--env names one). Plans start "
                "from recorded states, Q^g is shown along rewarded recorded episodes.",)
    missing = [] if world.scenes else ["true distances in test scenes: only the block mazes tell them."]
    if not world.curves:
        missing.append("the expert's path: the environment has no scripted expert that succeeds. Q^g is shown along "
                       "rewarded recorded episodes.")
    return tuple(missing)


def _draw(diagnosis: Diagnosis, out: Path) -> list[str]:
    """Draw all results; names of the pictures."""
    shown = {"model.png": lambda path: figures.model_figure(path, diagnosis.rollout, diagnosis.pairs)}
    if diagnosis.curves:
        shown["values.png"] = lambda path: figures.values_figure(path, diagnosis.curves)
    if diagnosis.scenes:
        shown["scenes.png"] = lambda path: figures.scenes_figure(path, diagnosis.scenes)
    shown["plan.png"] = lambda path: strip_figure(path, diagnosis.trees.strip)
    if (failures := diagnosis.failures) is not None:
        shown["failure.png"] = lambda path: strip_figure(path, failures.strip)
    for name, draw in shown.items():
        draw(out / name)
    return list(shown)
