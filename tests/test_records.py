"""Record files: append, resume, kill -9 in the middle of a line, damage, foreign runs, two writers, a full disk."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from velap.errors import RecordError, StorageError
from velap.evaluation.records import Record, RecordFile, RunKey, read_records, select

KEY = RunKey("Maze", "velap", "default", 0, "velap/Maze-v0", "abc", "c0ffee", "0.1.0")


def record(seed: int, success: bool = True, steps: int = 10) -> Record:
    return Record(**vars(KEY), episode_seed=seed, success=success, steps=steps, truncated=not success, plan_ms=(1.5, 2.25))


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


@pytest.mark.parametrize("field", ["config_hash", "checkpoint", "env"])
def test_records_of_another_run_are_not_mixed(tmp_path: Path, field: str) -> None:
    path = tmp_path / "r.jsonl"
    old = filled(path, 2)
    other = dataclasses.replace(KEY, **{field: "other"})
    with pytest.raises(RecordError, match=rf"`{field}` is .* there and 'other' here\. Give --fresh"):
        RecordFile(path, other)
    for number in (1, 2):
        with RecordFile(path, other, fresh=True) as file:
            assert file.done == set()
            file.append(dataclasses.replace(record(0), **{field: "other"}))
        assert (tmp_path / f"r.jsonl.old-{number}").exists()
    assert (tmp_path / "r.jsonl.old-1").read_bytes() == old


def test_another_code_version_may_go_on(tmp_path: Path) -> None:
    filled(tmp_path / "r.jsonl", 1)
    with RecordFile(tmp_path / "r.jsonl", dataclasses.replace(KEY, code_version="0.1.1")) as file:
        assert file.done == {0}


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
