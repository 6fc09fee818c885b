"""`velap table 1` and `velap table 11`: the state of the cells, the workflow that completes them, and the table."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from studies.table1.cells import Cell, dataset_file, look, note_training, outdated
from velap.errors import ConfigError, VelapError
from velap.evaluation.summary import markdown_rows
from velap.runs import write_atomic
from velap.threads import usable_cores

NEEDED = ("snakemake", "pandas")
DONE = Path("runs/table1/done")
"""Marks of the cells that the running workflow has evaluated."""


@dataclass(frozen=True, kw_only=True)
class Table:
    """One call of the command."""

    number: str = "1"
    """Of the paper's table."""
    cells: tuple[Cell, ...]
    only: str
    """The filters that selected the cells, for the workflow."""
    records: Path
    episodes: int
    batch: int
    jobs: int
    """Jobs at once; each has its share of the cores."""
    fresh: bool
    """Move files of another config aside and make them anew; such cells fail otherwise."""
    page: Path

    def __post_init__(self) -> None:
        if min(self.jobs, self.episodes, self.batch) < 1:
            raise ConfigError(f"got {self.jobs} jobs, {self.episodes} episodes in batches of {self.batch}; expected at "
                              "least one of each.")
        missing = [name for name in NEEDED if importlib.util.find_spec(name) is None]
        if missing:
            raise ConfigError(f"`velap table {self.number}` needs {' and '.join(missing)}; expected the extra `studies`. "
                              "Install it with `pip install -e '.[studies]'` in the checkout.")

    def dry_run(self, console: Console) -> None:
        """Print the state of every cell and the jobs that would run."""
        rows = [(str(cell), self._state(cell)) for cell in self.cells]
        console.print(markdown_rows(("cell", "state"), rows), markup=False, soft_wrap=True)
        self._snakemake("--dry-run", "--quiet", "rules", "host")

    def run(self, console: Console) -> None:
        """Complete the cells, then write the table; raises VelapError at the end if a cell failed."""
        if self.fresh:
            for cell in self.cells:
                for path, _ in list(outdated(cell)):
                    if path != dataset_file(cell.task):  # `velap collect` replaces it
                        _move_aside(path)
        shutil.rmtree(DONE, ignore_errors=True)
        failed = 1
        if to_do(self.cells, self.records, self.episodes, fresh=self.fresh):
            failed = self._snakemake("--quiet", "host")
        if failed:  # the workflow's last job did not write it
            self.write(console)
        wrong = [f"{cell}: {self._state(cell)}" for cell in self.cells if self._state(cell) != "done"]
        if wrong:
            raise VelapError(f"{len(wrong)} of {len(self.cells)} cells are not done: {'; '.join(wrong)}. The others are, "
                             "and the table is written. Repair the cause, which the logs in runs/table1/logs tell, or add "
                             "--fresh to move aside what is outdated; then repeat the command.")

    def write(self, console: Console) -> None:
        """Write the table in every format from the existing records, and print it."""
        from studies.table1 import tables
        from studies.table1.page import results_page

        note_training(self.cells)
        results = tables.gather(self.records, self.episodes, [cell.preset for cell in self.cells], self.number)
        name = f"table{self.number}"
        files = {self.records.parent / f"{name}.csv": tables.to_csv(results),
                 self.page: results_page(results, self.episodes)}
        for preset in results.presets:
            files[self.records.parent / f"{name}-{preset}.tex"] = tables.to_latex(results.of(preset), preset, self.number)
            matrix = tables.matrix(results.of(preset)).to_markdown()
            console.print(f"preset {preset}\n{matrix}", markup=False, soft_wrap=True)
        for path, text in files.items():
            write_atomic(path, text.encode())
        for note in results.notes:
            console.print(f"note: {note}", markup=False, soft_wrap=True)
        console.print(f"written to {', '.join(map(str, files))}", markup=False, soft_wrap=True)

    def _state(self, cell: Cell) -> str:
        """The state of a cell, in words."""
        state = look(cell, self.records, self.episodes)
        if state.done == self.episodes:
            return "done"
        reasons = [state.problem] if state.problem else [f"{reason} ({path})" for path, reason in outdated(cell)]
        if reasons:
            return f"outdated: {'; '.join(reasons)}"
        return f"{state.done} of {self.episodes} episodes" if state.done else "missing"

    def _snakemake(self, *options: str) -> int:
        """Run the workflow; its exit code."""
        threads = max(usable_cores() // self.jobs, 1)
        config = {"number": self.number, "records": self.records, "episodes": self.episodes, "batch": self.batch,
                  "page": self.page, "threads": threads, "fresh": self.fresh, "only": self.only}
        old = {str(path) for cell in self.cells for path, _ in outdated(cell) if path == dataset_file(cell.task)}
        forced = ["--forcerun", *sorted(old)] if old and self.fresh else []
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(Path(__file__).with_name("Snakefile")),
                   "--cores", str(self.jobs * threads), "--nolock", *options, *forced,
                   "--config", *(f"{name}={value}" for name, value in config.items() if value != "")]
        with _alone() as lock, subprocess.Popen(command, start_new_session=True, pass_fds=(lock,)) as process:
            try:
                return process.wait()
            except KeyboardInterrupt:
                os.killpg(process.pid, signal.SIGTERM)  # the jobs save their state and end, and snakemake after them
                process.wait()
                raise


def to_do(cells: Sequence[Cell], records: Path, episodes: int, *, fresh: bool = False) -> list[Cell]:
    """Cells that lack episodes; outdated ones only with `fresh`."""
    found = []
    for cell in cells:
        state = look(cell, records, episodes)
        if state.done < episodes and (fresh or not (state.problem or list(outdated(cell)))):
            found.append(cell)
    return found


@contextlib.contextmanager
def _alone() -> Iterator[int]:
    """Hold the lock of this table; yields its descriptor for the workflow, which may outlive its caller."""
    import fcntl

    path = DONE.with_name("lock")
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise VelapError(f"another `velap table` is running here (it holds {path}); expected to be alone. Wait for "
                             "it, or stop it and start this one with more --jobs.") from error
        yield lock.fileno()


def _move_aside(path: Path) -> None:
    """Rename a file or folder to `NAME.old-1`, or the next free number."""
    number = next(n for n in range(1, 10_000) if not path.with_name(f"{path.name}.old-{n}").exists())
    path.rename(path.with_name(f"{path.name}.old-{number}"))
