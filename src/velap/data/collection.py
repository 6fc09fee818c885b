"""Collect the dataset of a task (App. C, Table 10) in parallel: a seed fixes the arrays, whatever the number of workers.

Finished trajectories lie as shards beside the dataset until all are there; then the dataset is built and renamed into place.
A run that was killed goes on from its shards when the same command is given again.
"""

from __future__ import annotations

import dataclasses
import json
import shutil
import time
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from velap.data import card as cards
from velap.data import minari_io
from velap.data.behaviours import reset_options
from velap.data.frames import FrameStore, Reading
from velap.data.worker import Job, Progress, Shard, describe, test_starts, workers
from velap.data.writing import Extras, write_dataset
from velap.errors import StorageError
from velap.storage import replace_file
from velap.tasks import Task, get_task
from velap.threads import usable_cores

SHARD_TRAJECTORIES = 10
"""Trajectories a shard: what a kill costs at most, a worker. ours."""
PLAN_FILE = "plan.json"
_ROW_ARRAYS = ("frames", "actions", "rewards", "terminated", "truncated", "positions")
_EPISODE_ARRAYS = ("length", "reset_seed", "context", "behaviour", "from_test")


@dataclass(frozen=True)
class CollectResult:
    """A finished collection."""

    dataset_id: str
    path: Path
    """Directory of the dataset; `card.md`, `frames.png` and `coverage.png` lie in it."""
    content_hash: str
    """SHA-256 of the arrays, hexadecimal."""
    episodes: int
    transitions: int
    """[steps]"""
    successes: int
    """Transitions with reward 1."""
    resumed: int
    """Trajectories that were there from an interrupted run."""
    seconds: float
    """[s]"""
    card: str
    """Markdown text of the dataset card."""
    notes: tuple[str, ...] = ()
    """What the user should know, such as discarded work."""

    @property
    def success_percent(self) -> float:
        """Share of transitions with reward 1 [%], as in Table 10."""
        return 100.0 * self.successes / self.transitions


def _shards(task: Task) -> list[Shard]:
    recipe = task.recipe
    return [Shard(f"{context:05d}-{first:06d}.npz", context, first, min(SHARD_TRAJECTORIES, recipe.trajectories - first))
            for context in range(recipe.contexts) for first in range(0, recipe.trajectories, SHARD_TRAJECTORIES)]


def _finished(path: Path, shard: Shard) -> bool:
    """Is the shard there, whole and readable?"""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in (*_ROW_ARRAYS, *_EPISODE_ARRAYS)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
        return False
    return len(arrays["length"]) == shard.count and len(arrays["frames"]) == int((arrays["length"] + 1).sum())


def _assemble(directory: Path, shards: list[Shard], description: dict[str, Any],
              dataset_id: str) -> tuple[FrameStore, dict[str, np.ndarray]]:
    """The store of all shards in order, and the arrays that a store does not hold. Frames are copied once."""
    lengths = []
    for shard in shards:
        with np.load(directory / shard.name, allow_pickle=False) as file:
            lengths.append(file["length"])
    frames = np.empty((int((np.concatenate(lengths) + 1).sum()), *description["frame_shape"]), np.uint8)
    parts: dict[str, list[np.ndarray]] = {key: [] for key in (*_ROW_ARRAYS[1:], *_EPISODE_ARRAYS)}
    start = 0
    for shard in shards:
        with np.load(directory / shard.name, allow_pickle=False) as file:
            block = file["frames"]
            frames[start : start + len(block)] = block
            start += len(block)
            for key, part in parts.items():
                part.append(file[key])
    arrays = {key: np.concatenate(part) for key, part in parts.items()}
    low, high = np.asarray(description["action_low"]), np.asarray(description["action_high"])
    store = FrameStore.from_arrays(frames=frames, actions=arrays["actions"], rewards=arrays["rewards"],
                                   terminated=arrays["terminated"], truncated=arrays["truncated"],
                                   episode_length=arrays["length"], action_low=low, action_high=high, dataset_id=dataset_id,
                                   reading=Reading(success="reward>=1"))
    return store, arrays


def _saved_plan(work: Path) -> Any:
    """What the shards in the work directory are of; None when there is no readable plan."""
    try:
        return json.loads((work / PLAN_FILE).read_bytes())
    except (FileNotFoundError, ValueError):
        return None


def _prepare(work: Path, plan: dict[str, Any], resume: bool) -> tuple[str, ...]:
    """Make the work directory hold shards of `plan` only; returns notes about work that was discarded."""
    shards, notes = work / "shards", []
    if _saved_plan(work) != plan or not resume:
        if shards.exists() and any(shards.iterdir()):
            reason = "they are of another seed, recipe, environment or renderer" if resume else "resume is off"
            notes.append(f"the unfinished trajectories of an earlier run were discarded: {reason}.")
        shutil.rmtree(shards, ignore_errors=True)
        replace_file(work / PLAN_FILE, json.dumps(plan, sort_keys=True).encode())
    shards.mkdir(exist_ok=True)
    _sweep(shards)
    return tuple(notes)


def _sweep(shards: Path) -> None:
    """Delete what workers that were killed while they wrote left behind; none may be writing."""
    for leftover in shards.glob(".*.tmp"):
        leftover.unlink(missing_ok=True)


def _forget_finished(work: Path, dataset_id: str) -> None:
    """Delete the shards of a dataset that is there: its run was killed after the last rename."""
    plan = _saved_plan(work)
    if plan is not None and plan == minari_io.velap_metadata(minari_io.read_metadata(dataset_id)).get("plan"):
        with minari_io.exclusive(work, dataset_id):
            shutil.rmtree(work, ignore_errors=True)


def _composition(store: FrameStore, arrays: dict[str, np.ndarray], names: list[str]) -> dict[str, Any]:
    """For the card: trajectories of each context; trajectories and successes by behaviour; how many lead from where tests
    start to a success."""
    won = cards.episode_returns(store) > 0
    chosen = [arrays["behaviour"] == number for number in range(len(names))]
    counts = {name: [int(rows.sum()), int(won[rows].sum())] for name, rows in zip(names, chosen, strict=True)}
    told = arrays["from_test"][arrays["from_test"] >= 0]
    contexts = np.unique(arrays["context"], return_counts=True)[1].tolist()
    return {"contexts": contexts, "behaviours": counts, "from_test": int(told.sum()) if len(told) else None}


def _build(task: Task, plan: dict[str, Any], work: Path, description: dict[str, Any], provenance: dict[str, Any],
           dataset_id: str) -> tuple[FrameStore, Path, str]:
    """Write the dataset and its card from the shards; gives the store, the dataset's directory and the card."""
    store, arrays = _assemble(work / "shards", _shards(task), description, dataset_id)
    recipe, names = task.recipe, sorted(plan["shares"])
    source = "App. E.1" if recipe.success_percent is None else "Table 10"
    positions = arrays["positions"] if arrays["positions"].shape[1] else None
    provenance = {**provenance, **_composition(store, arrays, names)}
    extras = Extras(
        positions=positions,
        seeds=arrays["reset_seed"].tolist(),
        options=[reset_options(int(context)) for context in arrays["context"]],
        behaviours=[names[int(number)] for number in arrays["behaviour"]],
        env_spec=EnvSpec.from_json(description["env_spec"]) if description["env_spec"] else None,
        metadata={"algorithm_name": ", ".join(names), "author": {"velap"},
                  "description": f"{task.name}: {recipe.contexts} × {recipe.trajectories} trajectories of at most "
                                 f"{recipe.max_steps} steps, seed {plan['seed']} ({source} of VELAP, CoRL 2023)."},
        provenance=provenance,
    )
    path = write_dataset(store, extras, overwrite=True,
                         finish=lambda built: cards.save_card(store, built, task, positions, provenance))
    return store, path, cards.dataset_card(store, task, positions, provenance)


def _collect(task: Task, seed: int, count: int, dataset_id: str, resume: bool, progress: Progress,
             command: str) -> CollectResult:
    began, work, shards = time.monotonic(), minari_io.partial_path(dataset_id), _shards(task)
    shares = task.shares
    job = Job(task.env_id, task.recipe, tuple(shares.items()), seed, work / "shards")
    try:
        with workers(count, job) as running:
            description = running.call(describe)
            plan = {"task": task.name, "env_id": task.env_id, "seed": seed, "recipe": dataclasses.asdict(task.recipe),
                    "shares": shares, "fingerprint": description["fingerprint"]}
            notes = _prepare(work, plan, resume)
            pending = [shard for shard in shards if not _finished(work / "shards" / shard.name, shard)]
            total = sum(shard.count for shard in shards)
            resumed = done = total - sum(shard.count for shard in pending)
            progress(done, total)
            for finished in running.collect(pending, plan["fingerprint"]):
                done += finished
                progress(done, total)
            starts = running.call(test_starts)
    finally:
        _sweep(work / "shards")  # an error of one worker ends the others in the middle of their files
    provenance = {"plan": plan, "command": command, "test_starts": starts, "extent": description["extent"]}
    store, path, card = _build(task, plan, work, description, provenance, dataset_id)
    return CollectResult(dataset_id, path, store.content_hash, store.n_episodes, store.n_transitions,
                         int(store.rewards.sum()), resumed, time.monotonic() - began, card, notes)


def collect(task: str | Task, seed: int = 0, workers: int | None = None, dataset_id: str | None = None,
            overwrite: bool = False, resume: bool = True, progress: Progress | None = None,
            command: str | None = None) -> CollectResult:
    """Collect the dataset of a task and write it, with its card, as a Minari dataset.

    Args:
        task: name in `velap.tasks`, or a Task.
        seed: fixes every array of the dataset.
        workers: processes; None takes one for each processor that this process may use.
        dataset_id: Minari id; None takes the task's own.
        overwrite: replace a dataset of that id.
        resume: go on from the trajectories of an interrupted run of the same seed and recipe.
        progress: called with (finished, all) trajectories to move a progress bar.
        command: shell command to name on the card.

    Raises:
        DatasetError: the dataset exists, or a process failed.
        StorageError: the disk is full or may not be written to; finished trajectories are kept for the next run.
    """
    task = get_task(task) if isinstance(task, str) else task
    dataset_id = dataset_id or task.dataset_id
    count = max(1, min(workers or usable_cores(), len(_shards(task))))
    command = command or f"velap collect {task.name} --seed {seed}"
    work = minari_io.partial_path(dataset_id)
    try:
        if minari_io.exists(dataset_id) and not overwrite:
            _forget_finished(work, dataset_id)
        minari_io.refuse_existing(dataset_id, overwrite)
        minari_io.make_namespace(dataset_id)
        with minari_io.exclusive(work, dataset_id):
            result = _collect(task, seed, count, dataset_id, resume, progress or (lambda done, total: None), command)
            shutil.rmtree(work, ignore_errors=True)
    except StorageError:
        raise
    except OSError as error:
        raise minari_io.storage_error(error, f"the dataset {dataset_id}") from error
    return result
