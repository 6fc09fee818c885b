"""Table 1 from records: what each cell holds, what had to be left out and why, and VELAP against the best baseline."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from studies.inventory import Inventory, Kind, job_name, joint_metadata
from studies.matrix import Cell, everything, in_paper_order
from studies.paper import LABELS, METHODS, TABLE_1, TASKS, Published
from studies.timings import Timings
from velap.errors import RecordError
from velap.evaluation.records import Record, read_records, select
from velap.evaluation.statistics import Episodes, Paired, mcnemar, mean_and_spread
from velap.evaluation.summary import Summary, summarise
from velap.methods.base import get_method
from velap.models.velap import WEIGHTS_SHA256, shared_weights
from velap.tasks import PRESETS
from velap.tasks import TASKS as REGISTERED

NO_BASELINES = ("velap", "random")
"""Methods that are not among those that VELAP is compared with."""


@dataclass(frozen=True)
class Run:
    """The records of one training seed."""

    cell: Cell
    path: Path
    summary: Summary
    outcomes: Episodes
    """Success of every episode."""
    config_hash: str
    checkpoint: str
    training_seconds: float | None
    """Joint training, and the head's where the method has one [s]; None where it is not known."""


@dataclass(frozen=True)
class Entry:
    """One cell of the table: the runs of all training seeds, none where it is missing."""

    task: str
    method: str
    preset: str
    runs: tuple[Run, ...]

    @property
    def published(self) -> Published | None:
        """What the paper reports."""
        return TABLE_1.get((self.task, self.method))

    @property
    def rate(self) -> tuple[float, float]:
        """Mean success rate and its spread over the training seeds [%]; the spread is NaN of one seed."""
        return mean_and_spread([100 * run.summary.success_rate for run in self.runs])

    @property
    def outcomes(self) -> dict[tuple[int, int], bool]:
        """Success of every episode of every training seed."""
        return {key: success for run in self.runs for key, success in run.outcomes.items()}

    @property
    def training_seconds(self) -> float | None:
        """Mean training time of a run [s]; None where it is not known."""
        known = [run.training_seconds for run in self.runs if run.training_seconds is not None]
        return statistics.fmean(known) if known else None


@dataclass(frozen=True)
class Comparison:
    """VELAP against the best baseline of a task and preset."""

    task: str
    preset: str
    baseline: str
    velap_rate: float
    """[%]"""
    baseline_rate: float
    """[%]"""
    test: Paired


@dataclass(frozen=True)
class Results:
    """Everything that the table says."""

    entries: tuple[Entry, ...]
    comparisons: tuple[Comparison, ...]
    notes: tuple[str, ...]
    """What was left out, and what is mixed."""

    @property
    def presets(self) -> tuple[str, ...]:
        """Presets in the table."""
        return tuple(dict.fromkeys(entry.preset for entry in self.entries))

    def of(self, preset: str) -> tuple[Entry, ...]:
        """The cells of one preset, task by task."""
        return tuple(entry for entry in self.entries if entry.preset == preset)


def gather(inventory: Inventory, timings: Timings, presets: Sequence[str] = ("default",)) -> Results:
    """Read all records that belong to the table; `presets` are shown even where nothing is recorded of them."""
    whole, notes = everything(), list[str]()
    tasks = in_paper_order({**dict.fromkeys(whole.tasks), **dict.fromkeys(TASKS)}, TASKS)
    methods = in_paper_order({**dict.fromkeys(whole.methods), **dict.fromkeys(METHODS)}, tuple(LABELS))
    entries = [Entry(task, method, preset, _runs(Cell(task, method, preset, 0), inventory, timings, notes))
               for preset in PRESETS for task in tasks for method in methods]
    shown = {entry.preset for entry in entries if entry.runs} | set(presets)
    kept = tuple(entry for entry in entries if entry.preset in shown)
    return Results(kept, _comparisons(kept), (*notes, *_mixed_code(kept), *_mixed_checkpoints(kept), *_missing(kept)))


def _runs(cell: Cell, inventory: Inventory, timings: Timings, notes: list[str]) -> tuple[Run, ...]:
    """The runs of all training seeds whose records are whole and of the config of today."""
    folder = inventory.record_path(cell).parent
    runs = []
    for path in sorted(folder.glob("train*.jsonl"), key=lambda path: (len(path.name), path.name)):
        seed = path.stem.removeprefix("train")
        if cell.task not in REGISTERED or not seed.isdecimal():
            continue
        try:
            runs.append(_run(Cell(cell.task, cell.method, cell.preset, int(seed)), path, inventory, timings))
        except RecordError as error:
            notes.append(f"{path} is left out: {str(error).removesuffix('.')}.")
    return tuple(runs)


def _run(cell: Cell, path: Path, inventory: Inventory, timings: Timings) -> Run:
    """One run; raises RecordError with the reason where its records do not belong into the table."""
    records = read_records(path)
    problem = inventory.record_problem(cell, records)
    if problem:
        raise RecordError(problem)
    recorded = {record.episode_seed for record in records} & set(range(inventory.episodes))
    if len(recorded) < inventory.episodes:
        raise RecordError(f"only {len(recorded)} of {inventory.episodes} episodes are recorded")
    counted: list[Record] = select(records, range(inventory.episodes))
    return Run(cell, path, summarise(counted), {(cell.seed, record.episode_seed): record.success for record in counted},
               counted[0].config_hash, counted[0].checkpoint, _training_seconds(cell, timings))


def _training_seconds(cell: Cell, timings: Timings) -> float | None:
    """Joint training and head of the cell, where all of it is known [s]."""
    method = get_method(cell.method)
    kinds: tuple[Kind, ...] = () if not method.needs_model else ("joint", "head") if method.learns else ("joint",)
    names = [job_name(kind, cell) for kind in kinds]
    found = [timings.get(name) for name in names]
    known = [timing.seconds for timing in found if timing is not None]
    return sum(known) if known and len(known) == len(names) else None


def _comparisons(entries: Sequence[Entry]) -> tuple[Comparison, ...]:
    """VELAP against the baseline with the highest mean rate, the first in the paper's order among equals."""
    found = []
    for velap in (entry for entry in entries if entry.method == "velap" and entry.runs):
        rivals = [entry for entry in entries if (entry.task, entry.preset) == (velap.task, velap.preset)
                  and entry.runs and entry.method not in NO_BASELINES and entry.outcomes.keys() & velap.outcomes.keys()]
        if rivals:
            best = max(rivals, key=lambda entry: entry.rate[0])
            found.append(Comparison(velap.task, velap.preset, best.method, velap.rate[0], best.rate[0],
                                    mcnemar(velap.outcomes, best.outcomes)))
    return tuple(found)


def _mixed_code(entries: Sequence[Entry]) -> list[str]:
    """Files whose episodes come from several versions of the code, or from changes that no commit holds."""
    runs = [run for entry in entries for run in entry.runs]
    notes = [f"{run.path} holds episodes of {len(run.summary.code_versions)} versions of the code: "
             f"{', '.join(run.summary.code_versions)}." for run in runs if len(run.summary.code_versions) > 1]
    dirty = [run for run in runs if any(version.endswith(".dirty") for version in run.summary.code_versions)]
    if dirty:
        notes.append(f"{len(dirty)} files were recorded, wholly or in part, with uncommitted changes of the code: "
                     f"{', '.join(str(run.path) for run in dirty)}.")
    return notes


def _shared(run: Run) -> str:
    """The weights that a run's method has in common with the others; empty where the checkpoint that could tell is not here.

    VELAP's records name all of its weights, some of which are its own.
    """
    if run.cell.method != "velap":
        return run.checkpoint
    metadata = joint_metadata(run.cell.task, run.cell.preset, run.cell.seed)
    if metadata is None:
        return ""
    return shared_weights(metadata) if metadata.get(WEIGHTS_SHA256) == run.checkpoint else run.checkpoint


def _mixed_checkpoints(entries: Sequence[Entry]) -> list[str]:
    """Methods of one task, preset and training seed that do not share their joint checkpoint."""
    checkpoints: dict[tuple[str, str, int], dict[str, list[str]]] = {}
    for run in (run for entry in entries for run in entry.runs):
        key, weights = (run.cell.task, run.cell.preset, run.cell.seed), _shared(run)
        if weights:
            checkpoints.setdefault(key, {}).setdefault(weights, []).append(run.cell.method)
    return [f"{task} {preset} seed {seed}: the methods do not share one joint checkpoint: "
            + "; ".join(f"{checkpoint[:12]} {', '.join(methods)}" for checkpoint, methods in sorted(by.items())) + "."
            for (task, preset, seed), by in checkpoints.items() if len(by) > 1]


def _missing(entries: Sequence[Entry]) -> list[str]:
    """How many cells of each preset are empty."""
    notes = []
    for preset in dict.fromkeys(entry.preset for entry in entries):
        cells = [entry for entry in entries if entry.preset == preset]
        missing = sum(not entry.runs for entry in cells)
        if missing:
            notes.append(f"{missing} of {len(cells)} cells of preset {preset} are missing.")
    return notes
