"""`velap study faults`: kills, damaged files, wrong commands and full disks, and a report."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from rich.console import Console

from studies.faults.cases import CASES, DATASET, Answer, CaseResult, RunCommand, check, judge, message_of
from studies.faults.kills import (
    FILE_LIMIT,
    SMALL,
    TRAJECTORIES,
    KillReport,
    Victim,
    fingerprint,
    kill_and_resume,
    leftovers,
    start,
    unreadable,
)
from velap.errors import VelapError
from velap.evaluation.console import ProgressBar
from velap.runs import write_atomic

KILLS, QUICK_KILLS = 20, 2
DISK = 32 * 2**20
"""Size of the file system that is filled [bytes]."""
MESSAGE = 420
"""Longest message in the report [characters]."""


@dataclass(frozen=True, kw_only=True)
class DiskCase:
    """A command that runs out of disk below the folder `disk`."""

    fault: str
    arguments: tuple[str, ...]
    again: tuple[str, ...]
    """Arguments that finish the work once there is room."""
    datasets: str
    """Minari's root in the case's folder."""
    free: int
    """Room on the disk, or, if no disk can be mounted, the largest file [bytes]."""
    result: str
    """Folder of the base that the finished command has to reproduce bit by bit; empty for no comparison."""


RECORD = ("evaluate", "SpiralMaze", "--episodes", "1", "--max-steps", "3", "--checkpoint", "run/model.safetensors",
          "--records", "disk/records")
DISK_CASES = (
    DiskCase(
        fault="disk full while collecting",
        arguments=("collect", "SpiralMaze"),
        again=("collect", "SpiralMaze"),
        datasets="disk",
        free=20_000,
        result="datasets"),
    DiskCase(
        fault="disk full while training",
        arguments=("train", "SpiralMaze", "--out", "disk/run"),
        again=("train", "SpiralMaze", "--out", "disk/run", "--resume"),
        datasets="datasets",
        free=100_000,
        result="run"),
    DiskCase(fault="disk full while evaluating", arguments=RECORD, again=RECORD, datasets="datasets", free=0, result=""),
)


@contextmanager
def full_disk(folder: Path, free: int, mount: bool = True) -> Iterator[int | None]:
    """Make `folder` a file system with `free` bytes of room; yields None, or `free` as a limit on files if it cannot mount.

    Afterwards `folder` keeps what was written, and has room again.
    """
    folder.mkdir(parents=True)
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(folder)]
    if not (mount and os.geteuid() == 0 and subprocess.run(command, capture_output=True).returncode == 0):
        yield free
        return
    kept = folder.with_name("kept")
    try:
        filler = folder / "filler"
        filler.write_bytes(bytes(shutil.disk_usage(folder).free - free))
        yield None
        filler.unlink()
        shutil.copytree(folder, kept)
    finally:
        subprocess.run(["umount", str(folder)], check=True)
    shutil.copytree(kept, folder, dirs_exist_ok=True)


def check_disk(case: DiskCase, base: Path, place: Path, run: RunCommand, mount: bool = True) -> CaseResult:
    """Run a command on a full disk, check its message and files, and let it finish with room."""
    shutil.copytree(base, place)
    disk = place / "disk"
    with full_disk(disk, case.free, mount) as limit:
        code, stderr = run(case.arguments, place, case.datasets, limit)
        problems = judge(code, stderr, "")
        problems += unreadable(disk) + [left for left in leftovers(disk) if ".tmp" in left]
    again, errors = run(case.again, place, case.datasets)
    if again:
        problems.append(f"with room it ends with code {again}: {message_of(errors)[-200:]}")
    else:
        problems += unreadable(disk) + leftovers(disk)
        if case.result and fingerprint(disk) != fingerprint(base / case.result):
            problems.append("with room it ends with other bits")
    shutil.rmtree(place)
    return CaseResult(fault=case.fault, command=" ".join(["velap", *case.arguments]),
                      message=message_of(stderr).replace(str(place), "FOLDER"), code=code, problems=tuple(problems))


def run_alone(arguments: Sequence[str], place: Path, datasets: str = "datasets", limit: int | None = None) -> Answer:
    """A `RunCommand` in a process of its own."""
    process = start(arguments, place, place / datasets, **({} if limit is None else {FILE_LIMIT: str(limit)}))
    _, stderr = process.communicate()
    return process.returncode, stderr


def study_faults(console: Console, quick: bool = False, seed: int = 0, write: Path | None = None) -> None:
    """Run all faults, print the problems, and write the report; raises VelapError if there are problems."""
    kills = QUICK_KILLS if quick else KILLS
    total = 2 * kills + len(CASES) + len(DISK_CASES)
    with TemporaryDirectory() as folder, ProgressBar(console, "faults", total) as view:
        reports = _kill(Path(folder), kills, np.random.default_rng(seed), view)
        results = _spoil(Path(folder), 2 * kills, view)
    command = "velap study faults" + (" --quick" if quick else "") + (f" --seed {seed}" if seed else "")
    if write is not None:
        write_atomic(write, report(command, reports, results).encode())
        console.print(f"report {write}", markup=False)
    bad = [f"{entry.command}: {problem}" for entry in reports for problem in entry.problems]
    bad += [f"{entry.fault}: {problem}" for entry in results for problem in entry.problems]
    for line in bad:
        console.print(line, markup=False, soft_wrap=True)
    if bad:
        raise VelapError(f"{len(bad)} problems in {len(reports) + len(results)} faults; expected none. They stand above.")
    console.print(f"{len(results)} faults and {sum(entry.kills for entry in reports)} kills: all as they should be")


def _kill(root: Path, kills: int, rng: np.random.Generator, view: ProgressBar) -> list[KillReport]:
    """Kill collection and training; leaves an intact dataset and run in `root/base`."""
    collect, train = ("collect", "SpiralMaze", "--workers"), ("train", "SpiralMaze", "--out", "run")
    victim = Victim(arguments=(*collect, "2"), resume=(*collect, "1"), datasets=None, fsyncs=8)
    reports = [kill_and_resume(victim, root / "collect", kills, rng,
                               lambda done: view.show(done, title="killed collecting"))]
    shutil.copytree(root / "collect" / "whole" / "datasets", root / "base" / "datasets")
    victim = Victim(arguments=train, resume=(*train, "--resume"), datasets=root / "base" / "datasets", fsyncs=24)
    reports.append(kill_and_resume(victim, root / "train", kills, rng,
                                   lambda done: view.show(kills + done, title="killed training")))
    shutil.copytree(root / "train" / "whole" / "run", root / "base" / "run")
    return reports


def _spoil(root: Path, done: int, view: ProgressBar) -> list[CaseResult]:
    """All other cases, on copies of `root/base`; `done` of the view's total came before."""
    results = []
    for case in CASES:
        results.append(check(case, root / "base", root / "case", run_alone))
        view.show(done + len(results), title=case.fault)
    for disk_case in DISK_CASES:
        results.append(check_disk(disk_case, root / "base", root / "case", run_alone))
        view.show(done + len(results), title=disk_case.fault)
    return results


def report(command: str, reports: Sequence[KillReport], results: Sequence[CaseResult]) -> str:
    """The document, in Markdown."""
    kills = "\n".join(f"| `{entry.command}` | {entry.kills} | {_verdict(entry.problems)} |" for entry in reports)
    faults = "\n".join(f"| {entry.fault} | `{entry.command}` | {_cell(entry.message)} | {entry.code} | "
                       f"{_verdict(entry.problems)} |" for entry in results)
    train = ", ".join(f"{name} {value}" for name, value in SMALL["train"].items())
    return f"""# Faults

Written by `{command} --write docs/faults.md`; run it again after a change. All runs are commands in processes of their
own, on a SpiralMaze shrunk to seconds: {TRAJECTORIES} trajectories; {train}.

## kill -9, then resume
Every other kill falls on a random fsync, when a file is written and not yet renamed into place; the rest fall on moments
uniform over the run. After each kill every file that is not hidden is read to its end and checked against its checksum.
Then the command goes on (collecting with another number of workers), and its weights, logged losses or dataset arrays are
compared with those of an uninterrupted run, bit by bit. Nothing temporary may be left.

| command | kills | verdict |
| --- | --- | --- |
{kills}

## Spoilt files, wrong commands, full disks
“As it should be”: one paragraph (or the usage message of a wrong option) that names the fault and the way out, an exit code
above 0, no traceback, and the folder as it was, file by file. On a full disk the files that are there are readable, none is
temporary, and the same command finishes once there is room, with the same bits. The dataset is `{DATASET}`; a
stranger's dataset has no checksums of velap. FOLDER stands for the working folder.

| fault | command | message | exit code | verdict |
| --- | --- | --- | --- | --- |
{faults}
"""


def _cell(text: str) -> str:
    """Text for a table cell."""
    return (text if len(text) <= MESSAGE else f"{text[: MESSAGE - 1]}…").replace("|", "\\|")


def _verdict(problems: Sequence[str]) -> str:
    return _cell("; ".join(problems)) if problems else "as it should be"
