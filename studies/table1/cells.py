"""The cells of Tables 1 and 11, and the state of each on disk: dataset, joint checkpoint, head, records."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open

from studies.table1.paper import ROWS, TASKS_11
from studies.table1.paper import TASKS as PAPER_TASKS
from velap.config import Config, describe
from velap.data import minari_io
from velap.errors import ConfigError, RecordError, UnknownTaskError
from velap.evaluation.records import Record, read_records, record_path
from velap.methods.base import get_method
from velap.methods.heads import head_path
from velap.models.checkpoint import WEIGHTS_SHA256, shared_weights
from velap.registry import METHODS
from velap.runs import write_atomic
from velap.storage import run_dir
from velap.tasks import PRESETS, ROBOT_TASKS, TASKS, Recipe, get_task, make_config
from velap.training.loop import MODEL

DATASET_SEED = 0
"""Seed of every dataset: training seeds share their data."""
RELEASED = Path("checkpoints")
"""Where released checkpoints lie, `<task>.safetensors`."""
TRAINING = Path("results/training.json")
"""Training time and hash of each joint checkpoint and head, whose files are not kept."""

OTHER_PLANNER = "the checkpoint holds another planner or controller than today's"


def in_paper_order(names: Sequence[str], order: Sequence[str]) -> tuple[str, ...]:
    """`names` in the paper's order, followed by those that the paper lacks."""
    return tuple(sorted(names, key=lambda name: order.index(name) if name in order else len(order)))


_ROBOT = [task.name for task in ROBOT_TASKS]
TABLES = {"1": in_paper_order([name for name in TASKS if name not in _ROBOT], PAPER_TASKS),
          "11": in_paper_order(_ROBOT, TASKS_11)}
"""Number of a table -> its tasks; those of other packages are in Table 1."""
METHOD_ORDER = in_paper_order(tuple(METHODS), ROWS)


@dataclass(frozen=True, order=True)
class Cell:
    """One evaluation: a task, a method, a preset and a training seed."""

    task: str
    method: str
    preset: str
    seed: int
    """Training seed; 0 for `random`, which learns nothing."""

    def __str__(self) -> str:
        return f"{self.task} {self.method} {self.preset} seed {self.seed}"

    @property
    def checkpoint(self) -> Path:
        """The joint checkpoint that the cell acts by."""
        return run_dir(self.task, self.preset, self.seed) / MODEL

    @property
    def head(self) -> Path | None:
        """The method's head; None for methods without one."""
        return head_path(self.checkpoint, self.method) if get_method(self.method).learns else None

    @property
    def released(self) -> Path | None:
        """The released checkpoint if it is what the joint training would give and that has not begun; else None."""
        path = RELEASED / f"{self.task}.safetensors"
        metadata = None if self.checkpoint.parent.exists() else file_metadata(path)
        if metadata is None or metadata.get("seed") != str(self.seed):
            return None
        return None if checkpoint_problem(self, metadata) else path

    @property
    def joint(self) -> Mapping[str, str] | None:
        """Metadata of the joint checkpoint, or of the released one in its place; None without both."""
        return file_metadata(self.released or self.checkpoint)

    @property
    def names(self) -> tuple[str, ...]:
        """Names in `TRAINING` of the joint checkpoint and head."""
        where = f"{self.preset} seed {self.seed}"
        joint, head = f"joint {self.task} {where}", f"head {self.task} {self.method} {where}"
        method = get_method(self.method)
        return () if not method.needs_model else (joint, head) if method.learns else (joint,)

    def records(self, root: Path) -> Path:
        """Its record file below `root`."""
        return record_path(root, self.task, self.method, self.preset, self.seed)


def parse_only(filters: Sequence[str] = (), number: str = "1") -> tuple[Cell, ...]:
    """`["task=SpiralMaze", "method=bc,iql"]` -> the cells of a table; axes that are not named are all its tasks, all
    methods, preset default, seed 0.

    Raises ConfigError on another form, UnknownTaskError on names that are not registered.
    """
    order = TABLES[number]
    known = {"task": order, "method": METHOD_ORDER, "preset": PRESETS}
    chosen: dict[str, Sequence[str]] = {**known, "preset": ("default",), "seed": ("0",)}
    named = set()
    for text in filters:
        axis, equals, values = text.partition("=")
        names = tuple(dict.fromkeys(name for name in values.split(",") if name))
        if not equals or axis not in chosen or not names:
            raise ConfigError(f"--only got {text!r}; expected AXIS=VALUE,VALUE with an axis of {', '.join(chosen)}, such as "
                              "`--only task=SpiralMaze method=bc,iql`.")
        if axis in named:
            raise ConfigError(f"--only names the axis {axis!r} twice; give all its values at once: {axis}=A,B.")
        for name in names:
            if axis == "seed" and not name.isdecimal():
                raise ConfigError(f"--only got the seed {name!r}; expected whole numbers from 0 on, such as seed=0,1,2.")
            if axis != "seed" and name not in known[axis]:
                raise UnknownTaskError(f"--only names the unknown {axis} {name!r}; expected some of "
                                       f"{', '.join(known[axis])}. Names are case-sensitive.")
        named.add(axis)
        chosen[axis] = names
    tasks, methods = in_paper_order(chosen["task"], order), in_paper_order(chosen["method"], METHOD_ORDER)
    seeds = {method: chosen["seed"] if get_method(method).needs_model else ("0",) for method in methods}
    return tuple(Cell(task, method, preset, int(seed)) for task in tasks for preset in chosen["preset"] for method in methods
                 for seed in seeds[method])


@dataclass(frozen=True)
class State:
    """The records of a cell."""

    done: int
    """Recorded episodes of today's config [episodes]."""
    records: tuple[Record, ...] = ()
    problem: str = ""
    """Why the records do not belong to today's config; empty if they do."""


def look(cell: Cell, root: Path, episodes: int) -> State:
    """The records of a cell, compared with today's config and the checkpoint on disk."""
    path = cell.records(root)
    try:
        records = read_records(path) if path.exists() else []
    except RecordError as error:
        return State(0, problem=str(error).removesuffix("."))
    problem = record_problem(cell, records)
    done = 0 if problem else len({record.episode_seed for record in records} & set(range(episodes)))
    return State(done, tuple(records), problem)


def record_problem(cell: Cell, records: Sequence[Record]) -> str:
    """Why these records do not belong to today's config; empty if they do."""
    if not records:
        return ""
    config_hash, task, method = expected_hash(cell), get_task(cell.task), get_method(cell.method)
    joint = cell.joint if method.needs_model else None
    if config_hash is None:
        return (f"its `config_hash` cannot be checked: the head that it was made with is neither {cell.head} nor known to "
                f"{TRAINING}")
    expected: dict[str, Any] = {
        "task": cell.task, "method": cell.method, "preset": cell.preset, "train_seed": cell.seed, "env": task.env_id,
        "env_kwargs": {}, "image_key": None, "max_steps": task.max_steps, "config_hash": config_hash}
    if joint is not None:
        expected["checkpoint"] = joint[WEIGHTS_SHA256] if method.whole_checkpoint else shared_weights(joint)
    for name, value in expected.items():
        found = {str(getattr(record, name)): getattr(record, name) for record in records}
        others = sorted(text[:12] for text, got in found.items() if got != value)
        if others:
            return f"its `{name}` is {', '.join(others)}, that of today {str(value)[:12]}"
    return ""


def expected_hash(cell: Cell) -> str | None:
    """The `config_hash` that an evaluation of the cell writes today; None if its head is unknown."""
    config, method = make_config(cell.task, cell.preset), get_method(cell.method)
    if cell.head is None:
        return method.config_hash(config)
    metadata = file_metadata(cell.head)
    weights = metadata[WEIGHTS_SHA256] if metadata is not None else training_notes().get(cell.names[1], {}).get("identity")
    return None if weights is None else method.config_hash(config, _Head(head_settings(cell), weights))


@dataclass
class _Head:
    """The part of a head that `Method.config_hash` uses."""

    settings: str
    weights_sha256: str


def head_settings(cell: Cell) -> str:
    """Today's settings of the cell's head."""
    return get_method(cell.method).learner_config(cell.preset).to_json()


def outdated(cell: Cell) -> Iterator[tuple[Path, str]]:
    """Inputs of the cell that differ from what today's code would make, each with the reason."""
    if not get_method(cell.method).needs_model:
        return
    if reason := dataset_problem(cell.task):
        yield dataset_file(cell.task), reason
    checkpoint, metadata = cell.checkpoint, file_metadata(cell.checkpoint)
    begun = checkpoint.with_name("config.json")
    reason = checkpoint_problem(cell, metadata or {"config": begun.read_text()}) if metadata or begun.exists() else ""
    if reason == OTHER_PLANNER and metadata is not None:
        yield checkpoint, reason  # the training goes on from its state and writes the file anew, without an update
    elif reason and reason != OTHER_PLANNER:
        yield checkpoint.parent, reason
    elif cell.head is not None and (head := file_metadata(cell.head)) is not None:
        wanted = {"method": cell.method, "head_config": head_settings(cell), "joint": shared_weights(cell.joint or {})}
        wrong = [name for name, value in wanted.items() if head.get(name) != value]
        if wrong:
            yield cell.head, f"the head was learnt with another `{wrong[0]}`"


def dataset_file(task: str) -> Path:
    """The file whose presence shows that the task's dataset is complete."""
    return minari_io.dataset_path(get_task(task).dataset_id) / "data" / "metadata.json"


def dataset_provenance(task: str) -> dict[str, Any]:
    """velap's entry in the metadata of the task's dataset; empty without one."""
    dataset_id = get_task(task).dataset_id
    return minari_io.velap_metadata(minari_io.read_metadata(dataset_id)) if minari_io.exists(dataset_id) else {}


def dataset_problem(task: str) -> str:
    """Why the task's dataset differs from what `velap collect` makes today; empty if it does not, or without a dataset."""
    if not minari_io.exists(get_task(task).dataset_id):
        return ""
    plan = dataset_provenance(task).get("plan")
    if plan is None:
        return "velap did not collect the dataset there"
    recipe = dataclasses.asdict(get_task(task).recipe)
    wanted = {"task": task, "seed": DATASET_SEED, "recipe": recipe, "shares": get_task(task).shares}
    defaults = {each.name: each.default for each in dataclasses.fields(Recipe) if each.default is not dataclasses.MISSING}
    found = {**plan, "recipe": {**defaults, **plan.get("recipe", {})}}  # older datasets lack younger fields
    wrong = [name for name, value in wanted.items() if found.get(name) != json.loads(json.dumps(value))]
    return f"the dataset was collected with another {wrong[0]}" if wrong else ""


def checkpoint_problem(cell: Cell, metadata: Mapping[str, str]) -> str:
    """Why a joint checkpoint with this metadata does not belong to today's config; empty if it does."""
    config, dataset_hash = make_config(cell.task, cell.preset), dataset_provenance(cell.task).get("content_sha256")
    try:
        saved = Config.from_json(metadata.get("config", ""))
    except ConfigError as error:
        return f"the checkpoint cannot be read: {error}"
    if (saved.model, saved.train) != (config.model, config.train):
        there, here = ({name: value for name, _, value, _ in describe(each)} for each in (saved, config))
        name = next(name for name in here if there.get(name) != here[name])
        return f"the checkpoint has another config: {name} is {there.get(name)} there and {here[name]} today"
    if None not in (dataset_hash, metadata.get("dataset_hash")) and metadata.get("dataset_hash") != dataset_hash:
        return "the checkpoint was trained on other data than the dataset that is there"
    return "" if saved == config else OTHER_PLANNER


def file_metadata(path: Path) -> Mapping[str, str] | None:
    """Metadata of a checkpoint or head, without reading its tensors; None without a readable file."""
    if not path.is_file():
        return None
    stat = path.stat()
    return _metadata(path, stat.st_mtime_ns, stat.st_size)


@cache
def _metadata(path: Path, changed: int, size: int) -> Mapping[str, str] | None:
    try:
        with safe_open(str(path), framework="pt") as file:
            return dict(file.metadata() or {})
    except (SafetensorError, OSError, ValueError):
        return None


def training_notes() -> dict[str, dict[str, Any]]:
    """`TRAINING`: name -> training time [s] and hash of the result."""
    try:
        return json.loads(TRAINING.read_bytes()) if TRAINING.exists() else {}
    except ValueError as error:
        raise RecordError(f"{TRAINING} is not JSON ({error}); expected what `velap table 1` wrote. Restore the file."
                          ) from error


def note_training(cells: Sequence[Cell]) -> None:
    """Add the training times of the existing checkpoints and heads to `TRAINING`."""
    notes = before = training_notes()
    for cell in cells:
        if any(True for _ in outdated(cell)):
            continue
        files = (cell.joint, file_metadata(cell.head) if cell.head is not None else None)
        for name, metadata in zip(cell.names, files, strict=False):
            if metadata is None or "train_seconds" not in metadata:
                continue
            identity = metadata[WEIGHTS_SHA256]
            if notes.get(name, {}).get("identity") != identity:
                notes = {**notes, name: {"seconds": float(metadata["train_seconds"]), "identity": identity}}
    if notes != before:
        write_atomic(TRAINING, (json.dumps(notes, indent=1, sort_keys=True) + "\n").encode())


def training_seconds(cell: Cell) -> float | None:
    """Time of the joint training and of the method's head; None if unknown [s]."""
    notes = training_notes()
    known = [notes[name]["seconds"] for name in cell.names if name in notes]
    return sum(known) if known and len(known) == len(cell.names) else None
