"""A small version of `velap study faults`: every spoilt file and wrong command, two kills of training, one full disk."""

from __future__ import annotations

import contextlib
import io
import re
import resource
import shutil
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from studies.faults import cases, kills, study
from studies.faults.cases import CASES, Case, CaseResult, changes, check, judge, listing, message_of
from studies.faults.kills import KillReport, Victim, fingerprint, kill_and_resume, leftovers, unreadable
from studies.faults.study import DISK_CASES, DiskCase, check_disk, report
from velap import cli
from velap.errors import VelapError
from velap.runs import load_tensors, save_tensors
from velap.tasks import TASKS


@pytest.fixture(scope="module", autouse=True)
def shrunk() -> Iterator[None]:
    """SpiralMaze with little data and little training in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(TASKS, kills.TASK, TASKS[kills.TASK])
        kills.shrink()
        yield


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An intact dataset and run."""
    folder, threads = tmp_path_factory.mktemp("base"), torch.get_num_threads()
    torch.set_num_threads(1)  # as the processes that are killed have: another number gives other bits
    for command in (["collect", "SpiralMaze"], ["train", "SpiralMaze", "--out", "run"]):
        code, stderr = run_here(command, folder)
        assert code == 0, stderr
    torch.set_num_threads(threads)
    return folder


def run_here(arguments: Sequence[str], place: Path, datasets: str = "datasets", limit: int | None = None) -> tuple[int, str]:
    """Exit code and stderr of `velap arguments`, in this process."""
    stderr, (soft, hard) = io.StringIO(), resource.getrlimit(resource.RLIMIT_FSIZE)
    quiet = contextlib.redirect_stdout(io.StringIO())
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stderr(stderr), quiet:
        patch.setenv("MINARI_DATASETS_PATH", str(place / datasets))
        patch.chdir(place)
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft if limit is None else limit, hard))
        try:
            code = cli.main(list(arguments))
        except SystemExit as exit_:
            code = int(exit_.code or 0)
        except Exception:
            traceback.print_exc()
            code = 1
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    return code, stderr.getvalue()


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.fault.replace(" ", "-"))
def test_a_fault_is_one_paragraph_and_leaves_nothing(case: Case, base: Path, tmp_path: Path) -> None:
    result = check(case, base, tmp_path / "case", run_here)
    assert result.problems == (), result.message


def test_killed_training_resumes_to_the_same_bits(base: Path, tmp_path: Path) -> None:
    train = ("train", "SpiralMaze", "--out", "run")
    done: list[int] = []
    victim = Victim(arguments=train, resume=(*train, "--resume"), datasets=base / "datasets", fsyncs=24)
    result = kill_and_resume(victim, tmp_path, 1, np.random.default_rng(5), done.append)
    assert result.problems == ()
    assert result.kills == 1
    assert result.fingerprint == fingerprint(base / "run"), "a process of its own trains to the bits of this one"
    assert done == [1]


@pytest.mark.parametrize("case", DISK_CASES, ids=lambda case: case.fault.replace(" ", "-"))
def test_a_full_disk_is_survived(case: DiskCase, base: Path, tmp_path: Path) -> None:
    result = check_disk(case, base, tmp_path / "case", run_here, mount=False)
    assert result.problems == (), result.message
    assert re.search("(cannot|could not) write", result.message)


# the judge itself


@pytest.mark.parametrize(("code", "stderr", "problems"), [
    (2, "velap: no. Do this.\n", []),
    (2, "note: resized\nvelap: no. Do this.\n", []),
    (2, "╭─ Parsing error ─╮\n│ no. Do this. │\n│ For full helptext, run velap --help │\n╰──╯\n", []),
    (0, "velap: no. Do this.\n", ["exit code 0"]),
    (-9, "velap: no. Do this.\n", ["exit code -9"]),
    (2, "velap: no.\nDo this.\n", ["2 lines instead of one paragraph"]),
    (2, "", ["0 lines instead of one paragraph", "the message lacks “Do this”"]),
    (1, "Traceback\nValueError: Do this\n", ["a traceback", "2 lines instead of one paragraph"]),
])
def test_the_judge_sees_what_is_wrong(code: int, stderr: str, problems: list[str]) -> None:
    assert judge(code, stderr, "Do this") == problems


def test_what_a_command_leaves_is_seen(tmp_path: Path) -> None:
    (tmp_path / "kept").write_text("a")
    (tmp_path / "gone").write_text("a")
    before = listing(tmp_path)
    (tmp_path / "kept").write_text("b")
    (tmp_path / "gone").unlink()
    (tmp_path / "run").mkdir()
    assert changes(before, listing(tmp_path)) == ["gone was deleted", "kept was changed", "run was made"]
    assert changes(before, before) == []


def test_unreadable_files_are_found(base: Path, tmp_path: Path) -> None:
    place = tmp_path / "copy"
    shutil.copytree(base, place)
    assert unreadable(place) == leftovers(place) == []
    cases.flip(place / "run" / "model.safetensors")
    cases.flip(place / cases.EPISODES)
    (place / "run" / "metrics.jsonl").write_text('{"step": 1}\n{"st')
    (place / "shard.npz").write_bytes(b"PK")
    (place / "run" / ".state.safetensors.1.tmp").write_bytes(b"")
    assert [line.split(" is ")[0] for line in unreadable(place)] == [
        "datasets/velap/SpiralMaze-v0/data/main_data.hdf5", "run/metrics.jsonl", "run/model.safetensors", "shard.npz"]
    assert leftovers(place) == ["run/.state.safetensors.1.tmp was left behind"]


def test_the_fingerprint_holds_weights_and_losses_but_no_times(base: Path, tmp_path: Path) -> None:
    place = tmp_path / "run"
    shutil.copytree(base / "run", place)
    before = fingerprint(place)
    tensors, metadata = load_tensors(place / "model.safetensors")
    save_tensors(place / "model.safetensors", tensors, {**metadata, "train_seconds": "1e9"})
    assert fingerprint(place) == before
    name = next(iter(tensors))
    save_tensors(place / "model.safetensors", {**tensors, name: tensors[name] + 1}, metadata)
    assert fingerprint(place) != before


def test_the_report_shows_commands_messages_and_problems() -> None:
    text = report("velap study faults", [KillReport(command="velap train", kills=20, problems=(), fingerprint="f")],
                  [CaseResult(fault="a | b", command="velap fly", message="m" * 1000, code=2, problems=()), CaseResult(
                      fault="bad",
                      command="velap x",
                      message="no",
                      code=0,
                      problems=("exit code 0",))])
    assert "`velap study faults --write docs/faults.md`" in text
    assert "| `velap train` | 20 | as it should be |" in text
    assert "| bad | `velap x` | no | 0 | exit code 0 |" in text
    assert f"| {'m' * (study.MESSAGE - 1)}… | 2 | as it should be |" in text


def test_a_study_with_problems_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(study, "_kill", lambda *arguments: [KillReport(
        command="velap train",
        kills=2,
        problems=("other bits",),
        fingerprint="f")])
    monkeypatch.setattr(study, "_spoil", lambda *arguments: [CaseResult(
        fault="disk full",
        command="velap train",
        message="no",
        code=2,
        problems=())])
    console = Console(record=True, file=io.StringIO())
    with pytest.raises(VelapError, match="1 problems in 2 faults"):
        study.study_faults(console, quick=True, seed=3, write=tmp_path / "faults.md")
    assert "velap train: other bits" in console.export_text()
    assert "velap study faults --quick --seed 3 --write" in (tmp_path / "faults.md").read_text()


def test_messages_lose_their_frame() -> None:
    assert message_of("note: x\n╭─ Error ───╮\n│ unknown --x │\n╰───────────╯\n") == "Error unknown --x"
