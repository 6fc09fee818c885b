"""Configs: the paper's tables, validation, canonical JSON and its hash, overrides."""

from __future__ import annotations

import dataclasses
import json

import pytest

from velap.config import Config, ModelConfig, override
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.training import TrainConfig
from velap.errors import ConfigError, UnknownTaskError
from velap.tasks import PRESETS, TASKS, get_task, make_config


def test_the_paper_preset_is_the_tables() -> None:
    config = make_config("SpiralMaze", "paper")
    model, train, planner, controller = config.model, config.train, config.planner, config.controller
    assert (model.encoder_filters, model.encoder_kernels, model.encoder_strides) == ((32, 32, 64, 64), (4,) * 4, (2,) * 4)
    assert (model.norm, model.latent_dim, model.n_ens, model.noise_dim) == ("batch", 32, 3, 16)
    assert (train.batch_windows, train.learning_rate, train.discount, train.temperature) == (64, 3e-4, 0.96, 1.0)
    assert (train.c0, train.c1, train.c2, train.c3, train.kl_weight) == (0.2, 0.001, 0.001, 0.001, 0.01)
    assert (train.dynamics_loss, train.dynamics_horizon) == ("infonce", 3)
    assert (planner.n_iter, planner.n_sim, planner.discard_high_exponent, planner.neighbour_exponent) == (250, 10, 2, 3)
    assert (planner.goal_exponent, planner.neighbour_distance_factor) == (5, 3)
    assert (planner.discard_low_exponent, planner.discard_std) == (None, None), "read as γ^n_sim and 1 - γ"
    assert (controller.n_replan, controller.stop_exponent, controller.waypoint_exponent) == (25, 5, 3)


def test_what_is_ours_is_off_in_the_paper_preset() -> None:
    config = make_config("SpiralMaze", "paper")
    model = config.model
    assert (model.dynamics_residual, model.critic_bounded, model.bank_size) == (False, False, 0)
    assert config.train.latent_steps == 0
    assert not config.train.whole_windows
    assert (config.train.group_windows, config.train.reconstruction) == (1, 0)
    assert config.controller.residuals == 0
    assert not config.planner.coherent_noise
    assert config.planner.anchor == "none"


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("task", [*TASKS, "someone/elses-v0"])
def test_json_is_exact_and_canonical(task: str, preset: str) -> None:
    config = make_config(task, preset)
    again = Config.from_json(config.to_json())
    assert again == config
    assert again.hash() == config.hash()
    shuffled = json.dumps(dict(reversed(json.loads(config.to_json()).items())))
    assert Config.from_json(shuffled).hash() == config.hash()


def test_every_field_changes_the_hash() -> None:
    base = Config("task", "default")
    changed = override(base, planner={"n_iter": 251})
    assert changed.hash() != base.hash()
    assert override(changed, planner={"n_iter": 250}).hash() == base.hash()
    assert len({make_config("SpiralMaze", preset).hash() for preset in PRESETS}) == 2


def test_records_older_than_a_field_keep_their_hash() -> None:
    base = Config("task", "default")
    assert "group_windows" not in base.to_json()
    assert override(base, train={"group_windows": 6}).hash() != base.hash()
    # what results/records/SpiralMaze holds
    assert make_config("SpiralMaze").hash() == "3894728bad15"
    assert make_config("SpiralMaze", "paper").hash() == "5f3372247244"


@pytest.mark.parametrize(("part", "field", "value"), [
    (TrainConfig, "group_windows", 0), (TrainConfig, "group_reach", 0),
    (ModelConfig, "frame_stack", 0), (ModelConfig, "norm", "group"), (ModelConfig, "encoder_filters", (32,)),
    (ModelConfig, "n_ens", 0),
    (TrainConfig, "discount", 1.0), (TrainConfig, "relabel_next", 0.5),
    (TrainConfig, "learning_rate", 0.0), (TrainConfig, "window", 2), (TrainConfig, "dynamics_loss", "l1"),
    (PlannerConfig, "n_iter", 0), (PlannerConfig, "p_sparse", 0.9), (PlannerConfig, "temperature_value", 0.0),
    (PlannerConfig, "anchor", "glue"), (ControllerConfig, "n_replan", 0), (ControllerConfig, "residuals", -1),
])
def test_values_out_of_range_name_their_field(part: type, field: str, value: object) -> None:
    with pytest.raises(ConfigError, match=field):
        part(**{field: value})


def test_unknown_fields_and_names_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"no field \['n_itre'\].*n_iter"):
        override(Config("task", "default"), planner={"n_itre": 3})
    with pytest.raises(ConfigError, match=r"unknown fields \['extra'\]"):
        Config.from_json('{"task": "t", "preset": "default", "extra": 1}')
    with pytest.raises(ConfigError, match="not JSON"):
        Config.from_json("{")
    with pytest.raises(ConfigError, match="does not fit"):
        Config.from_json("{}")
    with pytest.raises(UnknownTaskError, match=r"unknown task 'spiralmaze'.*SpiralMaze"):
        get_task("spiralmaze")
    with pytest.raises(UnknownTaskError, match=r"unknown preset 'best'"):
        make_config("SpiralMaze", "best")


def test_configs_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config("task", "default").train.discount = 0.5  # type: ignore[misc]


def test_cross_entropy_asks_for_bounded_critics():
    config = make_config("SpiralMaze")
    with pytest.raises(ConfigError, match="critic_bounded"):
        override(config, train={"critic_loss": "cross_entropy"}, model={"critic_bounded": False})
    assert override(config, train={"critic_loss": "cross_entropy"}).hash() != config.hash()
    with pytest.raises(ConfigError, match="critic_floor"):
        override(config, train={"critic_loss": "mse", "critic_floor": 0.01})
