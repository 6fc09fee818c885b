"""`velap table 1`: make the plan, say what is missing, run it, write the table."""

from __future__ import annotations

import contextlib
import dataclasses
import fcntl
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from rich.console import Console

from studies.children import CODE
from studies.forecast import Forecast
from studies.inventory import Finding, Inventory, checkpoint_path, released_checkpoint
from studies.jobs import Job, Options, make_plan
from studies.jobs_view import JobsView, budget, plan_table, totals
from studies.matrix import Selection, everything
from studies.paper import METHODS
from studies.results_page import results_page
from studies.runner import Outcome, Runner
from studies.schedule import Schedule
from studies.speed import hardware
from studies.table1 import Results, gather
from studies.table1_text import markdown_cells, to_csv, to_latex
from studies.timings import Timing, Timings
from velap.errors import ConfigError, RecordError, VelapError
from velap.evaluation.evaluate import code_version
from velap.runs import write_atomic

WAIT_SECONDS = 15.0
"""Time that jobs of an interrupted table get to end [s]. ours: an update of the joint training or a plan takes a second."""


@dataclass(frozen=True)
class Places:
    """Where a table keeps what it writes, besides records and runs."""

    results: Path = Path("results")
    """`timings.json`, `table1.csv` and `table1-PRESET.tex`."""
    page: Path = Path("docs/results.md")
    logs: Path = Path("runs/table")
    """What the jobs print, and the lock."""


@dataclass(frozen=True)
class TableOne:
    """One call of the command."""

    selection: Selection
    options: Options = field(default_factory=Options)
    places: Places = field(default_factory=Places)
    jobs: int = 2
    """Jobs at once. ours: two processes of one thread do more on two cores than one of two threads."""
    fresh: bool = False
    """Move runs and records of another config aside and make them anew; their jobs fail otherwise."""
    code: str = CODE
    """Python code of a child process."""

    def __post_init__(self) -> None:
        if self.jobs < 1 or self.options.episodes < 1 or self.options.batch < 1:
            raise ConfigError(f"got {self.jobs} jobs, {self.options.episodes} episodes in batches of {self.options.batch}; "
                              "expected at least one of each.")

    @property
    def cores(self) -> int:
        """Cores that this process may use."""
        return len(os.sched_getaffinity(0))

    def dry_run(self, console: Console) -> None:
        """Say what is there, what is missing and how long it should take."""
        jobs, forecast = self._plan(self.selection)
        console.print(plan_table(jobs, forecast))
        for line in (*self._totals(self.selection), self._budget()):
            console.print(line, markup=False, soft_wrap=True)

    def run(self, console: Console) -> None:
        """Run what is missing, then write the table; raises VelapError at the end when a job failed."""
        with _only_one(self.places.logs / "lock", console) as lock:
            self._adopt_released()
            jobs, forecast = self._plan(self.selection)
            with JobsView(console, jobs, forecast, self.jobs) as view:
                outcome = self._runner(view, lock).run(Schedule(jobs, {job.name: forecast.left(job) for job in jobs}))
            self.write(console)
        _raise_failures(outcome, len(jobs))

    def write(self, console: Console) -> None:
        """Write the table in every form from the records that are there, and print it."""
        self._note_training_times()
        results = gather(self._inventory(), self._timings(), self.selection.presets)
        files = {self.places.results / "table1.csv": to_csv(results)}
        for preset in results.presets:
            files[self.places.results / f"table1-{preset}.tex"] = to_latex(results, preset)
        files[self.places.page] = self._page(results)
        for path, text in files.items():
            write_atomic(path, text.encode())
        for preset in results.presets:
            console.print(f"preset {preset}\n{markdown_cells(results.of(preset))}", markup=False, soft_wrap=True)
        for note in results.notes:
            console.print(f"note: {note}", markup=False, soft_wrap=True)
        console.print(f"written to {', '.join(map(str, files))}", markup=False, soft_wrap=True)

    def _page(self, results: Results) -> str:
        times = (self._budget(), *self._totals(everything()))
        return results_page(results, self._inventory(), self._timings(), self.options, times)

    def _totals(self, selection: Selection) -> list[str]:
        jobs, forecast = self._plan(selection)
        return totals(jobs, forecast, str(selection), self.jobs, self.cores)

    def _budget(self) -> str:
        """The nine methods of the paper on its tasks, the default preset and one training seed, against the budget."""
        paper = dataclasses.replace(everything(), methods=METHODS)
        jobs, forecast = self._plan(paper)
        return budget(jobs, forecast, str(paper), self.jobs, self.cores)

    def _plan(self, selection: Selection) -> tuple[tuple[Job, ...], Forecast]:
        jobs = make_plan(selection.cells(), self._inventory(), self.options)
        return jobs, Forecast(jobs, self._timings(), hardware())

    def _timings(self) -> Timings:
        return Timings(self.places.results / "timings.json")

    def _inventory(self) -> Inventory:
        return Inventory(self.options.records, self.options.episodes, self._timings())

    def _runner(self, view: JobsView, lock: int) -> Runner:
        threads = max(self.cores // self.jobs, 1)
        return Runner(lambda job: self._prepare(job, threads), self._look,
                      lambda job, seconds, units: self._record(job, seconds, units, threads), view, self.jobs, threads,
                      self.places.logs, self.code, (lock,))

    def _adopt_released(self) -> None:
        """Released checkpoints take the place of joint training: its run directory is where commands look for them."""
        for task, preset, seed in {(cell.task, cell.preset, cell.seed) for cell in self.selection.cells()}:
            released = released_checkpoint(task, preset, seed)
            if released is not None:
                write_atomic(checkpoint_path(task, preset, seed), released.read_bytes())

    def _look(self, job: Job) -> Finding:
        return self._inventory().look(job.kind, job.cell)

    def _prepare(self, job: Job, threads: int) -> tuple[str, ...] | None:
        """The command to run now: what an earlier job made may have changed what is there of this one."""
        finding = self._look(job)
        if finding.finished:
            return None
        extra = ("--workers", str(threads)) if job.kind == "dataset" else ()
        if not finding.problem:
            return (*job.command, *extra)
        if not self.fresh:
            raise RecordError(f"{finding.problem}. Add --fresh to move it aside and make it anew.")
        if job.kind == "joint":
            _move_aside(checkpoint_path(job.cell.task, job.cell.preset, job.cell.seed).parent)
            return job.command
        return (*job.command, *extra, "--overwrite" if job.kind == "dataset" else "--fresh")

    def _record(self, job: Job, seconds: float, units: int, threads: int) -> None:
        """Keep the time of a sitting."""
        identity = self._inventory().identity(job.kind, job.cell)
        self._timings().add(Timing(
            job.name, round(seconds, 1), units, job.finding.unit, identity, threads, self.jobs, hardware(),
            datetime.now(UTC).isoformat(timespec="seconds"), "velap " + " ".join(job.command), code_version()))

    def _note_training_times(self) -> None:
        """Training times that only a checkpoint knows, because it was trained by hand, go where a table finds them."""
        timings = self._timings()
        jobs, _ = self._plan(dataclasses.replace(everything(), presets=("default", "paper"), seeds=self._seeds()))
        for job in jobs:
            seconds, known = job.finding.seconds, timings.get(job.name)
            if seconds is None or not job.finding.finished:
                continue
            identity = self._inventory().identity(job.kind, job.cell)
            if known is None or known.identity != identity:
                timings.add(Timing(job.name, seconds, job.finding.total, job.finding.unit, identity, 0, 0, "", "",
                                   "velap " + " ".join(job.command), ""))

    def _seeds(self) -> tuple[int, ...]:
        """Training seeds that are asked for or recorded."""
        found = {path.stem.removeprefix("train") for path in self.options.records.glob("*/*/train*.jsonl")}
        return tuple(sorted({int(seed) for seed in found if seed.isdecimal()} | set(self.selection.seeds)))


def _raise_failures(outcome: Outcome, total: int) -> None:
    if outcome.failed:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in outcome.failed.items())
        raise VelapError(f"{len(outcome.failed)} of {total} jobs failed and {len(outcome.skipped)} that need them were "
                         f"skipped: {reasons}. The others are done and the table is written; repair the cause and repeat "
                         "the command.")


def _move_aside(folder: Path) -> None:
    """Rename a run directory to `NAME.old-1`, or the next number that is free."""
    number = next(n for n in range(1, 10_000) if not folder.with_name(f"{folder.name}.old-{n}").exists())
    folder.rename(folder.with_name(f"{folder.name}.old-{number}"))


@contextlib.contextmanager
def _only_one(path: Path, console: Console) -> Iterator[int]:
    """Hold the lock of this table and give its descriptor.

    The children hold it as well: those of a killed table save their state before the next one starts, which waits for that.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as lock:
        deadline = time.monotonic() + WAIT_SECONDS
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError as error:
                if time.monotonic() > deadline:
                    raise VelapError(f"another `velap table 1` is running here (it holds {path}); expected to be alone. "
                                     "Wait for it, or stop it and start this one with more --jobs.") from error
                if time.monotonic() > deadline - WAIT_SECONDS + 1:
                    console.print("waiting for the jobs of an interrupted table to save their state", markup=False)
                time.sleep(1.0)
        yield lock.fileno()
