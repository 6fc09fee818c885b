"""What the tests of `velap table 1` share: records of cells as an evaluation would write them today."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from studies.inventory import Finding, Inventory, Kind
from studies.matrix import Cell
from studies.timings import Timings
from velap.evaluation.records import Record, RecordFile, RunKey
from velap.tasks import get_task

RECORDS = Path("results/records")


def inventory(episodes: int = 4) -> Inventory:
    """Of the working folder."""
    return Inventory(RECORDS, episodes, Timings(Path("results/timings.json")))


def fill(cell: Cell, outcomes: Sequence[bool], *, config_hash: str | None = None, checkpoint: str = "c0ffee",
         code: str = "0.1.0+gabc", plan_ms: tuple[float, ...] = (10.0, 30.0)) -> Path:
    """A record file of the cell, an episode an outcome; returns its path."""
    task = get_task(cell.task)
    key = RunKey(task=cell.task, method=cell.method, preset=cell.preset, train_seed=cell.seed, env=task.env_id,
                 config_hash=config_hash or str(inventory().expected_hash(cell)), checkpoint=checkpoint, code_version=code,
                 max_steps=task.max_steps)
    with RecordFile(key.path(RECORDS), key) as file:
        for seed, success in enumerate(outcomes):
            file.append(Record(**vars(key), episode_seed=seed, success=success, steps=100 if success else 300,
                               truncated=not success, plan_ms=plan_ms, batch=1, device="cpu"))
    return key.path(RECORDS)


class Pretended(Inventory):
    """Finds what it is told by kind of job, and nothing of the others."""

    def __init__(self, finished: Sequence[str] = (), partly: dict[str, tuple[int, int]] | None = None) -> None:
        super().__init__(RECORDS, 100, Timings(Path("results/timings.json")))
        self.finished, self.partly = set(finished), partly or {}

    def look(self, kind: Kind, cell: Cell) -> Finding:
        """`finished` and `partly` name jobs, or kinds of jobs."""
        from studies.inventory import job_name

        names = {kind, job_name(kind, cell)}
        for name in names & self.partly.keys():
            return Finding(*self.partly[name], "units", False)
        done = bool(names & self.finished)
        return Finding(100 if done else 0, 100, "units", done)
