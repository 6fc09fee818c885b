"""Collect the dataset of a task (App. C, Table 10) in parallel: a seed fixes the arrays, whatever the number of workers.

Finished trajectories lie as shards beside the dataset until all are there; then the dataset is built and renamed into place.
A run that was killed goes on from its shards when the same command is given again.
"""

from __future__ import annotations

import dataclasses
import json
import os
import selectors
import shutil
import subprocess
import sys
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

from velap import errors
from velap.data import minari_io
from velap.data.behaviours import mixture, reset_options
from velap.data.episodes import Extras, FrameStore, make_store, write_dataset
from velap.errors import DatasetError, StorageError, VelapError
from velap.tasks import Task, get_task

SHARD_TRAJECTORIES = 10
"""Trajectories a shard: what a kill costs at most, a worker. ours."""
PLAN_FILE = "plan.json"
_ROW_ARRAYS = ("frames", "actions", "rewards", "terminated", "truncated", "positions")
_EPISODE_ARRAYS = ("length", "reset_seed", "context", "behaviour")
_WORKER_CODE = "from velap.data.worker import main; main()"

Progress = Callable[[int, int], None]
"""Called with (finished trajectories, all trajectories)."""


@dataclass(frozen=True)
class CollectResult:
    """A finished collection."""

    dataset_id: str
    path: Path
    content_hash: str
    """SHA-256 of the arrays."""
    episodes: int
    transitions: int
    """[steps]"""
    successes: int
    """Transitions with reward 1."""
    resumed: int
    """Trajectories that were there from an interrupted run."""
    seconds: float
    notes: tuple[str, ...] = ()
    """What the user should know, such as discarded work."""

    @property
    def success_percent(self) -> float:
        """Share of transitions with reward 1 [%], as in Table 10."""
        return 100.0 * self.successes / self.transitions


class _Worker:
    """One child process that runs trajectories."""

    def __init__(self, job: dict[str, Any], log: Path) -> None:
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
                       "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        self.log = log
        with log.open("wb") as stream:
            self.process = subprocess.Popen([sys.executable, "-c", _WORKER_CODE, json.dumps(job)], stdin=subprocess.PIPE,
                                            stdout=subprocess.PIPE, stderr=stream, env=environment, bufsize=0)

    def ask(self, **request: Any) -> None:
        """Send a request; `answer` reads what comes back."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(request).encode() + b"\n")
        except BrokenPipeError as error:
            raise self._death() from error

    def answer(self) -> dict[str, Any]:
        """Wait for the answer; errors of the worker are raised here."""
        assert self.process.stdout is not None
        line = bytearray()
        while not line.endswith(b"\n"):
            part = self.process.stdout.read(65536)
            if not part:
                raise self._death()
            line += part
        answer = json.loads(line)
        if "error" not in answer:
            return answer
        kind = getattr(errors, answer["error"], None)
        if isinstance(kind, type) and issubclass(kind, VelapError):
            raise kind(answer["text"])
        raise OSError(answer["errno"], answer["text"])

    def _death(self) -> VelapError:
        code = self.process.wait()
        tail = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()][-1:] or ["it left no "
                                                                                                             "message"]
        return DatasetError(f"a collecting process ended with code {code}: {lines[-1] if lines else 'it left no message'}. Expected it to finish its "
                            "trajectories. Those that are "
                            "finished are kept: run the same command again, with fewer --workers if memory was short.")

    def stop(self) -> None:
        """End the process now."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()


@contextmanager
def _workers(count: int, job: dict[str, Any], directory: Path) -> Iterator[list[_Worker]]:
    running: list[_Worker] = []
    try:
        for number in range(count):
            running.append(_Worker(job, directory / f"worker-{number}.log"))
        yield running
    finally:
        for worker in running:
            worker.stop()


@dataclass(frozen=True)
class _Shard:
    name: str
    context: int
    first: int
    count: int


def _shards(task: Task) -> list[_Shard]:
    recipe = task.recipe
    return [_Shard(f"{context:05d}-{first:06d}.npz", context, first, min(SHARD_TRAJECTORIES, recipe.trajectories - first))
            for context in range(recipe.contexts) for first in range(0, recipe.trajectories, SHARD_TRAJECTORIES)]


def _read_shard(path: Path, shard: _Shard) -> dict[str, np.ndarray] | None:
    """The arrays of a finished shard, None when it is missing or damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {key: file[key] for key in (*_ROW_ARRAYS, *_EPISODE_ARRAYS)}
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
    whole = len(arrays["length"]) == shard.count and len(arrays["frames"]) == int((arrays["length"] + 1).sum())
    return arrays if whole else None


def _run(workers: list[_Worker], pending: list[_Shard], done: int, total: int, progress: Progress) -> None:
    """Hand the shards out, one to each worker at a time."""
    queue = deque(pending)
    selector = selectors.DefaultSelector()
    for worker in workers:
        assert worker.process.stdout is not None
        if queue:
            worker.ask(kind="shard", **dataclasses.asdict(queue.popleft()))
            selector.register(worker.process.stdout, selectors.EVENT_READ, worker)
    progress(done, total)
    while selector.get_map():
        for key, _ in selector.select():
            done += key.data.answer()["trajectories"]
            progress(done, total)
            if queue:
                key.data.ask(kind="shard", **dataclasses.asdict(queue.popleft()))
            else:
                selector.unregister(key.fileobj)
    selector.close()


def _assemble(directory: Path, shards: list[_Shard], description: dict[str, Any], dataset_id: str,
              ) -> tuple[FrameStore, dict[str, np.ndarray]]:
    """The store of all shards in order, and the arrays that a store does not hold. Frames are copied once."""
    lengths = []
    for shard in shards:
        with np.load(directory / shard.name, allow_pickle=False) as file:
            lengths.append(file["length"])
    rows = int((np.concatenate(lengths) + 1).sum())
    frames = np.empty((rows, *description["frame_shape"]), np.uint8)
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
    store = make_store(frames, *(arrays[key] for key in (*_ROW_ARRAYS[1:5], "length")), np.asarray(description["action_low"]),
                       np.asarray(description["action_high"]), dataset_id)
    return store, arrays


def _prepare(directory: Path, plan: dict[str, Any], resume: bool) -> list[str]:
    """Make `directory` hold shards of `plan` only; returns notes about work that was discarded."""
    path, shards, notes = directory / PLAN_FILE, directory / "shards", []
    try:
        old = json.loads(path.read_bytes()) if path.exists() else None
    except ValueError:
        old = None
    if old != plan or not resume:
        if shards.exists() and any(shards.iterdir()):
            reason = "resume is off" if resume is False else "they belong to another seed, recipe, version or renderer"
            notes.append(f"unfinished trajectories in {shards} were discarded: {reason}.")
        shutil.rmtree(shards, ignore_errors=True)
        minari_io.write_atomic(path, json.dumps(plan, sort_keys=True).encode())
    shards.mkdir(exist_ok=True)
    for leftover in shards.glob(".*.tmp"):
        leftover.unlink(missing_ok=True)
    return notes


def _result(task: Task, store: FrameStore, path: Path, resumed: int, began: float, notes: list[str]) -> CollectResult:
    return CollectResult(store.dataset_id, path, store.content_hash, store.n_episodes, store.n_transitions,
                         int(store.rewards.sum()), resumed, time.monotonic() - began, tuple(notes))


def _build(task: Task, plan: dict[str, Any], work: Path, description: dict[str, Any], starts: list[list[float]],
           dataset_id: str, command: str) -> tuple[FrameStore, Path]:
    store, arrays = _assemble(work / "shards", _shards(task), description, dataset_id)
    names = sorted(plan["shares"])
    options = [{**reset_options(task.recipe, int(context)), "behaviour": names[int(number)]}
               for context, number in zip(arrays["context"], arrays["behaviour"], strict=True)]
    spec = EnvSpec.from_json(description["env_spec"]) if description["env_spec"] else None
    extras = Extras(
        positions=arrays["positions"] if arrays["positions"].shape[1] else None,
        seeds=arrays["reset_seed"].tolist(),
        options=options, env_spec=spec,
        metadata={"algorithm_name": ", ".join(names), "author": {"velap"},
                  "description": f"{task.name}: {task.recipe.contexts} × {task.recipe.trajectories} trajectories of at most "
                                 f"{task.recipe.max_steps} steps, seed {plan['seed']} (Table 10 of VELAP, CoRL 2023)."},
        provenance={"plan": plan, "command": command, "test_starts": starts, "extent": description["extent"]},
    )
    return store, write_dataset(store, extras, overwrite=True)


def collect(task: str | Task, seed: int = 0, workers: int | None = None, dataset_id: str | None = None,
            overwrite: bool = False, resume: bool = True, progress: Progress | None = None, command: str | None = None) -> CollectResult:
    """Collect the dataset of a task and write it as a Minari dataset.

    Args:
        task: name in `velap.tasks`, or a Task.
        seed: fixes every array of the dataset.
        workers: processes; None takes the processors that this process may use.
        dataset_id: Minari id; None takes the task's own.
        overwrite: replace a dataset of that id.
        resume: go on from the trajectories of an interrupted run of the same seed and recipe.
        progress: called with (finished, all) trajectories.
        command: shell command to name on the card.

    Raises:
        DatasetError: the dataset exists, or a process failed.
        StorageError: the disk is full or not writable; finished trajectories are kept where they fit.
    """
    task = get_task(task) if isinstance(task, str) else task
    dataset_id = dataset_id or task.dataset_id
    count = max(1, min(workers or len(os.sched_getaffinity(0)), len(_shards(task))))
    target, work = minari_io.dataset_path(dataset_id), minari_io.partial_path(dataset_id)
    minari_io.refuse_existing(dataset_id, overwrite)
    try:
        minari_io.make_namespace(dataset_id)
        with minari_io.exclusive(work, dataset_id):
            result = _collect(task, seed, count, dataset_id, work, resume, progress or (lambda done, total: None),
                              command or f"velap collect {task.name} --seed {seed}")
            shutil.rmtree(work, ignore_errors=True)
    except StorageError:
        raise
    except OSError as error:
        raise minari_io.storage_error(error, f"the dataset {dataset_id} to {target}") from error
    return result


def _collect(task: Task, seed: int, count: int, dataset_id: str, work: Path, resume: bool, progress: Progress,
             command: str) -> CollectResult:
    began = time.monotonic()
    shards, shares = _shards(task), mixture(task.name)
    recipe = dataclasses.asdict(task.recipe)
    job = {"env_id": task.env_id, "recipe": recipe, "shares": shares, "seed": seed, "shards": str(work / "shards")}
    with _workers(count, job, work) as running:
        for worker in running:
            worker.ask(kind="describe")
        descriptions = [worker.answer() for worker in running]
        description = descriptions[0]
        if any(other["fingerprint"] != description["fingerprint"] for other in descriptions):
            raise DatasetError(f"two processes got different frames from {task.env_id} for one seed; expected equal ones. "
                               "The environment or "
                               "the renderer is not deterministic: use one renderer for all (MUJOCO_GL=egl or osmesa).")
        plan = {"task": task.name, "env_id": task.env_id, "seed": seed, "recipe": recipe, "shares": shares,
                "fingerprint": description["fingerprint"]}
        notes = _prepare(work, plan, resume)
        pending = [shard for shard in shards if _read_shard(work / "shards" / shard.name, shard) is None]
        total = task.recipe.contexts * task.recipe.trajectories
        resumed = total - sum(shard.count for shard in pending)
        _run(running, pending, resumed, total, progress)
        running[0].ask(kind="test_starts")
        starts = running[0].answer()["test_starts"]
    store, path = _build(task, plan, work, description, starts, dataset_id, command)
    return _result(task, store, path, resumed, began, notes)
