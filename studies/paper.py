"""`velap study paper`: every table and figure of the paper that holds measurements, one part after the other.

A part is a command of its own, which goes on where it stopped; so does this one. Figures 1, 2 and 4 are sketches and photos.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rich.console import Console

from studies import ablations, dynamics_loss, planning_time, representation
from studies.objectives import known_phases
from studies.table1.cells import look, parse_only
from velap.errors import VelapError
from velap.evaluation.records import read_records, record_path
from velap.evaluation.summary import markdown_rows
from velap.report.latent_figure import PAPER_TASKS, SHIPPED_DATA
from velap.storage import SHIPPED_RECORDS

SEEDS = (0, 1)
"""Training seeds."""
TABLE_EPISODES, POINT_EPISODES = 100, 50
UPDATES = (1000, 4000)
"""Updates on frames and on frozen latents in Figures 5 and 6. ours: the presets' own would take three times the day."""
_SEEDS = " ".join(map(str, SEEDS))


@dataclass(frozen=True, kw_only=True)
class Part:
    """One table or figure."""

    name: str
    command: str
    """Of `velap`."""
    hours: float
    """From nothing, on two cores [h]. ours, a guess from the training times and plan times of velap 0.1's records."""
    progress: Callable[[], tuple[int, int]]
    """What is done, and all of it, in units of the part."""
    unit: str

    @property
    def left(self) -> float:
        """Hours that are left, if all units take as long."""
        done, whole = self.progress()
        return self.hours * (1 - done / whole)


def table_progress(number: str) -> tuple[int, int]:
    """Cells of a table with all records of today's config."""
    cells = parse_only([f"seed={','.join(map(str, SEEDS))}"], number)
    return sum(look(cell, SHIPPED_RECORDS, TABLE_EPISODES).done == TABLE_EPISODES for cell in cells), len(cells)


def ablation_progress(study: ablations.Study) -> tuple[int, int]:
    """Cells that are done."""
    with known_phases():
        cells = ablations.Plan(study=study, seeds=SEEDS, updates=UPDATES, episodes=TABLE_EPISODES).cells
        return sum(cell.state == "done" for cell in cells), len(cells)


def points_progress(number: str) -> tuple[int, int]:
    """Episodes of all points of Figure 7 or 8."""
    task, done = planning_time.FIGURES[number], 0
    points = planning_time.points_of(task)
    for point in points:
        path = record_path(planning_time.RECORDS / point.name, task, point.method, "default", 0)
        done += min(POINT_EPISODES, len(read_records(path))) if path.exists() else 0
    return done, POINT_EPISODES * len(points)


def latent_progress() -> tuple[int, int]:
    """Rows of Figure 3."""
    return sum((SHIPPED_DATA / f"fig3-{task}.npz").exists() for task in PAPER_TASKS), len(PAPER_TASKS)


_ABLATION = f"--seeds {_SEEDS} --updates {UPDATES[0]} {UPDATES[1]} --episodes {TABLE_EPISODES}"
_TABLE = f"--jobs 2 --episodes {TABLE_EPISODES} --only seed={','.join(map(str, SEEDS))}"
PARTS = (
    Part(name="Figure 3", command="figure 3", hours=0.05, progress=latent_progress, unit="rows"),
    Part(name="Table 1", command=f"table 1 {_TABLE}", hours=14, progress=lambda: table_progress("1"), unit="cells"),
    Part(name="Table 11", command=f"table 11 {_TABLE}", hours=3, progress=lambda: table_progress("11"), unit="cells"),
    Part(name="Figure 5", command=f"figure 5 {_ABLATION}", hours=8, unit="cells",
         progress=lambda: ablation_progress(representation.STUDY)),
    Part(name="Figure 6", command=f"figure 6 {_ABLATION}", hours=6, unit="cells",
         progress=lambda: ablation_progress(dynamics_loss.STUDY)),
    Part(name="Figure 7", command=f"figure 7 --episodes {POINT_EPISODES}", hours=4, progress=lambda: points_progress("7"),
         unit="episodes"),
    Part(name="Figure 8", command=f"figure 8 --episodes {POINT_EPISODES}", hours=1, progress=lambda: points_progress("8"),
         unit="episodes"),
)


def make_paper(console: Console, dry_run: bool = False, fresh: bool = False, parts: Sequence[Part] = PARTS) -> None:
    """Print the parts and what is left of them; then run those that lack something, and all that draw what is there.

    With `fresh`, records of another config are moved aside and made anew where they count as outdated (tables, Figures 5
    and 6). A part that fails does not keep the others from running; VelapError names it in the end.
    """
    console.print(overview(parts), markup=False, soft_wrap=True)
    if dry_run:
        return
    failed = []
    for part in parts:
        words = shlex.split(part.command)
        words += ["--fresh"] if fresh and part.unit == "cells" else []
        words += ["--no-run"] if part.left == 0 else []
        console.print(f"{part.name}: velap {shlex.join(words)}", markup=False, soft_wrap=True)
        if run_command(words) != 0:
            failed.append(part.name)
    if failed:
        raise VelapError(f"{len(failed)} of {len(parts)} parts are not whole: {', '.join(failed)}; the others are. What "
                         "they printed says why. Repeat the command: it goes on from there.")
    console.print(f"all {len(parts)} parts are whole", markup=False)


def run_command(words: Sequence[str]) -> int:
    """Exit code of a velap command in a process of its own, which ends with this one."""
    with subprocess.Popen([sys.executable, "-m", "velap", *words], start_new_session=True) as process:
        try:
            return process.wait()
        except KeyboardInterrupt:
            process.terminate()  # it saves its state and ends
            process.wait()
            raise


def overview(parts: Sequence[Part]) -> str:
    """A row a part."""
    rows = []
    for part in parts:
        done, whole = part.progress()
        rows.append((part.name, f"{done} of {whole} {part.unit}", f"{part.left:.1f}", f"velap {part.command}"))
    rows.append(("all", "", f"{sum(part.left for part in parts):.1f}", "velap study paper"))
    return markdown_rows(("part", "there", "left [h, 2 cores, guessed]", "command"), rows)
