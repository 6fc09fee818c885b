"""Which job may start next, and how long a plan lasts on N places: the same rule runs the plan and foretells it."""

from __future__ import annotations

import heapq
from collections.abc import Mapping, Sequence

from studies.jobs import Job


class Schedule:
    """The jobs of a plan that have to run, handed out as soon as what they need is there, the longest way to go first."""

    def __init__(self, jobs: Sequence[Job], seconds: Mapping[str, float]) -> None:
        """`seconds`: how long each job will take [s], by name; decides the order only."""
        self._jobs = {job.name: job for job in jobs if job.wanted}
        self._waiting = dict(self._jobs)
        self._unmet = {name: {need for need in job.needs if need in self._jobs} for name, job in self._jobs.items()}
        self._to_go: dict[str, float] = {}
        for job in reversed(list(self._jobs.values())):  # what needs a job stands behind it
            after = [self._to_go[name] for name, unmet in self._unmet.items() if job.name in unmet]
            self._to_go[job.name] = seconds[job.name] + max(after, default=0.0)

    def next(self) -> Job | None:
        """The next job to start, which is then no longer waiting; None where none may start now."""
        ready = [name for name in self._waiting if not self._unmet[name]]
        if not ready:
            return None
        return self._waiting.pop(max(ready, key=self._to_go.__getitem__))

    def finish(self, name: str) -> None:
        """The job is done: those that needed it may start."""
        for unmet in self._unmet.values():
            unmet.discard(name)

    def fail(self, name: str) -> list[Job]:
        """The job failed: all that need it, directly or not, will never start and are given back."""
        skipped: list[Job] = []
        failed = {name}
        for job in list(self._waiting.values()):
            if self._unmet[job.name] & failed:
                failed.add(job.name)
                skipped.append(self._waiting.pop(job.name))
        return skipped

    @property
    def waiting(self) -> int:
        """Jobs that have not started."""
        return len(self._waiting)


def makespan(jobs: Sequence[Job], seconds: Mapping[str, float], places: int) -> float:
    """Time from the first job to the last with `places` jobs at once, each lasting `seconds` [s]."""
    schedule = Schedule(jobs, seconds)
    running: list[tuple[float, str]] = []
    now = 0.0
    while True:
        while len(running) < places and (job := schedule.next()) is not None:
            heapq.heappush(running, (now + seconds[job.name], job.name))
        if not running:
            return now
        now, name = heapq.heappop(running)
        schedule.finish(name)
