"""Episode records: one JSON line an episode, appended as it finishes, so that a killed evaluation loses at most one episode.

A file holds one run: the same config, weights, environment, camera, time limit and meaning of success. A torn last line (the
process was killed while writing) is dropped when the file is opened again; damage anywhere else is an error.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import os
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache
from io import FileIO
from pathlib import Path
from typing import Any, Self

from velap.errors import RecordError
from velap.runs import storage_errors
from velap.storage import folder_name, locked
from velap.tasks import TASKS

SCHEMA = 2
"""Version of a line. Schema 1 had no `schema` and none of `_NEW_IN_2`."""
IDENTITY = ("task", "method", "preset", "train_seed", "env", "env_kwargs", "image_key", "max_steps", "success_rule",
            "config_hash", "checkpoint")
"""Fields that are equal in all records of a file."""
_NEW_IN_2: dict[str, Any] = {"env_kwargs": {}, "image_key": None, "success_rule": None, "batch": None, "device": None,
                             "plan_steps": None}
"""Fields that schema 1 lacks, with their values in its records: no options, and an unknown batch and device."""


def record_path(root: Path, task: str, method: str, preset: str, train_seed: int) -> Path:
    """`<root>/<task>/<method>-<preset>/train<seed>.jsonl`."""
    return root / folder_name(task) / f"{method}-{preset}" / f"train{train_seed}.jsonl"


@dataclass(frozen=True, kw_only=True)
class RunKey:
    """Everything that decides the result of an episode except its seed."""

    task: str
    """Task name; the environment id where `--env` named one."""
    method: str
    preset: str
    train_seed: int
    env: str
    """Gymnasium id."""
    config_hash: str
    checkpoint: str
    """SHA-256 of the weights that the method acts by [hex]; empty for methods without weights."""
    code_version: str
    """Package version and commit; may differ between records of a file."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of `gymnasium.make` besides the id."""
    image_key: str | None = None
    """Key of the image in dict observations."""
    max_steps: int | None = None
    """Time limit [steps]; None if unknown, in some records of schema 1."""
    success_rule: str | None = None
    """What counts as success, a rule of `velap.data.success`; None: the environment's info, else a positive reward."""

    def path(self, root: Path) -> Path:
        """Its record file below `root`."""
        return record_path(root, self.task, self.method, self.preset, self.train_seed)


@dataclass(frozen=True, kw_only=True)
class Record(RunKey):
    """One episode."""

    episode_seed: int
    success: bool
    steps: int
    """Environment steps taken [steps]."""
    truncated: bool
    """Ended by the time limit."""
    plan_ms: tuple[float, ...]
    """Time of each plan [ms]: the row's share of the batch that planned together."""
    plan_steps: int | None
    """Steps whose action followed an edge of the current tree [steps]; None for methods without a tree, and in schema 1."""
    batch: int | None
    """Environments that ran at once; None in records of schema 1."""
    device: str | None
    """What the networks ran on, `cpu` or the name of the GPU; None in records of schema 1."""
    schema: int = SCHEMA

    @staticmethod
    def from_json(line: str) -> Record:
        """Parse one line; raises ValueError on anything that is not exactly a record."""
        raw = json.loads(line)
        if not isinstance(raw, dict):
            raise ValueError(f"a {type(raw).__name__} instead of an object")
        if "schema" not in raw:
            raw = _from_schema_1(raw)
        if raw["schema"] > SCHEMA:
            raise ValueError(f"schema {raw['schema']} of a newer velap; this one reads up to {SCHEMA}")
        expected = {field.name for field in dataclasses.fields(Record)}
        if set(raw) != expected:
            raise ValueError(f"missing keys {sorted(expected - set(raw))}, unknown keys {sorted(set(raw) - expected)}")
        raw["plan_ms"] = tuple(raw["plan_ms"])
        return Record(**raw)

    def to_json(self) -> str:
        """One line without its end, keys in the order of the fields."""
        return json.dumps(dataclasses.asdict(self))


def _from_schema_1(raw: dict[str, Any]) -> dict[str, Any]:
    """A line of schema 1 with the fields of schema 2.

    The time limit is the length of an episode that ran out of time, else that of the task's environment, else unknown
    (None).
    """
    limit = raw.get("steps") if raw.get("truncated") else _time_limit_of(str(raw.get("env")))
    return {**raw, **_NEW_IN_2, "max_steps": limit, "schema": 1}


@cache
def _time_limit_of(env_id: str) -> int | None:
    """The time limit of the task with that environment [steps]; None for other environments."""
    return next((task.max_steps for task in TASKS.values() if task.env_id == env_id), None)


def read_records(path: Path) -> list[Record]:
    """All complete records of a file, without a torn last line. Raises RecordError on other damage or doubled seeds."""
    return _parse(path, path.read_bytes())[0]


def _parse(path: Path, payload: bytes) -> tuple[list[Record], int]:
    """The records of `payload` and the length of its undamaged beginning [bytes]."""
    records: list[Record] = []
    sound = 0
    for number, line in enumerate(payload.splitlines(keepends=True), start=1):
        if not line.endswith(b"\n"):
            break
        try:
            records.append(Record.from_json(line.decode()))
        except (ValueError, TypeError) as error:
            raise RecordError(f"{path}, line {number} is not a record ({error}). Restore the file, or move it aside with "
                              "--fresh and evaluate again.") from error
        sound += len(line)
    seeds = [record.episode_seed for record in records]
    if len(set(seeds)) != len(seeds):
        doubled = sorted({seed for seed in seeds if seeds.count(seed) > 1})
        raise RecordError(f"{path} counts the episode seeds {doubled[:5]} more than once; every seed counts exactly once. "
                          "Move it aside with --fresh and evaluate again.")
    return records, sound


class RecordFile:
    """The record file of one run, open for appending and locked against a second writer."""

    def __init__(self, path: Path, key: RunKey, fresh: bool = False) -> None:
        self.path = path
        self.key = key
        with storage_errors(self.path), ExitStack() as opened:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            try:
                opened.enter_context(locked(self.path.with_name(f".{self.path.name}.lock")))
            except BlockingIOError as error:
                raise RecordError(f"another evaluation is writing {self.path}. Wait for it, or give other "
                                  "--records.") from error
            if fresh and self.path.exists():
                self.path.rename(_free_name(self.path))
            self._stream: FileIO = opened.enter_context(self.path.open("a+b", buffering=0))
            self.records = self._resume()
            self._opened = opened.pop_all()

    def _resume(self) -> list[Record]:
        """The existing records, all of this run; a torn end is cut off."""
        self._stream.seek(0)
        records, sound = _parse(self.path, self._stream.read())
        self._stream.truncate(sound)
        for record in records:
            differing = [name for name in IDENTITY if getattr(record, name) != getattr(self.key, name)]
            if differing:
                name = differing[0]
                raise RecordError(
                    f"{self.path} holds records of another run: `{name}` is {getattr(record, name)!r} there and "
                    f"{getattr(self.key, name)!r} here.{_another_way_to_act(name)} Give --fresh to move that file aside and "
                    "start a new one.")
        return records

    @property
    def done(self) -> set[int]:
        """Episode seeds already recorded."""
        return {record.episode_seed for record in self.records}

    def append(self, record: Record) -> None:
        """Write one record through to the disk."""
        if record.episode_seed in self.done:
            raise RecordError(f"episode seed {record.episode_seed} is in {self.path} already; a seed counts only once.")
        line = record.to_json().encode() + b"\n"
        start = self._stream.seek(0, os.SEEK_END)
        with storage_errors(self.path):
            try:
                if self._stream.write(line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(self._stream.fileno())
            except OSError:
                self._stream.truncate(start)
                raise
        self.records.append(record)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self._opened.close()


def _free_name(path: Path) -> Path:
    """`train0.jsonl.old-1`, or the next number that is free."""
    taken = {sibling.name for sibling in path.parent.iterdir()}
    number = next(n for n in range(1, len(taken) + 2) if f"{path.name}.old-{n}" not in taken)
    return path.with_name(f"{path.name}.old-{number}")


def _another_way_to_act(name: str) -> str:
    """What another `config_hash` may come from, besides another config."""
    return (" Records of a version of velap whose configs had other fields count as another method's, which are not gone on "
            "with." if name == "config_hash" else "")


def check_config(path: Path, config_hash: str) -> None:
    """Raises RecordError if a file holds records of another config: called before a training rather than after it."""
    found = {record.config_hash for record in read_records(path)} if path.exists() else {config_hash}
    if found - {config_hash}:
        raise RecordError(f"{path} holds records of another config ({', '.join(sorted(found))}, now {config_hash})."
                          f"{_another_way_to_act('config_hash')} Give --fresh to move that file aside, or other --records.")


def read_all(root: Path) -> dict[Path, list[Record]]:
    """Every record file below `root` with its records, in the order of their names."""
    return {path: read_records(path) for path in sorted(root.rglob("*.jsonl"))}


def select(records: Iterable[Record], seeds: Iterable[int]) -> list[Record]:
    """The records of `seeds` in their order; raises RecordError when one is missing."""
    by_seed = {record.episode_seed: record for record in records}
    wanted = list(seeds)
    missing = [seed for seed in wanted if seed not in by_seed]
    if missing:
        raise RecordError(f"{len(missing)} of {len(wanted)} episodes are not recorded (seeds {missing[:5]}...). "
                          "Repeat the evaluation; it goes on where it stopped.")
    return [by_seed[seed] for seed in wanted]
