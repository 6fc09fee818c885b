"""Heads as files and as trainings: what is loaded, refused, resumed, replaced, and what the command line says."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest
import torch

from latent_data import SMALL, joint_checkpoint, metadata_of, noise_store
from velap import api, cli
from velap.errors import CheckpointError, ConfigError, DatasetError, TrainingError, UnknownTaskError
from velap.methods import learning
from velap.methods.base import get_method, learning_methods
from velap.methods.heads import head_path, load_head, make_head, save_head
from velap.methods.learning import train_head
from velap.registry import METHODS
from velap.runs import load_tensors
from velap.training import frozen
from velap.training.steps import Cadence, Progress

STORE = noise_store(successes=10)


@pytest.fixture
def checkpoint(tmp_path: Path) -> Path:
    return joint_checkpoint(tmp_path / "model.safetensors", STORE)


def weights(path: Path) -> dict[str, torch.Tensor]:
    return load_tensors(path)[0]


def same(one: Path, other: Path) -> bool:
    mine, others = weights(one), weights(other)
    return mine.keys() == others.keys() and all(torch.equal(mine[name], others[name]) for name in mine)


def test_every_head_has_a_learner_with_a_config() -> None:
    assert learning_methods() == ["bc", "bc-success", "iql", "iql-sparse", "iris", "iris-multistep"]
    for name in METHODS:
        method = get_method(name)
        assert {method.learns} == {part is not None for part in (method.learner, method.learning, method.paper_learning)}


@pytest.mark.parametrize("method", learning_methods())
@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_a_head_comes_back_as_it_was_trained(tmp_path: Path, method: str, norm: str) -> None:
    checkpoint = joint_checkpoint(tmp_path / "model.safetensors", STORE, norm=norm)
    seen: list[Progress] = []
    result = train_head(method, checkpoint, STORE, steps=4, command="typed", on_progress=seen.append)
    assert result.path == head_path(checkpoint, method) == tmp_path / f"{method}.safetensors"
    assert (seen[-1].phase, seen[-1].step, seen[-1].total) == (method, 4, 4)
    assert all(name.startswith("held_out/") for name in result.diagnostics)
    assert result.diagnostics
    head = load_head(result.path, metadata_of(checkpoint))
    assert not head.training
    assert head.method == method
    assert json.loads(head.settings) == dataclasses.asdict(get_method(method).learner_config("default", {"steps": 4}))
    metadata = load_tensors(result.path)[1]
    assert (metadata["seed"], metadata["dataset_hash"], metadata["command"]) == ("0", "hash10", "typed")
    assert metadata["weights_sha256"] == head.weights_sha256
    for shape in ((3, 2), (2, 5, 2)):
        latent = torch.randn(shape)
        goal = (latent,) if method.startswith("iris") else ()
        action = head.act(latent, *goal)  # type: ignore[call-arg]
        assert action.shape == (*shape[:-1], 3)
        assert action.abs().max() <= 1


def test_a_head_of_other_joint_weights_is_refused(tmp_path: Path, checkpoint: Path) -> None:
    path = train_head("bc", checkpoint, STORE, steps=2).path
    other = joint_checkpoint(tmp_path / "other" / "model.safetensors", STORE, seed=1)
    with pytest.raises(CheckpointError, match=r"bc.safetensors is foreign to this joint checkpoint.*--method bc"):
        load_head(path, metadata_of(other))


def test_what_is_no_head_is_refused(tmp_path: Path, checkpoint: Path) -> None:
    metadata = metadata_of(checkpoint)
    with pytest.raises(CheckpointError, match=r"no head at .*iql.safetensors; .*`velap train TASK --method iql`"):
        load_head(tmp_path / "iql.safetensors", metadata)
    with pytest.raises(CheckpointError, match="has format 'velap-latent-model/1'"):
        load_head(checkpoint, metadata)
    head = make_head("bc", SMALL, 3)
    head.method = "ppo"
    save_head(tmp_path / "ppo.safetensors", head, metadata, {})
    with pytest.raises(CheckpointError, match="method 'ppo'; expected 'velap-head/1' and one of bc, "):
        load_head(tmp_path / "ppo.safetensors", metadata)
    head.method = "iris"
    save_head(tmp_path / "iris.safetensors", head, metadata, {})
    with pytest.raises(CheckpointError, match="does not fit its own config"):
        load_head(tmp_path / "iris.safetensors", metadata)


def test_damage_is_noticed(checkpoint: Path) -> None:
    path = train_head("bc", checkpoint, STORE, steps=2).path
    content = bytearray(path.read_bytes())
    content[-10] ^= 1
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="damaged"):
        load_head(path, metadata_of(checkpoint))
    with pytest.warns(UserWarning, match="learnt anew: .* is damaged"):
        train_head("bc", checkpoint, STORE, steps=2)
    load_head(path, metadata_of(checkpoint))


@pytest.mark.parametrize("method", ["bc", "iql", "iris"])
def test_an_interrupted_training_goes_on_to_the_same_bits(
        tmp_path: Path, checkpoint: Path, method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = train_head(method, checkpoint, STORE, tmp_path / "whole.safetensors", steps=8).path
    monkeypatch.setattr(learning, "CADENCE", Cadence(2, 4, 3))

    def stop(progress: Progress) -> None:
        if progress.step == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_head(method, checkpoint, STORE, steps=8, on_progress=stop)
    state = tmp_path / f"{method}.state.safetensors"
    assert load_tensors(state)[1]["step"] == "3", "killed at step 6, the state is of step 3"
    steps: list[int] = []
    resumed = train_head(method, checkpoint, STORE, steps=8, on_progress=lambda progress: steps.append(progress.step))
    assert steps[0] == 4
    assert same(whole, resumed.path)
    assert not state.exists()
    lines = resumed.path.with_suffix(".metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["step"] for line in lines] == [2, 4, 6, 8]


def test_a_state_of_other_settings_is_not_gone_on_from(tmp_path: Path, checkpoint: Path, monkeypatch: Any) -> None:
    fresh = train_head("bc", checkpoint, STORE, tmp_path / "fresh.safetensors", steps=6).path
    monkeypatch.setattr(learning, "CADENCE", Cadence(2, 4, 3))
    learner = get_method("bc").learner_config("default", {"steps": 8, "batch": 16})

    def stop(progress: Progress) -> None:
        if progress.step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_head("bc", checkpoint, STORE, config=learner, on_progress=stop)
    with pytest.warns(UserWarning, match="learnt from the start: .* another head_config"):
        path = train_head("bc", checkpoint, STORE, steps=6).path
    assert same(fresh, path)


def test_a_finished_head_is_kept_and_a_stale_one_replaced(checkpoint: Path) -> None:
    first = train_head("bc", checkpoint, STORE, steps=3)
    content = first.path.read_bytes()
    assert train_head("bc", checkpoint, STORE, steps=3) == first
    assert first.path.read_bytes() == content
    with pytest.warns(UserWarning, match="learnt with another head_config and is replaced"):
        train_head("bc", checkpoint, STORE, steps=4)
    joint_checkpoint(checkpoint, STORE, seed=5)
    with pytest.warns(UserWarning, match="another joint, seed and is replaced"):
        train_head("bc", checkpoint, STORE, steps=4)
    load_head(first.path, metadata_of(checkpoint))


def test_the_seed_decides_the_weights(tmp_path: Path, checkpoint: Path) -> None:
    paths = [train_head("bc", checkpoint, STORE, tmp_path / f"{i}.safetensors", steps=3, seed=seed).path
             for i, seed in enumerate((1, 1, 2))]
    assert same(paths[0], paths[1])
    assert not same(paths[0], paths[2])


def test_latents_are_encoded_once(checkpoint: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    encode = frozen.encode_all
    monkeypatch.setattr(frozen, "encode_all", lambda *args: (calls.append(1), encode(*args))[1])
    train_head("bc", checkpoint, STORE, steps=1)
    train_head("iql", checkpoint, STORE, steps=1)
    assert len(calls) == 1
    joint_checkpoint(checkpoint, STORE, seed=1)
    train_head("iris", checkpoint, STORE, steps=1)
    assert len(calls) == 2, "other weights, other latents"


def test_the_joint_preset_chooses_the_learner(tmp_path: Path) -> None:
    checkpoint = joint_checkpoint(tmp_path / "model.safetensors", STORE, preset="paper")
    settings = json.loads(load_tensors(train_head("bc", checkpoint, STORE, steps=2).path)[1]["head_config"])
    assert settings == {"steps": 2, "batch": 128, "learning_rate": 3e-4, "cosine": False, "passes": 0}


def test_unknown_methods_and_fields_are_named(checkpoint: Path) -> None:
    with pytest.raises(UnknownTaskError, match="the method 'td3bc' has no learner of its own; expected one of bc, "):
        train_head("td3bc", checkpoint, STORE)
    with pytest.raises(UnknownTaskError, match="unknown method 'ppo'; expected one of bc, "):
        api.train("SpiralMaze", method="ppo")
    with pytest.raises(ConfigError, match=r"the learner of 'bc' has no field \['expectile'\]; expected some of \['steps'"):
        get_method("bc").learner_config("default", {"expectile": 0.9})


def test_another_dataset_is_refused(checkpoint: Path) -> None:
    with pytest.raises(DatasetError, match="trained on a dataset with hash hash10, test/noise-v0 has hash3"):
        train_head("bc", checkpoint, noise_store(successes=3))


def test_a_dataset_without_success_is_refused(tmp_path: Path) -> None:
    store = noise_store(successes=0)
    checkpoint = joint_checkpoint(tmp_path / "model.safetensors", store)
    with pytest.raises(DatasetError, match="no successful episode"):
        train_head("bc-success", checkpoint, store)


@pytest.mark.parametrize("method", ["bc", "iql", "iris"])
def test_a_loss_that_is_not_a_number_stops_the_training(checkpoint: Path, method: str) -> None:
    store = noise_store(successes=10)
    store.actions[::3] = float("nan")
    with pytest.raises(TrainingError, match=r"became NaN or infinite at step 5; .* no state is kept yet"):
        train_head(method, checkpoint, store, steps=5)
    assert not head_path(checkpoint, method).exists()


def test_the_command_line_trains_a_head_beside_the_joint_checkpoint(
        checkpoint: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("velap.data.loading.load_store", lambda *args, **kwargs: STORE)
    folder = str(checkpoint.parent)
    command = ["train", "--dataset", "test", "--out", folder, "--method", "iql", "--set", "head.steps=3"]
    assert cli.main(command) == 0
    out = capsys.readouterr().out
    assert "training, iql: 3 of 3" in out
    assert "iql.safetensors: 3 updates in" in out
    assert "held_out/value" in out
    assert cli.main([*command, "head.nothing=1"]) == 2
    assert "no field ['nothing']" in capsys.readouterr().err
    assert cli.main([*command, "--seed", "4"]) == 2
    assert "task, preset and seed ('test', 'default', 0); expected ('test', 'default', 4)" in capsys.readouterr().err
    assert cli.main([*command, "train.joint.c1=0.5"]) == 2
    assert "trained with other values of some of train.joint" in capsys.readouterr().err
    assert cli.main(["train", "--dataset", "test", "--out", folder, "--method", "mppi"]) == 0, "nothing more to learn"
    assert cli.main(["train", "SpiralMaze", "--method", "random"]) == 2
    assert "'random': it has nothing to learn" in capsys.readouterr().err
    assert cli.main(["train", "--dataset", "test", "--out", folder, "--set", "head.steps=3"]) == 2
    assert "PART.FIELD=VALUE" in capsys.readouterr().err


def test_the_joint_training_comes_first_where_it_is_missing(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("velap.data.loading.load_store", lambda *args, **kwargs: STORE)
    quick = ["train.joint.steps=2", "train.latent.steps=2", "train.joint.windows=2", "train.joint.window=5",
             "model.encoder=tiny", "model.frame_stack=1", "head.steps=2", "train.log_every=1"]
    folder = tmp_path / "run"
    assert cli.main(["train", "--dataset", "test", "--out", str(folder), "--method", "iris", "--set", *quick]) == 0
    captured = capsys.readouterr()
    assert f"note: no joint checkpoint in {folder}; it is trained first" in captured.err
    assert "training, latent: 4 of 4" in captured.out
    assert "training, iris: 2 of 2" in captured.out
    assert (folder / "model.safetensors").exists()
    assert (folder / "iris.safetensors").exists()
