"""Record files: append, resume, kill -9 in the middle of a line, damage, foreign runs, two writers, a full disk."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from velap.errors import RecordError, StorageError
from velap.evaluation.records import Record, RecordFile, RunKey, read_all, read_records, select
from velap.storage import SHIPPED_RECORDS
from velap.tasks import TASKS

KEY = RunKey(task="Maze", method="velap", preset="default", train_seed=0, env="velap/Maze-v0", config_hash="abc",
             checkpoint="c0ffee", code_version="0.1.0", max_steps=300)


def record(seed: int, success: bool = True, steps: int = 10) -> Record:
    return Record(**vars(KEY), episode_seed=seed, success=success, steps=steps, truncated=not success, plan_ms=(1.5, 2.25),
                  plan_steps=None, batch=1, device="cpu")


def filled(path: Path, count: int) -> bytes:
    with RecordFile(path, KEY) as file:
        for seed in range(count):
            file.append(record(seed))
    return path.read_bytes()


def test_lines_are_json_with_the_agreed_keys(tmp_path: Path) -> None:
    path = KEY.path(tmp_path)
    assert path == tmp_path / "Maze" / "velap-default" / "train0.jsonl"
    line = json.loads(filled(path, 1))
    required = "task method preset train_seed episode_seed success steps plan_ms config_hash code_version truncated"
    assert set(required.split()) <= set(line)
    assert read_records(path) == [record(0)]


def test_a_resume_keeps_what_is_there(tmp_path: Path) -> None:
    before = filled(tmp_path / "r.jsonl", 3)
    with RecordFile(tmp_path / "r.jsonl", KEY) as file:
        assert file.done == {0, 1, 2}
        file.append(record(3, success=False))
    assert (tmp_path / "r.jsonl").read_bytes().startswith(before)
    assert [r.episode_seed for r in read_records(tmp_path / "r.jsonl")] == [0, 1, 2, 3]


def test_a_line_torn_anywhere_is_dropped(tmp_path: Path) -> None:
    whole = filled(tmp_path / "whole.jsonl", 3)
    second_end = whole.index(b"\n", whole.index(b"\n") + 1) + 1
    for cut in range(second_end, len(whole)):
        path = tmp_path / "torn.jsonl"
        path.write_bytes(whole[:cut])
        assert len(read_records(path)) == 2
        with RecordFile(path, KEY) as file:
            assert file.done == {0, 1}
            assert path.read_bytes() == whole[:second_end]
    with RecordFile(path, KEY) as file:
        file.append(record(2))
    assert path.read_bytes() == whole


def test_kill_leaves_whole_records_only(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    script = textwrap.dedent(f"""
        import sys
        sys.path.insert(0, {str(Path(__file__).parent)!r})
        from pathlib import Path
        from test_records import KEY, record
        from velap.evaluation.records import RecordFile
        file = RecordFile(Path({str(path)!r}), KEY)
        for seed in range(10**6):
            file.append(record(seed))
            print(seed, flush=True)
    """)
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 20:
                process.send_signal(signal.SIGKILL)
                break
    with RecordFile(path, KEY) as file:
        assert file.done == set(range(len(file.done)))
        assert len(file.done) >= 21


@pytest.mark.parametrize("damage", [b"not json\n", b"[1]\n", b'{"task": "Maze"}\n', b"\xff\xfe\n"])
def test_damage_before_the_end_is_an_error(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "r.jsonl"
    whole = filled(path, 2)
    first = whole.index(b"\n") + 1
    path.write_bytes(whole[:first] + damage + whole[first:])
    with pytest.raises(RecordError, match=r"line 2 is not a record.*--fresh"):
        RecordFile(path, KEY)
    assert path.read_bytes() == whole[:first] + damage + whole[first:], "a damaged file is left as it was"


def test_a_seed_counts_once(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    line = filled(path, 1)
    with RecordFile(path, KEY) as file, pytest.raises(RecordError, match="seed 0 is in"):
        file.append(record(0))
    path.write_bytes(line + line)
    with pytest.raises(RecordError, match=r"\[0\] more than once"):
        read_records(path)


@pytest.mark.parametrize(("field", "value"), [
    ("config_hash", "other"), ("checkpoint", "other"), ("env", "other"), ("image_key", "wrist"), ("max_steps", 5),
    ("success_rule", "reward>=0"), ("env_kwargs", {"size": 96})])
def test_records_of_another_run_are_not_mixed(tmp_path: Path, field: str, value: object) -> None:
    path = tmp_path / "r.jsonl"
    old = filled(path, 2)
    other = dataclasses.replace(KEY, **{field: value})
    expected = rf"`{field}` is .* there and {re.escape(repr(value))} here\..* Give --fresh"
    with pytest.raises(RecordError, match=expected) as told:
        RecordFile(path, other)
    assert ("count as another method's" in str(told.value)) == (field == "config_hash")
    for number in (1, 2):
        with RecordFile(path, other, fresh=True) as file:
            assert file.done == set()
            file.append(dataclasses.replace(record(0), **{field: value}))
        assert (tmp_path / f"r.jsonl.old-{number}").exists()
    assert (tmp_path / "r.jsonl.old-1").read_bytes() == old


def test_another_code_version_batch_or_device_may_go_on(tmp_path: Path) -> None:
    filled(tmp_path / "r.jsonl", 1)
    with RecordFile(tmp_path / "r.jsonl", dataclasses.replace(KEY, code_version="0.1.1")) as file:
        assert file.done == {0}
        file.append(dataclasses.replace(record(1), code_version="0.1.1", batch=8, device="NVIDIA H100"))
    assert [(r.batch, r.device) for r in read_records(tmp_path / "r.jsonl")] == [(1, "cpu"), (8, "NVIDIA H100")]


def schema_1(env: str, steps: int, truncated: bool) -> bytes:
    """A line as velap wrote it before it noted camera, time limit, batch and device."""
    return json.dumps({
        "task": "SpiralMaze", "method": "velap", "preset": "default", "train_seed": 0, "env": env, "config_hash": "abc",
        "checkpoint": "c0ffee", "code_version": "0.1.0", "episode_seed": 0, "success": not truncated, "steps": steps,
        "truncated": truncated, "plan_ms": [1.5]}).encode() + b"\n"


@pytest.mark.parametrize(("env", "steps", "truncated", "limit"), [
    ("velap/SpiralMaze-v0", 177, False, 300), ("velap/SpiralMaze-v0", 300, True, 300), ("velap/SpiralMaze-v0", 4, True, 4),
    ("robot:Robot-v0", 20, True, 20), ("robot:Robot-v0", 7, False, None)])
def test_schema_1_is_migrated_and_goes_on_where_its_time_limit_is_known(tmp_path: Path, env: str, steps: int,
                                                                        truncated: bool, limit: int | None) -> None:
    path = tmp_path / "r.jsonl"
    path.write_bytes(schema_1(env, steps, truncated))
    (old,) = read_records(path)
    assert (old.schema, old.max_steps) == (1, limit)
    assert (old.env_kwargs, old.image_key, old.batch, old.device) == ({}, None, None, None)
    key = dataclasses.replace(KEY, task="SpiralMaze", env=env, max_steps=limit or 20)
    if limit is None:
        with pytest.raises(RecordError, match="`max_steps` is None there and 20 here"):
            RecordFile(path, key)
    else:
        with RecordFile(path, key) as file:
            assert file.done == {0}
        with pytest.raises(RecordError, match="`image_key` is None there and 'wrist' here"):
            RecordFile(path, dataclasses.replace(key, image_key="wrist"))
    assert path.read_bytes() == schema_1(env, steps, truncated), "read, not rewritten"


def test_a_newer_schema_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "r.jsonl"
    path.write_text(json.dumps({**json.loads(filled(path, 1)), "schema": 3}) + "\n")
    with pytest.raises(RecordError, match="schema 3 of a newer velap"):
        read_records(path)


def test_every_shipped_record_is_read_with_the_time_limit_of_its_task() -> None:
    root = Path(__file__).resolve().parents[1]
    files = read_all(root / SHIPPED_RECORDS) | read_all(root / "results/records-five-recipes")
    assert len(files) >= 82
    for path, records in files.items():
        assert {record.max_steps for record in records} == {TASKS[records[0].task].max_steps}, path


def test_a_second_writer_is_refused(tmp_path: Path) -> None:
    with RecordFile(tmp_path / "r.jsonl", KEY), pytest.raises(RecordError, match="another evaluation"):
        RecordFile(tmp_path / "r.jsonl", KEY)


def test_a_full_disk_leaves_no_half_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "r.jsonl"
    before = filled(path, 1)

    def no_space(descriptor: int) -> None:
        raise OSError(28, os.strerror(28))

    with RecordFile(path, KEY) as file:
        monkeypatch.setattr(os, "fsync", no_space)
        with pytest.raises(StorageError, match="the disk is full"):
            file.append(record(1))
    assert path.read_bytes() == before


def test_an_unwritable_place_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot write"):
        RecordFile(tmp_path / "file" / "r.jsonl", KEY)


def test_select_names_missing_seeds() -> None:
    records = [record(seed) for seed in (2, 0, 1)]
    assert [r.episode_seed for r in select(records, range(3))] == [0, 1, 2]
    with pytest.raises(RecordError, match=r"2 of 5 .*\[3, 4\]"):
        select(records, range(5))
