"""Runs the jobs of a plan in child processes, N at once, and goes on with the others when one fails."""

from __future__ import annotations

import contextlib
import re
import signal
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any, Protocol

from studies.children import CODE, Child
from studies.inventory import Finding
from studies.jobs import Job
from studies.schedule import Schedule
from velap.errors import VelapError

POLL_SECONDS = 0.1


class Observer(Protocol):
    """Sees what becomes of every job."""

    def started(self, job: Job, log: Path) -> None:
        """Its process runs."""
        ...

    def progress(self, job: Job, done: int, total: int, text: str) -> None:
        """What it has done so far."""
        ...

    def finished(self, job: Job, seconds: float) -> None:
        """It is done; `seconds` is 0 where nothing had to be run after all."""
        ...

    def failed(self, job: Job, reason: str) -> None:
        """It ended without success, or could not be started."""
        ...

    def skipped(self, job: Job, because: Job) -> None:
        """It will not run: it needs a job that failed."""
        ...


@dataclass
class Outcome:
    """Names of the jobs by what became of them."""

    finished: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    """With the reason."""
    skipped: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Runner:
    """What running a plan needs besides the plan."""

    prepare: Callable[[Job], tuple[str, ...] | None]
    """Arguments of `velap` to run now, None when there is nothing left to do; raises VelapError when it cannot be run."""
    look: Callable[[Job], Finding]
    """What is there of a job now."""
    record: Callable[[Job, float, int], None]
    """Told (job, seconds of work, units of work) of every sitting."""
    observer: Observer
    places: int
    """Jobs at once."""
    threads: int
    """Threads a job."""
    logs: Path
    """Folder of what the jobs print."""
    code: str = CODE
    """Python code of a child."""
    keep_open: tuple[int, ...] = ()
    """File descriptors that the children hold too."""

    def run(self, schedule: Schedule) -> Outcome:
        """Run all jobs of the schedule. Ctrl-C and SIGTERM let the running ones save their state, then raise
        KeyboardInterrupt."""
        outcome, running = Outcome(), dict[str, _Running]()
        with _terminate_as_interrupt():
            try:
                while True:
                    self._fill(schedule, running, outcome)
                    if not running:
                        return outcome
                    time.sleep(POLL_SECONDS)
                    for name in list(running):
                        self._look(running, name, schedule, outcome)
            finally:
                self._stop(running)

    def _fill(self, schedule: Schedule, running: dict[str, _Running], outcome: Outcome) -> None:
        """Start jobs while there are places."""
        while len(running) < self.places and (job := schedule.next()) is not None:
            try:
                command = self.prepare(job)
                if command is None:
                    self._succeed(job, 0.0, schedule, outcome)
                    continue
                log = self.logs / f"{re.sub(r'[^A-Za-z0-9]+', '-', job.name)}.log"
                before = self.look(job).done
                child = Child(command, log, self.threads, self.code, self.keep_open)
            except (VelapError, OSError) as error:
                self._fail(job, str(error), schedule, outcome)
                continue
            running[job.name] = _Running(job, child, before)
            self.observer.started(job, log)

    def _look(self, running: dict[str, _Running], name: str, schedule: Schedule, outcome: Outcome) -> None:
        """Show the progress of a running job, or what came of it."""
        job, child = running[name].job, running[name].child
        code = child.poll()
        if code is None:
            if (progress := child.progress()) is not None:
                self.observer.progress(job, *progress)
            return
        seconds = child.seconds
        child.end()
        self._note(running.pop(name))
        if code == 0 and self.look(job).finished:
            self._succeed(job, seconds, schedule, outcome)
        else:
            how = f"killed by signal {-code}" if code < 0 else f"exit code {code}"
            problem = self.look(job).problem if code == 0 else ""
            self._fail(job, f"{problem or child.last_words()} ({how}; all it said is in {child.log})", schedule, outcome)

    def _succeed(self, job: Job, seconds: float, schedule: Schedule, outcome: Outcome) -> None:
        schedule.finish(job.name)
        outcome.finished.append(job.name)
        self.observer.finished(job, seconds)

    def _fail(self, job: Job, reason: str, schedule: Schedule, outcome: Outcome) -> None:
        outcome.failed[job.name] = reason
        self.observer.failed(job, reason)
        for skipped in schedule.fail(job.name):
            outcome.skipped.append(skipped.name)
            self.observer.skipped(skipped, job)

    def _note(self, ended: _Running) -> None:
        """Record what a sitting did; what cannot be read any more did nothing."""
        with contextlib.suppress(VelapError):
            self.record(ended.job, ended.child.work_seconds, self.look(ended.job).done - ended.before)

    def _stop(self, running: dict[str, _Running]) -> None:
        """End whatever still runs."""
        for entry in running.values():
            entry.child.stop()
        for entry in running.values():
            entry.child.end()
            self._note(entry)


@dataclass(frozen=True)
class _Running:
    job: Job
    child: Child
    before: int
    """Units of work that were there at its start."""


@contextlib.contextmanager
def _terminate_as_interrupt() -> Iterator[None]:
    """SIGTERM ends the block like Ctrl-C."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    previous: Any = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
