"""The jobs of a table on a terminal: what is there and how long the rest should take, and then their live progress."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from studies.forecast import BUDGET_HOURS, Forecast
from studies.jobs import Job
from studies.schedule import makespan
from velap.evaluation.console import LINE_EVERY


def duration(seconds: float) -> str:
    """`45 s`, `12 min`, `3.4 h`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def state(job: Job) -> str:
    """What is there of a job, in a few words."""
    finding = job.finding
    if finding.finished:
        return "done"
    if finding.problem:
        return f"outdated: {finding.problem}"
    there = f"{finding.done} of {finding.total} {finding.unit}" if finding.done else "missing"
    return there if job.wanted else f"{there}, not needed"


def plan_table(jobs: Sequence[Job], forecast: Forecast) -> Table:
    """Every job: its state, how long it should take by calibrated costs, what it took, what is left."""
    view = Table("job", "state", "expected", "measured", "left")
    for job in jobs:
        took, expected = forecast.measured(job), forecast.foretold(job)
        left = forecast.left(job)
        view.add_row(escape(job.name), escape(state(job)), duration(expected.seconds),
                     "-" if took is None else duration(took), duration(left) if job.wanted else "-")
    return view


def totals(jobs: Sequence[Job], forecast: Forecast, what: str, places: int, cores: int) -> list[str]:
    """Lines that sum up a plan: what is left, the whole of it, and how the measured parts compare with what was foretold."""
    wanted = [job for job in jobs if job.wanted]
    left = makespan(jobs, {job.name: forecast.left(job) for job in jobs}, places)
    done = sum(job.finding.finished for job in jobs)
    return [
        f"{what}: {len(jobs)} jobs, {done} done, {len(wanted)} to run in about {duration(left)}; from nothing "
        f"{duration(3600 * whole_hours(jobs, forecast, places))}. {places} at once on {cores} cores.",
        *agreement(jobs, forecast),
    ]


def budget(jobs: Sequence[Job], forecast: Forecast, what: str, places: int, cores: int) -> str:
    """The whole of the paper's table against its budget."""
    hours = whole_hours(jobs, forecast, places)
    return (f"The paper's table, {what}, from nothing: {hours:.1f} h with {places} jobs at once on {cores} cores; budget "
            f"on 2 cores: {BUDGET_HOURS:.0f} h.")


def whole_hours(jobs: Sequence[Job], forecast: Forecast, places: int) -> float:
    """Time of the whole plan, as if nothing were there [h]."""
    everything = [Job(**{**vars(job), "wanted": True}) for job in jobs]
    return makespan(everything, {job.name: forecast(job).seconds for job in jobs}, places) / 3600


def agreement(jobs: Sequence[Job], forecast: Forecast) -> list[str]:
    """How the measured jobs compare with what was foretold of them."""
    pairs = [(took, forecast.foretold(job).seconds) for job in jobs if (took := forecast.measured(job)) is not None]
    if not pairs:
        return []
    took, expected = (sum(values) for values in zip(*pairs, strict=True))
    within = sum(2 / 3 <= measured / foretold <= 4 / 3 for measured, foretold in pairs)
    return [f"Measured jobs: {len(pairs)}, which took {duration(took)} where {duration(expected)} were foretold; "
            f"{within} of them are within a third."]


class JobsView:
    """Live progress: a bar a running job and one for the whole; plain lines where the output is no terminal."""

    def __init__(self, console: Console, jobs: Sequence[Job], forecast: Forecast, places: int) -> None:
        self._console = console
        self._places = places
        self._wanted = [job for job in jobs if job.wanted]
        self._left = {job.name: forecast.left(job) for job in self._wanted}
        self._bars = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                              TextColumn("{task.fields[info]}"), console=console, disable=not console.is_terminal)
        self._all = self._bars.add_task("jobs", total=len(self._wanted), info=self._time_left())
        self._bar: dict[str, TaskID] = {}
        self._text: dict[str, str] = {}
        self._done = 0
        self._last_line = time.monotonic()

    def started(self, job: Job, log: Path) -> None:
        """A bar for the job."""
        self._bar[job.name] = self._bars.add_task(escape(job.name), total=job.finding.total, completed=job.finding.done,
                                                  info="")
        self._text[job.name] = "started"
        self._say(f"started {job.name}, about {duration(self._left[job.name])}: velap {' '.join(job.command)}")

    def progress(self, job: Job, done: int, total: int, text: str) -> None:
        """Move the job's bar; a line about all that run, now and then."""
        self._bars.update(self._bar[job.name], completed=done, total=total, info=escape(text[:60]))
        self._text[job.name] = f"{done} of {total}"
        now = time.monotonic()
        if not self._console.is_terminal and now - self._last_line >= LINE_EVERY:
            self._last_line = now
            running = "; ".join(f"{name}: {words}" for name, words in self._text.items())
            self._say(f"{self._done} of {len(self._wanted)} jobs done, {self._time_left()}; {running}")

    def finished(self, job: Job, seconds: float) -> None:
        """One more is done."""
        self._end(job)
        self._say(f"finished {job.name} in {duration(seconds)}" if seconds else f"nothing left to do for {job.name}")

    def failed(self, job: Job, reason: str) -> None:
        """One failed."""
        self._end(job)
        self._say(f"FAILED {job.name}: {reason}")

    def skipped(self, job: Job, because: Job) -> None:
        """One that cannot run any more."""
        self._end(job)
        self._say(f"skipped {job.name}: it needs {because.name}")

    def _end(self, job: Job) -> None:
        self._done += 1
        self._text.pop(job.name, None)
        self._left.pop(job.name, None)
        if job.name in self._bar:
            self._bars.remove_task(self._bar.pop(job.name))
        self._bars.update(self._all, completed=self._done, info=self._time_left())

    def _time_left(self) -> str:
        """Foretold time of the jobs that are not done."""
        rest = [job for job in self._wanted if job.name in self._left]
        return f"about {duration(makespan(rest, self._left, self._places))} left"

    def _say(self, line: str) -> None:
        self._console.print(line, markup=False, soft_wrap=True)

    def __enter__(self) -> Self:
        self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bars.stop()
