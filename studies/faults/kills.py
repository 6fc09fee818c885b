"""`kill -9` at random moments of training and collecting, then resuming: all files readable, the same final bits.

Runs are `velap` commands in processes of their own, on a SpiralMaze shrunk to seconds (`shrink`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from velap.errors import VelapError
from velap.tasks import TASKS

TASK = "SpiralMaze"
SMALL: dict[str, dict[str, Any]] = {
    "train": {"joint": {"steps": 12, "windows": 4}, "latent": {"steps": 12}, "log_every": 2, "checkpoint_every": 2},
    "planner": {"n_iter": 10, "candidates": 5}, "model": {"bank_size": 32},
}
"""Config fields of the shrunk task: a run of seconds with a checkpoint every other step, in both phases."""
TRAJECTORIES = 120
"""Trajectories of the shrunk recipe; some reach the goal."""
FILE_LIMIT, KILL_AT = "VELAP_FILE_LIMIT", "VELAP_KILL_AT_FSYNC"
"""Environment variables of `shrunk_main`: largest file [bytes], number of the fsync to die at."""
CODE = "import sys; from studies.faults.kills import shrunk_main; from velap.cli import main; sys.exit(shrunk_main(main))"


def shrink() -> None:
    """Replace SpiralMaze in this process by a version with few trajectories and updates."""
    task = TASKS[TASK]
    recipe = dataclasses.replace(task.recipe, trajectories=TRAJECTORIES)
    TASKS[TASK] = dataclasses.replace(task, recipe=recipe, overrides=SMALL)


def shrunk_main(main: Callable[[], int]) -> int:
    """`main`, the command line, with the shrunk task and the faults of the environment variables."""
    if FILE_LIMIT in os.environ:
        import resource

        limit = int(os.environ[FILE_LIMIT])
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    if KILL_AT in os.environ:
        _kill_at_fsync(int(os.environ[KILL_AT]))
    shrink()
    return main()


def _kill_at_fsync(number: int) -> None:
    """Make this process kill itself at its `number`-th fsync, before the written file is renamed into place."""
    fsync, calls = os.fsync, count(1)

    def dying(descriptor: Any) -> None:
        if next(calls) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        fsync(descriptor)

    os.fsync = dying  # type: ignore[assignment]


def start(arguments: Sequence[str], folder: Path, datasets: Path, **extra: str) -> subprocess.Popen[str]:
    """Start `velap arguments` in `folder` with Minari's root `datasets`."""
    environment = {**os.environ, "MINARI_DATASETS_PATH": str(datasets), "OMP_NUM_THREADS": "1", "COLUMNS": "200",
                   "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry), **extra}
    return subprocess.Popen([sys.executable, "-c", CODE, *arguments], cwd=folder, env=environment, text=True,
                            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def unreadable(folder: Path) -> list[str]:
    """Unreadable files below `folder`, except unfinished ones, whose names begin with a dot."""
    problems = []
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith(".")):
        try:
            _read(path)
        except (VelapError, OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            problems.append(f"{path.relative_to(folder)} is unreadable: {type(error).__name__}")
    return problems


def leftovers(folder: Path) -> list[str]:
    """Temporary files and folders of unfinished work below `folder`."""
    return [f"{path.relative_to(folder)} was left behind" for path in sorted(folder.rglob(".*"))]


def _read(path: Path) -> None:
    """Read a file to its end, and compare its checksum if it has one."""
    from velap.data.minari_io import file_sha256
    from velap.runs import load_tensors

    if path.suffix == ".safetensors":
        load_tensors(path)
    elif path.suffix == ".json":
        json.loads(path.read_bytes())
    elif path.suffix == ".jsonl":
        for line in path.read_text().splitlines():
            json.loads(line)
    elif path.suffix == ".npz":
        with np.load(path, allow_pickle=False) as file:
            for name in file:
                _ = file[name]
    elif path.suffix == ".hdf5":
        stored = json.loads((path.parent / "metadata.json").read_bytes())["velap"]["file_sha256"]
        if file_sha256(path) != stored:
            raise ValueError(f"{path} is not what its metadata say")


def fingerprint(folder: Path) -> str:
    """SHA-256 of the weights, logged losses and dataset arrays of a run, without times."""
    from velap.runs import load_tensors

    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*")):
        if path.name == "model.safetensors":
            tensors, _ = load_tensors(path)
            for name in sorted(tensors):
                digest.update(name.encode() + tensors[name].contiguous().numpy().tobytes())
        elif path.name == "metrics.jsonl":
            rows = [json.loads(line) for line in path.read_text().splitlines()]
            digest.update(json.dumps([{k: v for k, v in row.items() if k != "seconds"} for row in rows]).encode())
        elif path.name == "metadata.json":
            digest.update(json.loads(path.read_bytes())["velap"]["content_sha256"].encode())
    return digest.hexdigest()


@dataclass(frozen=True, kw_only=True)
class KillReport:
    """Result of killing one command."""

    command: str
    kills: int
    problems: tuple[str, ...]
    fingerprint: str
    """Of the uninterrupted run; without a problem, also of every resumed one."""


@dataclass(frozen=True, kw_only=True)
class Victim:
    """A command to kill."""

    arguments: tuple[str, ...]
    resume: tuple[str, ...]
    """Arguments that resume a killed run."""
    datasets: Path | None
    """Minari's root; None: in each run's own folder."""
    fsyncs: int
    """Fewest calls of fsync in an uninterrupted run."""

    def start(self, place: Path, **extra: str) -> subprocess.Popen[str]:
        """Start the command in `place`."""
        return start(self.arguments, place, self.datasets or place / "datasets", **extra)

    def go_on(self, place: Path) -> subprocess.Popen[str]:
        """Resume the command in `place`."""
        return start(self.resume, place, self.datasets or place / "datasets")


def kill_and_resume(victim: Victim, folder: Path, kills: int, rng: np.random.Generator,
                    on_kill: Callable[[int], None] = lambda done: None) -> KillReport:
    """Run the command once to the end, then kill and resume it `kills` times.

    Every other kill falls on a random fsync, the others on moments uniform between the first file of a run and its end; a
    run that ends earlier is repeated with another moment. Each run has a folder of its own below `folder`.
    """
    whole = folder / "whole"
    seconds = _time_whole(victim, whole)
    expected, problems, finished, killed = fingerprint(whole), unreadable(whole) + leftovers(whole), 0, 0
    while killed < kills and finished <= kills:
        place = folder / f"run{killed + finished}"
        place.mkdir(parents=True)
        if _start_and_kill(victim, place, killed % 2 == 0, seconds, rng):
            finished += 1
            continue
        problems += [f"after kill {killed}: {problem}" for problem in unreadable(place)]
        resumed = victim.go_on(place)
        _, errors = resumed.communicate()
        if resumed.returncode and "exists already" not in errors:
            problems.append(f"resume {killed} ended with code {resumed.returncode}: {errors.strip()[-300:]}")
        elif fingerprint(place) != expected:
            problems.append(f"resume {killed} ended with other bits")
        problems += [f"after resume {killed}: {problem}" for problem in unreadable(place) + leftovers(place)]
        killed += 1
        on_kill(killed)
    if killed < kills:
        problems.append(f"{finished} runs ended before they were killed")
    return KillReport(
        command="velap " + " ".join(victim.arguments),
        kills=killed,
        problems=tuple(problems),
        fingerprint=expected)


def _start_and_kill(victim: Victim, place: Path, at_fsync: bool, seconds: float, rng: np.random.Generator) -> bool:
    """Whether the process had finished before it was killed."""
    if at_fsync:
        process = victim.start(place, **{KILL_AT: str(rng.integers(1, victim.fsyncs + 1))})
        process.communicate()
        return process.returncode >= 0
    process = victim.start(place)
    _wait_for_file(process, place)
    time.sleep(float(rng.uniform(0, seconds)))
    process.send_signal(signal.SIGKILL)
    process.communicate()
    return process.returncode >= 0


def _time_whole(victim: Victim, place: Path) -> float:
    """Time from the first file to the end of an uninterrupted run [s]."""
    place.mkdir(parents=True)
    process = victim.start(place)
    _wait_for_file(process, place)
    began = time.monotonic()
    _, errors = process.communicate()
    if process.returncode:
        raise VelapError(f"`velap {' '.join(victim.arguments)}` ended with code {process.returncode}: "
                         f"{errors.strip()[-500:]}. Expected an undisturbed run to finish; repair that first.")
    return time.monotonic() - began


def _wait_for_file(process: subprocess.Popen[str], place: Path) -> None:
    """Wait until the process has written a file or has ended."""
    while process.poll() is None and not any(path.is_file() for path in place.rglob("*")):
        time.sleep(0.005)
