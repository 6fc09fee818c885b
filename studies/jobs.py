"""The plan of a table: jobs with what they need, in the order dataset -> joint training -> learned head -> evaluation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from studies.inventory import Finding, Inventory, Kind, checkpoint_path, job_name
from studies.matrix import Cell
from velap.methods.base import get_method

RECORDS = Path("results/records")
"""Default root of the records; commands do not name it."""
EPISODES = 100
"""Default number of test episodes; commands do not name it."""


@dataclass(frozen=True)
class Job:
    """One step of the plan: a command of velap, what has to be there before it, and what is there of it."""

    name: str
    kind: Kind
    cell: Cell
    """The cell that it is for, or the first of them where several share it."""
    needs: tuple[str, ...]
    """Names of the jobs that have to be finished first."""
    command: tuple[str, ...]
    """Arguments of `velap`."""
    finding: Finding
    wanted: bool = False
    """Whether it has to run: it is an evaluation or something that an unfinished one needs, and is unfinished itself."""


@dataclass(frozen=True)
class Options:
    """What every evaluation of a table shares."""

    records: Path = RECORDS
    episodes: int = EPISODES
    batch: int = 1
    """Episodes at once. One by one, an interruption loses one episode at most and a plan's time is its latency."""


def make_plan(cells: Sequence[Cell], inventory: Inventory, options: Options) -> tuple[Job, ...]:
    """All jobs of `cells`, each once and after what it needs; those that have to run are marked `wanted`."""
    jobs: dict[str, Job] = {}
    for cell in cells:
        for job in _jobs_of(cell, inventory, options):
            jobs.setdefault(job.name, job)
    wanted = _wanted(jobs)
    order = sorted(jobs.values(), key=lambda job: get_args(Kind).index(job.kind))
    return tuple(Job(**{**vars(job), "wanted": job.name in wanted}) for job in order)


def _jobs_of(cell: Cell, inventory: Inventory, options: Options) -> Iterable[Job]:
    """The chain of one cell."""
    kinds: list[Kind] = ["dataset", "joint"] if cell.method != "random" else []
    if get_method(cell.method).learns:
        kinds.append("head")
    needs: tuple[str, ...] = ()
    for kind in (*kinds, "evaluate"):
        name = job_name(kind, cell)
        # An evaluation reads checkpoint and head; whether their dataset is still there does not matter to it.
        yield Job(name, kind, cell, tuple(need for need in needs if kind != "evaluate" or not need.startswith("dataset ")),
                  _command(kind, cell, options), inventory.look(kind, cell))
        needs = (*needs, name)


def _command(kind: Kind, cell: Cell, options: Options) -> tuple[str, ...]:
    """Arguments of `velap` that do a job."""
    run = ("--preset", cell.preset, "--seed", str(cell.seed))
    if kind == "dataset":
        return ("collect", cell.task)
    if kind == "joint":
        return ("train", cell.task, *run, "--resume")
    return ("train", cell.task, "--method", cell.method, *run, "--resume") if kind == "head" else _evaluate(cell, options)


def _evaluate(cell: Cell, options: Options) -> tuple[str, ...]:
    """Arguments of `velap` that evaluate a cell; `random` names the preset, the others a checkpoint that knows it."""
    by = (("--preset", cell.preset) if cell.method == "random" else
          ("--checkpoint", str(checkpoint_path(cell.task, cell.preset, cell.seed))))
    episodes = () if options.episodes == EPISODES else ("--episodes", str(options.episodes))
    records = () if options.records == RECORDS else ("--records", str(options.records))
    return ("evaluate", cell.task, "--method", cell.method, *by, *episodes, "--batch", str(options.batch), *records)


def _wanted(jobs: dict[str, Job]) -> set[str]:
    """Unfinished evaluations and, through unfinished jobs only, what they need."""
    wanted: set[str] = set()
    open_ = [job.name for job in jobs.values() if job.kind == "evaluate"]
    while open_:
        job = jobs[open_.pop()]
        if not job.finding.finished and job.name not in wanted:
            wanted.add(job.name)
            open_ += job.needs
    return wanted
