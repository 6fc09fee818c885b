"""Configs of older schemas: what was trained is kept, how it acts is today's, and what today cannot do is refused."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from velap.config import Config, ControllerConfig, EnsemblePhase, JointPhase, LatentPhase, PlannerConfig
from velap.errors import ConfigError
from velap.models.checkpoint import load_checkpoint, released_checkpoint
from velap.tasks import make_config

REPOSITORY = Path(__file__).resolve().parents[1]
GOLDEN = json.loads((REPOSITORY / "tests/golden/checkpoints.json").read_text())
"""Of the checkpoints that velap 0.1 released, by task: among other things `config`, every field of schema 1."""
FORMER_PLANNER = {"n_iter": 1000, "n_sim": 10, "candidates": 50, "discard_high_exponent": 2.0, "discard_low_exponent": 20.0,
                  "neighbour_exponent": 3.0, "goal_exponent": 5.0, "p_sparse": 0.9, "p_value": 0.1, "p_policy": 0.1,
                  "expansion_weight": 1.0, "coherent_noise": True, "anchor": "snap"}
FORMER_CONTROLLER = {"n_replan": 25, "stop_exponent": 250.0, "waypoint_exponent": 3.0, "lookahead": 3, "lookahead_gain": 2.0,
                     "shortcut_exponent": 12.0, "residuals": 40, "goal_lookahead": 3, "success_rollout": 150,
                     "success_exponent": 30.0, "revisit_penalty": 8.0}


def saved_config(task: str) -> dict[str, Any]:
    return copy.deepcopy(GOLDEN[task]["config"])  # type: ignore[no-any-return]


def read(raw: dict[str, Any]) -> Config:
    return Config.from_json(json.dumps(raw))


def schema_2(preset: str = "default") -> dict[str, Any]:
    """A file of schema 2 with every mechanism that is gone."""
    whole = make_config("DrawerButton", preset).to_dict()
    if preset == "default":
        whole |= {"planner": FORMER_PLANNER, "controller": FORMER_CONTROLLER}
        ensemble = {**next(phase for phase in whole["train"]["phases"] if phase["phase"] == "ensemble"), "hold": 1}
        clone = {**next(phase for phase in whole["train"]["phases"] if phase["phase"] == "clone"), "reach": 25}
        others = [phase for phase in whole["train"]["phases"] if phase["phase"] not in ("ensemble", "clone")]
        whole["train"]["phases"] = [*others, ensemble, {**ensemble, "hold": 5, "members": 3}, clone]
    else:
        del whole["planner"]["provenance"]
        whole["controller"] |= {name: 0 for name in FORMER_CONTROLLER if name not in whole["controller"]}
    return {**whole, "schema": 2}


@pytest.mark.parametrize("task", GOLDEN)
def test_configs_of_velap_01_keep_their_training_and_act_as_today(task: str) -> None:
    raw = saved_config(task)
    config = read(raw)
    assert (config.task, config.train.discount, config.model.frame_stack) == (task, 0.96, raw["model"]["frame_stack"])
    assert (config.planner, config.controller) == (PlannerConfig(), ControllerConfig())
    assert config.train.clones == raw["model"]["success_policy"]
    latent = [phase.steps for phase in config.train.phases if isinstance(phase, LatentPhase)]
    assert latent == [raw["train"]["latent_steps"]]
    assert Config.from_json(config.to_json()) == config


@pytest.mark.parametrize("task", GOLDEN)
def test_released_checkpoints_have_the_config_of_their_task(task: str) -> None:
    assert load_checkpoint(released_checkpoint(task))[1] == make_config(task)


def test_a_file_of_schema_2_loses_what_only_acted() -> None:
    config = read(schema_2())
    assert config == make_config("DrawerButton")
    assert sum(isinstance(phase, EnsemblePhase) for phase in config.train.phases) == 1, "the held policy's members went too"


def test_a_default_file_of_schema_3_acts_as_today() -> None:
    whole = make_config("DrawerButton").to_dict()
    whole["planner"] |= {"provenance": True, "p_sparse": 0.9, "p_value": 0.1}
    whole["controller"] |= {"lookahead": 3, "lookahead_gain": 2.0}
    assert read({**whole, "schema": 3}) == make_config("DrawerButton")
    with pytest.raises(ConfigError, match="schema 3"):
        read({**whole, "schema": 3, "train": {}})


def test_the_paper_preset_keeps_its_planner_and_controller() -> None:
    raw = schema_2("paper")
    assert read(raw) == make_config("DrawerButton", "paper")
    raw["planner"]["n_iter"], raw["controller"]["n_replan"] = 77, 9
    changed = read(raw)
    assert (changed.planner.n_iter, changed.controller.n_replan, changed.planner.provenance) == (77, 9, False)


@pytest.mark.parametrize("change", [{"train": {}}, {"train": {"phases": [4]}}, {"planner": None, "preset": "paper"}])
def test_broken_files_of_schema_2_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"schema 2|lacks|expected"):
        read({**schema_2(), **change})


@pytest.mark.parametrize(("part", "field", "value"), [
    ("model", "n_ens", 5), ("model", "policy_dense", [64]), ("model", "command_memory", 0.5), ("train", "shift", 2),
    ("train", "precision", "float32"), ("train", "value_transitions", 7), ("train", "policy_relative", True),
    ("model", "success_policy", True),
])
def test_what_today_cannot_do_is_refused_with_the_way_out(part: str, field: str, value: object) -> None:
    old = saved_config("SpiralMaze")
    old[part][field] = value
    with pytest.raises(ConfigError, match=rf"velap 0\.1 with `{part}\.{field}.*train again"):
        read(old)


def test_unknown_fields_of_old_files_are_refused() -> None:
    old = saved_config("SpiralMaze")
    with pytest.raises(ConfigError, match=r"`config\.train` has unknown fields \['momentum'\]"):
        read({**old, "train": {**old["train"], "momentum": 0.9}})
    with pytest.raises(ConfigError, match="expected the parts"):
        read({"task": "t", "preset": "default"})


def test_an_old_file_without_joint_phase_has_none() -> None:
    config = read(saved_config("WindowClose"))
    assert not any(isinstance(phase, JointPhase) for phase in config.train.phases)
