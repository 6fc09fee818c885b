"""Files of velap 0.1 (schema 1): configs are read, and old hashes recognised, whatever today's defaults are."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from safetensors import safe_open
from velap.config.migrate_v1 import legacy_json, legacy_shared_json, to_v1

from velap.config import Config, EnsemblePhase, JointPhase, legacy_hash, override
from velap.errors import ConfigError
from velap.evaluation.records import read_records
from velap.methods.base import get_method
from velap.models.checkpoint import WEIGHTS_SHA256, load_checkpoint
from velap.tasks import make_config

REPOSITORY = Path(__file__).resolve().parents[1]
CHECKPOINTS = sorted((REPOSITORY / "checkpoints").glob("*.safetensors"))
RECORDS = sorted((REPOSITORY / "results" / "records").rglob("*.jsonl"))


def saved_config(path: Path) -> str:
    with safe_open(str(path), framework="pt") as file:
        return str(file.metadata()["config"])


@pytest.mark.parametrize("path", CHECKPOINTS, ids=lambda path: path.stem)
def test_released_checkpoints_are_of_todays_presets(path: Path) -> None:
    text = saved_config(path)
    _, config, metadata = load_checkpoint(path)
    assert config == make_config(path.stem), "today's default preset"
    if "schema" not in json.loads(text):
        assert legacy_json(config) == text, "to the letter"
    records = read_records(REPOSITORY / "results" / "records" / path.stem / "velap-default" / "train0.jsonl")
    hashes = {config.hash(), legacy_hash(config)}
    assert {record.config_hash for record in records} <= hashes
    assert {record.checkpoint for record in records} == {metadata[WEIGHTS_SHA256]}


def test_every_committed_record_is_recognised() -> None:
    """Its hash is today's or that of velap 0.1 for the same preset; heads' hashes hold weights that are not kept here."""
    assert len(RECORDS) > 50
    checked = 0
    for path in RECORDS:
        for key in {(r.task, r.method, r.preset, r.config_hash) for r in read_records(path)}:
            task, method, preset, found = key
            kind, config = get_method(method), make_config(task, preset)
            if kind.learns:
                assert legacy_shared_json(config) is not None, path
                continue
            assert found in {kind.config_hash(config), kind.legacy_hash(config)}, path
            checked += 1
    assert checked > 20


@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize("task", ["DrawerButton", "ObstacleMaze", "someone/elses-v0"])
def test_a_config_and_its_schema_1_form_are_the_same(task: str, preset: str) -> None:
    config = make_config(task, preset)
    text = legacy_json(config)
    assert text is not None and Config.from_json(text) == config
    changed = override(config, planner={"n_iter": 33}, train={"c0": 0.7})
    again = legacy_json(changed)
    assert again is not None and Config.from_json(again) == changed
    assert legacy_hash(changed) != legacy_hash(config)


def test_known_hashes() -> None:
    assert legacy_hash(make_config("SpiralMaze")) == "3894728bad15", "what results/records/SpiralMaze holds"
    assert legacy_hash(make_config("SpiralMaze", "paper")) == "5f3372247244"


def test_fields_that_were_left_out_have_the_defaults_of_then(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new default of today must not change what an old file is."""
    text = saved_config(REPOSITORY / "checkpoints" / "SpiralMaze.safetensors")
    if "schema" in json.loads(text):
        pytest.skip("the released file has been written anew")
    before = Config.from_json(text)
    monkeypatch.setattr(EnsemblePhase, "noise", 0.1)
    monkeypatch.setattr("velap.config.training.TrainConfig.target_rate", 0.9)
    assert Config.from_json(text) == before


@pytest.mark.parametrize(("part", "field", "value"), [
    ("model", "n_ens", 5), ("model", "policy_dense", [64]), ("model", "command_memory", 0.5), ("train", "shift", 2),
    ("train", "precision", "float32"), ("train", "value_transitions", 7), ("train", "policy_relative", True),
    ("planner", "rehearsals", 3), ("controller", "held_turn", 4),
])
def test_what_today_cannot_do_is_refused_with_the_way_out(part: str, field: str, value: object) -> None:
    old = json.loads(json.dumps({"task": "SpiralMaze", "preset": "default", **(to_v1(make_config("SpiralMaze")) or {})}))
    assert Config.from_json(json.dumps(old)) == make_config("SpiralMaze")
    old[part][field] = value
    with pytest.raises(ConfigError, match=rf"velap 0\.1 with `{part}\.{field}.*train again"):
        Config.from_json(json.dumps(old))


def test_what_schema_1_could_not_say_has_no_old_hash() -> None:
    two_shares = override(make_config("ObstacleMaze"), train={"values": {"rewarded_share": 0.5}})
    assert legacy_hash(two_shares) is None
    assert legacy_hash(override(make_config("SpiralMaze"), model={"encoder": "mine"})) is None


def test_unknown_fields_of_old_files_are_refused() -> None:
    old = {"task": "SpiralMaze", "preset": "default", **(to_v1(make_config("SpiralMaze")) or {})}
    with pytest.raises(ConfigError, match=r"`config\.train` has unknown fields \['momentum'\]"):
        Config.from_json(json.dumps({**old, "train": {**old["train"], "momentum": 0.9}}))
    with pytest.raises(ConfigError, match="expected the parts"):
        Config.from_json('{"task": "t", "preset": "default"}')


def test_the_effect_of_an_old_file_without_joint_phase_is_that_it_has_none() -> None:
    config = Config.from_json(saved_config(REPOSITORY / "checkpoints" / "WindowClose.safetensors"))
    assert not any(isinstance(phase, JointPhase) for phase in config.train.phases)
