"""`velap evaluate --method M`: heads found or named, clear refusals, and records that never mix."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from velap import cli
from velap.config import override
from velap.evaluation.records import read_records
from velap.methods.base import learning_methods
from velap.methods.heads import make_head, save_head
from velap.methods.iris import SubgoalHead
from velap.models.checkpoint import load_checkpoint, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.tasks import make_config

QUICK = ("samples=8", "horizon=6", "elites=2", "iterations=1")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of these tests go into a temporary folder."""
    monkeypatch.chdir(tmp_path)


def make_run(folder: Path, seed: int = 0) -> Path:
    """A joint checkpoint with random weights and a BC and an IRIS head beside it."""
    config = override(make_config("SpiralMaze"), planner={"n_iter": 4, "candidates": 2},
                      model={"bank_size": 8, "frame_stack": 1})
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = LatentModel(config.model, Spaces(64, 64, (-1.0,) * 2, (1.0,) * 2), config.train.discount)
        save_checkpoint(folder / "model.safetensors", model, config, {"seed": str(seed)})
        for method in ("bc", "iris"):
            make_head_beside(folder / "model.safetensors", method)
    return folder / "model.safetensors"


def make_head_beside(checkpoint: Path, method: str) -> None:
    _, config, metadata = load_checkpoint(checkpoint)
    head = make_head(method, config.model, 2)
    if isinstance(head, SubgoalHead):
        head.steps_ahead.fill_(2)
    save_head(checkpoint.with_name(f"{method}.safetensors"), head, metadata, {"seed": "0"})


def evaluate(*arguments: object) -> int:
    command = ["evaluate", "SpiralMaze", "--max-steps", "3", "--episodes", "1", "--device", "cpu"]
    return cli.main([*command, *map(str, arguments)])


def records_of(method: str) -> Path:
    return Path(f"runs/records/SpiralMaze/{method}-default/train0.jsonl")


def test_the_head_beside_the_checkpoint_is_found_or_named(tmp_path: Path) -> None:
    checkpoint = make_run(tmp_path / "run")
    assert evaluate("--method", "bc", "--checkpoint", checkpoint) == 0
    assert evaluate("--method", "iris", "--checkpoint", checkpoint) == 0
    (record,) = read_records(records_of("iris"))
    assert (record.method, len(record.plan_ms)) == ("iris", 2), "planned at the steps 0 and 2 of 3"
    head = checkpoint.with_name("bc.safetensors").rename(tmp_path / "elsewhere.safetensors")
    assert evaluate("--method", "bc", "--checkpoint", checkpoint, "--head", head) == 0
    assert len(read_records(records_of("bc"))) == 1, "the same head: the episode is recorded already"


@pytest.mark.parametrize("method", ["mppi", "mbop"])
def test_planning_settings_are_part_of_the_config_hash(tmp_path: Path, method: str,
                                                       capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = make_run(tmp_path / "run")
    quick = ["--set", *(f"{method}.{setting}" for setting in QUICK)]
    assert evaluate("--method", method, "--checkpoint", checkpoint, *quick) == 0
    assert evaluate("--method", method, "--checkpoint", checkpoint, *quick, f"{method}.temperature=2") == 2
    assert "`config_hash` is" in capsys.readouterr().err
    assert len(read_records(records_of(method))) == 1


def test_records_of_one_head_refuse_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = make_run(tmp_path / "run")
    assert evaluate("--method", "bc", "--checkpoint", checkpoint) == 0
    torch.manual_seed(1)
    make_head_beside(checkpoint, "bc")
    assert evaluate("--method", "bc", "--checkpoint", checkpoint) == 2
    assert "`config_hash` is" in capsys.readouterr().err


@pytest.mark.parametrize("method", learning_methods())
def test_a_missing_head_says_how_to_train_it(tmp_path: Path, method: str, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = make_run(tmp_path / "run")
    checkpoint.with_name(f"{method}.safetensors").unlink(missing_ok=True)
    assert evaluate("--method", method, "--checkpoint", checkpoint) == 2
    message = capsys.readouterr().err
    assert f"no head at {checkpoint.with_name(method)}.safetensors" in message
    assert f"velap train TASK --method {method}" in message
    assert message.count("\n") == 1
    assert not records_of(method).exists()


def test_wrong_heads_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint, other = make_run(tmp_path / "run"), make_run(tmp_path / "other", seed=1)
    cases = [
        (["--method", "bc", "--head", other.with_name("bc.safetensors")], "foreign"),
        (["--method", "iql", "--head", checkpoint.with_name("bc.safetensors")], "got one of 'bc'"),
        (["--method", "bc", "--head", checkpoint], "expected 'velap-head/1'"),
        (["--method", "velap", "--head", checkpoint.with_name("bc.safetensors")], "'velap' learns no head"),
        (["--method", "mppi", "--set", "mbop.beta=0.5"], "parts are model, train, planner, controller, mppi"),
        (["--method", "mppi", "--set", "mppi.beta=0.5"], "'mppi' has no field ['beta']"),
        (["--method", "mbop", "--set", "mbop.beta=1.5"], "MBOP field `beta` is 1.5"),
    ]
    for arguments, text in cases:
        assert evaluate("--checkpoint", checkpoint, *arguments) == 2, arguments
        assert text in capsys.readouterr().err
    assert list(Path().rglob("*.jsonl")) == []
