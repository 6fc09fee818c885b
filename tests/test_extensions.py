"""What a stranger adds from outside the package, in a file of some thirty lines each: a task, an encoder, a planner and a
baseline.

The task comes from an installed package's entry point, as every package with a `velap.tasks` group; the others from modules
that were imported. Each one is trained with and evaluated.
"""

from __future__ import annotations

import importlib
import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import velap
from velap.cli import main
from velap.errors import UnknownTaskError
from velap.evaluation.records import read_records
from velap.models.checkpoint import load_checkpoint
from velap.registry import ENCODERS, METHODS, PLANNERS, TASKS
from velap.runs import load_tensors
from velap.tasks import get_task

EXTENSIONS = Path(__file__).with_name("extensions")
QUICK = ["train.joint.steps=3", "train.latent.steps=3", "train.joint.windows=4", "train.joint.window=5",
         "model.frame_stack=1", "train.log_every=1", "planner.n_iter=20", "model.bank_size=20"]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder in which the stranger's task is installed, its dataset collected and its joint model trained."""
    root = tmp_path_factory.mktemp("stranger")
    info = root / "site" / "reach-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: reach\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[velap.tasks]\nReach = reach_task:TASK\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(root)
        patch.setenv("MINARI_DATASETS_PATH", str(root / "data"))
        patch.setenv("PYTHONPATH", os.pathsep.join([str(EXTENSIONS), os.environ.get("PYTHONPATH", "")]))
        for folder in (EXTENSIONS, root / "site"):
            patch.syspath_prepend(folder)
        velap.make_dataset("Reach", workers=1)
        assert main(["train", "Reach", "--set", *QUICK]) == 0
        yield root
        TASKS.pop("Reach")


def checkpoint(run: Path) -> Path:
    return run / "runs/Reach/default/seed0/model.safetensors"


def evaluate(run: Path, method: str, *options: str, of: Path | None = None) -> Path:
    """The record file of two validation episodes from the command line, of the joint checkpoint or another one."""
    command = ["evaluate", "Reach", "--checkpoint", str(of or checkpoint(run)), "--method", method, "--episodes", "2",
               "--first-seed", "1000", "--records", str(run / "records"), "--fresh", *options]
    assert main(command) == 0
    return run / f"records/Reach/{method}-default/train0.jsonl"


def test_a_task_of_an_installed_package_is_collected_trained_and_evaluated(run: Path) -> None:
    assert "Reach" in list(TASKS) and get_task("Reach").max_steps == 40
    assert load_tensors(checkpoint(run))[1]["dataset_id"] == "velap/Reach-v0"
    records = read_records(evaluate(run, "td3bc"))
    assert [record.episode_seed for record in records] == [1000, 1001]
    assert {record.env for record in records} == {"reach_task:Reach-v0"}
    assert all(record.steps == 40 or record.success for record in records)
    with pytest.raises(UnknownTaskError, match=r"unknown task 'Reich'; expected one of SpiralMaze, .*, Reach"):
        get_task("Reich")


def test_an_encoder_of_frozen_features_is_trained_with_and_evaluated(run: Path) -> None:
    module = importlib.import_module("random_encoder")
    assert main(["train", "Reach", "--out", "random", "--set", "model.encoder=random-features", *QUICK]) == 0
    model, config, _ = load_checkpoint(run / "random/model.safetensors")
    assert config.model.encoder == "random-features"
    assert isinstance(model.encoder, module.RandomFeatures)
    drawn = module.RandomFeatures(config.model, (64, 64)).weight
    torch.testing.assert_close(model.encoder.weight, drawn)
    records = read_records(evaluate(run, "velap", of=run / "random/model.safetensors"))
    assert len(records) == 2 and all(record.steps == 40 or record.success for record in records)
    ENCODERS.pop("random-features")
    with pytest.raises(UnknownTaskError, match="unknown encoder 'random-features'; expected one of "):
        load_checkpoint(run / "random/model.safetensors")


def test_a_planner_is_used_by_velap_and_named_in_its_hash(run: Path) -> None:
    own = read_records(evaluate(run, "velap"))
    importlib.import_module("greedy_planner")
    assert list(PLANNERS) == ["est", "greedy"]
    other = read_records(evaluate(run, "velap", "--set", "velap.planner=greedy"))
    assert all(len(record.plan_ms) > 0 for record in (*own, *other))
    assert other[0].config_hash != own[0].config_hash
    assert np.mean([record.plan_ms for record in other]) < np.mean([record.plan_ms for record in own])


def test_a_baseline_learns_its_head_and_acts(run: Path) -> None:
    importlib.import_module("linear_baseline")
    assert main(["train", "Reach", "--method", "linear", "--set", "head.steps=150", *QUICK]) == 0
    tensors, metadata = load_tensors(checkpoint(run).with_name("linear.safetensors"))
    assert tensors["linear.weight"].shape[0] == 2
    assert metadata["steps"] == "150"
    (record, _) = read_records(evaluate(run, "linear"))
    assert record.method == "linear"
    agent = velap.load(checkpoint(run), "linear")
    assert agent.act(np.zeros((3, 1, 64, 64, 3), np.uint8)).shape == (3, 2)
    METHODS.pop("linear")
