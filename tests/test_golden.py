"""What the code does is what it did when tests/golden was written: traces, losses, released checkpoints, old files."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import golden_access as velap
from velap.config import ControllerConfig, PlannerConfig

GOLDEN = Path(__file__).parent / "golden"
ACTION = 1e-4
"""Largest difference of an action [environment's action]: processors round differently."""
LOSS = 1e-2
"""Largest relative difference of a loss: batch statistics let the rounding of processors grow to 0.3 % in twenty updates."""


def read(name: str) -> dict[str, Any]:
    return json.loads((GOLDEN / f"{name}.json").read_text())


TRACES, LOSSES, CHECKPOINTS = read("traces"), read("losses"), read("checkpoints")
PHASES_THEN = {"encoder": "encoder", "joint": "joint", "latent": "latent", "values": "latent_value", "ensemble": "member",
               "clone": "clone"}
"""Phases, and what their updates were called in the config of then."""
every_task = pytest.mark.parametrize("task", CHECKPOINTS)


@every_task
def test_every_method_acts_as_before(task: str) -> None:
    assert set(TRACES[task]) == set(velap.ALL_METHODS)
    wrong = []
    with velap.pytorch_networks():
        for method, seeds in TRACES[task].items():
            for seed, actions in seeds.items():
                expected = np.array(actions)
                found = velap.trace(task, method, int(seed), len(expected), taken=expected)
                if found.shape != expected.shape:
                    wrong.append(f"{method}, seed {seed}: {found.shape} instead of {expected.shape}")
                elif (error := np.abs(found - expected).max(1)).max() > ACTION:
                    step = int(np.argmax(error > ACTION))
                    wrong.append(f"{method}, seed {seed}: from step {step} on, at most by {error.max():.3g}")
    assert wrong == []


def test_every_learner_has_its_losses_recorded() -> None:
    assert set(LOSSES) == set(velap.PHASES) | {f"head-{method}" for method in velap.HEADED}


@pytest.mark.parametrize("case", LOSSES)
def test_losses_are_as_before(case: str, tmp_path: Path) -> None:
    with velap.pytorch_networks():
        if case in velap.PHASES:
            seen, report = velap.phase_losses(case, tmp_path), None
        else:
            *seen, report = velap.head_losses(case.removeprefix("head-"), tmp_path)
    for update, expected in LOSSES[case].items():
        found = report if update == "report" else seen[int(update) - 1]
        assert found == pytest.approx(expected, rel=LOSS, abs=1e-5), f"update {update}"


@every_task
def test_released_checkpoints_are_what_they_were(task: str) -> None:
    facts, kept = velap.checkpoint_facts(task), CHECKPOINTS[task]
    then = kept["config"]
    assert facts.pop("frame_stack") == then["model"]["frame_stack"]
    encoders = {(0, False): "conv", (24, False): "slow-moments", (24, True): "moments"}
    assert facts.pop("encoder") == encoders[then["model"]["moment_colours"], then["model"]["keep_moments"]]
    steps = {label: then["train"][f"{name}_steps"] for label, name in PHASES_THEN.items()}
    assert facts.pop("phases") == {label: count for label, count in steps.items() if count}
    facts["parameters"] += velap.tensors_that_went(task)
    assert facts == {name: kept[name] for name in facts}


@every_task
def test_the_weights_hash_is_of_the_weights(task: str) -> None:
    computed, written = velap.hashes_of_content(task)
    assert computed == written == CHECKPOINTS[task]["weights_sha256"]


@every_task
def test_records_of_five_recipes_are_those_of_the_checkpoints_released_then(task: str) -> None:
    facts = CHECKPOINTS[task]["recorded"]
    hashes = {"velap": facts["weights_sha256"], "random": ""}
    for method, config_hash in CHECKPOINTS[task]["method_hashes"].items():
        expected = (config_hash, hashes.get(method, facts["shared_sha256"]))
        assert velap.record_identities(task, method) == {expected}, method


def test_a_run_of_several_phases_comes_to_the_weights_that_it_came_to(tmp_path: Path) -> None:
    with velap.pytorch_networks():
        found = velap.read_tensors(velap.train_old(tmp_path) / "model.safetensors")
    expected = velap.read_tensors(GOLDEN / "old/finished/model.safetensors")
    assert found.keys() - expected.keys() == {"bank_gap", "success_share", "arrival_rates"}
    shared = [name for name in expected if not name.startswith(("held_policy.", "success_policy."))]
    assert len(shared) > 50
    for name in shared:
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-3, atol=1e-4, err_msg=name)


def test_an_old_unfinished_run_is_refused_with_a_way_out_and_left_alone(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(GOLDEN / "old/unfinished", run)
    assert "start a new run elsewhere with --out" in velap.refusal_of_old(run)
    for path in (GOLDEN / "old/unfinished").iterdir():
        assert (run / path.name).read_bytes() == path.read_bytes(), path.name


def test_an_old_finished_run_is_read_with_its_head_and_records() -> None:
    old = GOLDEN / "old"
    for method in ("velap", "bc"):
        model, config = velap.load_old(old / "finished/model.safetensors", method)
        assert sum(value.numel() for value in model.state_dict().values()) > 1000
        assert (config.planner, config.controller) == (PlannerConfig(), ControllerConfig())
        assert config.train == velap.old_config().train
        records = velap.read_old_records(old / f"records/SpiralMaze/{method}-default/train0.jsonl")
        assert [(record["method"], record["episode_seed"]) for record in records] == [(method, 1000), (method, 1001)]
