"""What is there of each job of the table: nothing, a part, all of it, or something of another config."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

from safetensors import SafetensorError, safe_open

from studies.matrix import Cell
from studies.timings import Timings
from velap.config import Config
from velap.data import minari_io
from velap.errors import ConfigError, RecordError
from velap.evaluation.records import Record, read_records, record_path
from velap.methods.base import get_method
from velap.methods.heads import head_path
from velap.models.velap import WEIGHTS_SHA256, shared_weights
from velap.storage import run_dir
from velap.tasks import Recipe, get_task, make_config
from velap.training.loop import MODEL

Kind = Literal["dataset", "joint", "head", "evaluate"]
"""Of a job, in the order of a chain."""
DATASET_SEED = 0
"""Seed of every dataset of the table: training seeds share their data."""

RELEASED = Path("checkpoints")
"""Where released checkpoints lie, `<task>.safetensors`."""


@dataclass(frozen=True)
class Finding:
    """What is there of one job."""

    done: int
    total: int
    unit: str
    """Of `done` and `total`: episodes, updates, trajectories."""
    finished: bool
    problem: str = ""
    """What is there belongs to something else, and why; empty where nothing stands in the way."""
    seconds: float | None = None
    """Time that it took, where the result says so itself [s]."""


class Inventory:
    """Looks at the files of a table. Nothing is remembered between two looks."""

    def __init__(self, records: Path, episodes: int, timings: Timings) -> None:
        self.records, self.episodes, self.timings = records, episodes, timings

    def look(self, kind: Kind, cell: Cell) -> Finding:
        """What is there of one job of a cell's chain."""
        if kind == "dataset":
            return self.dataset(cell.task)
        if kind == "joint":
            return self.joint(cell.task, cell.preset, cell.seed)
        return self.head(cell) if kind == "head" else self.evaluation(cell)

    def identity(self, kind: Kind, cell: Cell) -> str:
        """What a job's result has to be recognised by later: hash of dataset, config, head weights or record config."""
        if kind == "dataset":
            return str(dataset_provenance(cell.task).get("content_sha256", ""))
        if kind == "joint":
            return make_config(cell.task, cell.preset).hash()
        if kind == "evaluate":
            return self.expected_hash(cell) or ""
        metadata = checkpoint_metadata(self.head_path(cell))
        return metadata[WEIGHTS_SHA256] if metadata is not None else ""

    def dataset(self, task: str) -> Finding:
        """The dataset of a task: there, and made by the recipe of today."""
        recipe = get_task(task).recipe
        total = recipe.contexts * recipe.trajectories
        plan = dataset_provenance(task).get("plan")
        if plan is None:
            foreign = minari_io.exists(get_task(task).dataset_id)
            return Finding(0, total, "trajectories", False, "velap did not collect the dataset there" if foreign else "")
        wanted = {"task": task, "seed": DATASET_SEED, "recipe": dataclasses.asdict(recipe), "shares": get_task(task).shares}
        found = {**plan, "recipe": {**_recipe_defaults(), **plan.get("recipe", {})}}
        wrong = [name for name, value in wanted.items() if found.get(name) != json.loads(json.dumps(value))]
        problem = f"the dataset was collected with another {wrong[0]}" if wrong else ""
        return Finding(0 if wrong else total, total, "trajectories", not wrong, problem)

    def joint(self, task: str, preset: str, seed: int) -> Finding:
        """The joint checkpoint of a run: trained to its end, by the config of today, on the dataset that is there."""
        config, folder = make_config(task, preset), checkpoint_path(task, preset, seed).parent
        total = config.train.steps
        metadata = joint_metadata(task, preset, seed)
        if metadata is None:
            return _unfinished_joint(folder, config, total)
        problem = _joint_problem(config, metadata, dataset_provenance(task).get("content_sha256"))
        # Planner and controller are kept with the weights: another one there means to write the file anew, not to train.
        same = not problem and Config.from_json(metadata["config"]) == config
        return Finding(0 if problem else total, total, "updates", same, problem, None if problem else _seconds(metadata))

    def head(self, cell: Cell) -> Finding:
        """The head of a cell: learnt on the latents of the joint checkpoint that is there, with the settings of today."""
        joint = joint_metadata(cell.task, cell.preset, cell.seed)
        path, total = self.head_path(cell), _expected_updates(cell)
        head = checkpoint_metadata(path)
        wanted = {"method": cell.method, "head_config": head_settings(cell)}
        fits = (joint is not None and head is not None and head.get("joint") == shared_weights(joint)
                and all(head.get(name) == value for name, value in wanted.items()))
        if fits and head is not None:
            return Finding(int(head["steps"]), int(head["steps"]), "updates", True, seconds=_seconds(head))
        begun = _last_step(path.with_suffix(".metrics.jsonl")) if path.with_suffix(".state.safetensors").exists() else 0
        return Finding(min(begun, total), total, "updates", False)

    def evaluation(self, cell: Cell) -> Finding:
        """The records of a cell: all episodes, by the config of today and the checkpoint that is there."""
        path = self.record_path(cell)
        try:
            records = read_records(path) if path.exists() else []
        except RecordError as error:
            return Finding(0, self.episodes, "episodes", False, str(error))
        problem = self.record_problem(cell, records)
        done = 0 if problem else len({record.episode_seed for record in records} & set(range(self.episodes)))
        return Finding(done, self.episodes, "episodes", done == self.episodes, problem)

    def expected_hash(self, cell: Cell) -> str | None:
        """The `config_hash` that an evaluation of the cell writes today; None where its head is not known."""
        config = make_config(cell.task, cell.preset)
        method = get_method(cell.method)
        if not method.learns:
            return method.config_hash(config)
        metadata, timing = checkpoint_metadata(self.head_path(cell)), self.timings.get(job_name("head", cell))
        weights = metadata[WEIGHTS_SHA256] if metadata is not None else timing.identity if timing is not None else None
        return None if weights is None else method.config_hash(config, _Head(head_settings(cell), weights))

    def head_path(self, cell: Cell) -> Path:
        """Where the head of a cell lies."""
        return head_path(checkpoint_path(cell.task, cell.preset, cell.seed), cell.method)

    def record_path(self, cell: Cell) -> Path:
        """The record file of a cell."""
        return record_path(self.records, cell.task, cell.method, cell.preset, cell.seed)

    def record_problem(self, cell: Cell, records: list[Record]) -> str:
        """Why these records are not of the cell as it is configured today; empty where they are."""
        if not records:
            return ""
        if self.expected_hash(cell) is None:
            return (f"its `config_hash` cannot be checked: the head that it was made with is neither {self.head_path(cell)} "
                    f"nor known to {self.timings.path}")
        expected = {"task": cell.task, "method": cell.method, "preset": cell.preset, "train_seed": cell.seed,
                    "env": get_task(cell.task).env_id, "config_hash": self.expected_hash(cell)}
        joint = None
        if cell.method != "random":
            joint = joint_metadata(cell.task, cell.preset, cell.seed)
        if joint is not None:
            expected["checkpoint"] = joint[WEIGHTS_SHA256] if cell.method == "velap" else shared_weights(joint)
        for name, value in expected.items():
            found = {getattr(record, name) for record in records}
            if found != {value}:
                others = ", ".join(sorted(str(entry)[:12] for entry in found - {value}))
                return f"its `{name}` is {others}, that of today {str(value)[:12]}"
        return ""


@dataclass
class _Head:
    """What `Method.config_hash` asks of a head."""

    settings: str
    weights_sha256: str


def job_name(kind: Kind, cell: Cell) -> str:
    """Name of a job of the cell's chain, the same for all cells that share it."""
    where = f"{cell.preset} seed {cell.seed}"
    return {"dataset": f"dataset {cell.task}", "joint": f"joint {cell.task} {where}",
            "head": f"head {cell.task} {cell.method} {where}", "evaluate": f"evaluate {cell}"}[kind]


def checkpoint_path(task: str, preset: str, seed: int) -> Path:
    """The joint checkpoint of a run."""
    return run_dir(task, preset, seed) / MODEL


def head_settings(cell: Cell) -> str:
    """The settings that the cell's head is trained with today."""
    return get_method(cell.method).learner_config(cell.preset).to_json()


def released_checkpoint(task: str, preset: str, seed: int) -> Path | None:
    """The released checkpoint of a task where it is what this run would give and the run has not begun; None otherwise."""
    path = RELEASED / f"{task}.safetensors"
    metadata = None if checkpoint_path(task, preset, seed).parent.exists() else checkpoint_metadata(path)
    if metadata is None or metadata.get("seed") != str(seed):
        return None
    config = make_config(task, preset)
    if _joint_problem(config, metadata, dataset_provenance(task).get("content_sha256")):
        return None
    return path if Config.from_json(metadata["config"]) == config else None


def joint_metadata(task: str, preset: str, seed: int) -> Mapping[str, str] | None:
    """Metadata of the run's joint checkpoint, or of the released one that will stand for it; None where there is neither."""
    return checkpoint_metadata(released_checkpoint(task, preset, seed) or checkpoint_path(task, preset, seed))


def dataset_provenance(task: str) -> dict[str, Any]:
    """What velap noted in the metadata of the task's dataset; empty where there is none."""
    dataset_id = get_task(task).dataset_id
    return minari_io.velap_metadata(minari_io.read_metadata(dataset_id)) if minari_io.exists(dataset_id) else {}


def checkpoint_metadata(path: Path) -> Mapping[str, str] | None:
    """Metadata of a checkpoint or head, its tensors left alone; None where there is no readable file."""
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


def _joint_problem(config: Config, metadata: Mapping[str, str], dataset_hash: str | None) -> str:
    """Why the finished checkpoint with this metadata cannot stand for `config`; planner and controller do not count."""
    try:
        saved = Config.from_json(metadata.get("config", ""))
    except ConfigError as error:
        return f"the checkpoint cannot be read: {error}"
    if (saved.model, saved.train) != (config.model, config.train):
        return f"the checkpoint was trained with another config: {difference(saved, config)}"
    if dataset_hash is not None and metadata.get("dataset_hash") != dataset_hash:
        return "the checkpoint was trained on other data than the dataset that is there"
    return ""


def _unfinished_joint(folder: Path, config: Config, total: int) -> Finding:
    """Progress of a run without a checkpoint yet."""
    started = folder / "config.json"
    if not started.exists():
        return Finding(0, total, "updates", False)
    try:
        saved = Config.from_json(started.read_text())
    except ConfigError as error:
        return Finding(0, total, "updates", False, f"{started} cannot be read: {error}")
    if (saved.model, saved.train) != (config.model, config.train):
        return Finding(0, total, "updates", False, f"a run of another config was begun there: {difference(saved, config)}")
    return Finding(_last_step(folder / "metrics.jsonl"), total, "updates", False)


def difference(saved: Config, config: Config) -> str:
    """The first field of model and training in which two configs differ, with both values."""
    for part in ("model", "train"):
        there, here = dataclasses.asdict(getattr(saved, part)), dataclasses.asdict(getattr(config, part))
        for name in here:
            if there[name] != here[name]:
                return f"{part}.{name} is {there[name]!r} there and {here[name]!r} today"
    return "no field"


def _expected_updates(cell: Cell) -> int:
    """Updates that the cell's head should take by the recipe of its dataset [steps]; BC(D*) sees the way to each reward."""
    recipe = get_task(cell.task).recipe
    transitions = recipe.transitions
    if cell.method == "bc-success":
        transitions = round(transitions * recipe.success_percent / 100 * recipe.max_steps / 2)
    return get_method(cell.method).learner_config(cell.preset).length(transitions)


def _recipe_defaults() -> dict[str, Any]:
    """Values of the recipe's fields that datasets from before those fields do not name."""
    return {field.name: field.default for field in dataclasses.fields(Recipe) if field.default is not dataclasses.MISSING}


def _seconds(metadata: Mapping[str, str]) -> float | None:
    """Training time that a checkpoint or head notes [s]."""
    return float(metadata["train_seconds"]) if "train_seconds" in metadata else None


def _last_step(metrics: Path) -> int:
    """Updates that a run has logged [steps]."""
    try:
        return int(json.loads(metrics.read_text().splitlines()[-1])["step"])
    except (OSError, ValueError, KeyError, IndexError):
        return 0
