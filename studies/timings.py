"""`results/timings.json`: how long each job of a table took, and on what machine."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from velap.errors import RecordError
from velap.runs import write_atomic


@dataclass(frozen=True)
class Timing:
    """One job, all its sittings added up."""

    job: str
    """Name of the job."""
    seconds: float
    """Time of its processes, start-up included [s]: processor time with one thread, else wall-clock time."""
    units: int
    """Work done in that time."""
    unit: str
    """Of `units`: episodes, updates, trajectories."""
    identity: str
    """Config hash that the time belongs to; another one starts the sum anew."""
    threads: int
    """Threads of the process."""
    jobs: int
    """Jobs that ran at the same time at most."""
    machine: str
    finished: str
    """When the last sitting ended, UTC, ISO 8601."""
    command: str
    code_version: str

    @property
    def rate(self) -> float:
        """Seconds a unit [s]."""
        return self.seconds / self.units


class Timings:
    """The file's entries by job; every change is written through."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._entries = _read(path)

    def get(self, job: str) -> Timing | None:
        """The entry of a job, if it has one."""
        return self._entries.get(job)

    def __iter__(self) -> Iterator[Timing]:
        return iter(self._entries.values())

    def add(self, sitting: Timing) -> None:
        """Add a sitting to what earlier ones of the same job and config took; one without work done changes nothing."""
        if sitting.units <= 0:
            return
        before = self._entries.get(sitting.job)
        if before is not None and (before.identity, before.unit) == (sitting.identity, sitting.unit):
            sitting = dataclasses.replace(sitting, seconds=round(before.seconds + sitting.seconds, 1),
                                          units=before.units + sitting.units)
        self._entries[sitting.job] = sitting
        rows = [dataclasses.asdict(self._entries[job]) for job in sorted(self._entries)]
        write_atomic(self.path, (json.dumps(rows, indent=1, ensure_ascii=False) + "\n").encode())


def _read(path: Path) -> dict[str, Timing]:
    if not path.exists():
        return {}
    try:
        entries = [Timing(**row) for row in json.loads(path.read_bytes())]
    except (ValueError, TypeError) as error:
        raise RecordError(f"{path} does not hold the timings of `velap table 1` ({error}); expected a list of them. Restore "
                          "the file, or move it away: times then are taken anew.") from error
    return {entry.job: entry for entry in entries}
