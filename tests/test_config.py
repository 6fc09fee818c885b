"""Configs: the paper's tables, validation, JSON that is whole, the hash of what decides, every field earns its place."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import pytest

from velap.config import (
    ClonePhase,
    Config,
    ControllerConfig,
    EncoderPhase,
    EnsemblePhase,
    JointPhase,
    LatentPhase,
    ModelConfig,
    PlannerConfig,
    TrainConfig,
    describe,
    override,
)
from velap.config.fields import docs, hints
from velap.config.planning import NEIGHBOUR_DISTANCE
from velap.config.serialise import CADENCES, PARTS
from velap.config.training import DYNAMICS_HORIZON, PHASES, Phase
from velap.errors import ConfigError, UnknownTaskError
from velap.losses import KL_WEIGHT, TEMPERATURE
from velap.models.encoders import conv
from velap.models.velap import N_ENS, NOISE_DIM
from velap.tasks import PRESETS, get_task, make_config
from velap.training.joint import LEARNING_RATE

TASKS = ("SpiralMaze", "ObstacleMaze", "WindowClose", "FaucetClose", "ButtonWall", "DrawerButton", "someone/elses-v0")
CONFIGS = [make_config(task, preset) for preset in PRESETS for task in TASKS]


def test_the_paper_preset_is_the_tables() -> None:
    config = make_config("SpiralMaze", "paper")
    model, train, planner, controller = config.model, config.train, config.planner, config.controller
    (joint,) = train.phases
    assert isinstance(joint, JointPhase)
    assert (conv.FILTERS, conv.KERNELS, conv.STRIDES, conv.DENSE) == ((32, 32, 64, 64), (4,) * 4, (2,) * 4, (256, 128))
    assert (model.encoder, model.norm, model.latent_dim, N_ENS, NOISE_DIM) == ("conv", "batch", 32, 3, 16)
    assert (joint.windows, joint.window, LEARNING_RATE, train.discount, TEMPERATURE) == (64, 1, 3e-4, 0.96, 1.0)
    assert (train.c0, joint.c1, train.c2, train.c3, KL_WEIGHT) == (0.2, 0.001, 0.001, 0.001, 0.01)
    assert (joint.dynamics_loss, DYNAMICS_HORIZON) == ("infonce", 3)
    assert (planner.n_iter, planner.n_sim, planner.discard_high_exponent, planner.neighbour_exponent) == (250, 10, 2, 3)
    assert (planner.goal_exponent, NEIGHBOUR_DISTANCE) == (5, 3)
    assert planner.discard_low_exponent is None, "read as γ^n_sim"
    assert (controller.n_replan, controller.stop_exponent, controller.waypoint_exponent) == (25, 5, 3)
    assert [make_config(task, "paper").train.c3 for task in TASKS] == [0.001, 0.001, 0.5, 0.5, 0.5, 0.5, 0.001]
    assert [make_config(task, "paper").planner.n_iter for task in TASKS] == [250, 250, 250, 250, 500, 250, 250]


def test_what_is_ours_is_off_in_the_paper_preset() -> None:
    config = make_config("SpiralMaze", "paper")
    model = config.model
    assert (model.dynamics_residual, model.critic_bounded, model.bank_size, model.command_dims) == (False, False, 0, 0)
    assert (config.train.group_windows, config.train.critic_loss, config.train.policy_every) == (1, "mse", 1)
    assert config.controller == ControllerConfig(n_replan=25)
    assert not config.planner.provenance and not config.planner.coherent_noise
    assert config.planner.anchor == "none"
    planner = config.planner
    assert (planner.p_sparse, planner.p_value, planner.p_policy, planner.candidates) == (0.4, 0.4, 0.2, 50)


@pytest.mark.parametrize("config", CONFIGS, ids=lambda config: f"{config.task}-{config.preset}")
def test_json_is_whole_exact_and_canonical(config: Config) -> None:
    text = config.to_json()
    assert Config.from_json(text) == config
    raw = json.loads(text)
    assert raw["schema"] == 4
    for part, cls in PARTS.items():
        assert set(raw[part]) == {field.name for field in dataclasses.fields(cls)}
    for phase, saved in zip(config.train.phases, raw["train"]["phases"], strict=True):
        assert set(saved) == {"phase", *(field.name for field in dataclasses.fields(phase))}
    shuffled = json.dumps(dict(reversed(json.loads(text).items())))
    assert Config.from_json(shuffled).hash() == config.hash()


def changed_values(value: Any, hint: Any) -> list[Any]:
    """Other values of a field, some of which are in its range."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, str):
        return [choice for choice in getattr(hint, "__args__", ("moments",)) if choice != value]
    if value is None:
        return [7.0]
    return [2 * value + 0.1, value / 2, value + 1] if isinstance(value, float) else [value + 1, value + 3, max(value - 1, 0)]


def neighbours(config: Config) -> dict[str, Config]:
    """Configs that differ in one field each, by its name."""
    found: dict[str, Config] = {}
    places: list[tuple[str, Any, Any]] = [(part, getattr(config, part), (part,)) for part in PARTS]
    places += [(f"train.{phase.label}", phase, ("train", phase.label)) for phase in config.train.phases]
    for where, values, path in places:
        for name, hint in hints(type(values)).items():
            for value in changed_values(getattr(values, name), hint) if name != "phases" else ():
                change = {path[1]: {name: value}} if len(path) == 2 else {name: value}
                try:
                    found.setdefault(f"{where}.{name}", override(config, **{path[0]: change}))
                except ConfigError:
                    continue
    return found


def test_the_hash_is_of_every_field_that_decides_a_result() -> None:
    base = make_config("DrawerButton")
    others = neighbours(base)
    cadences = {f"train.{name}" for name in CADENCES}
    assert len(others) > 40 and cadences <= set(others)
    hashes = {name: config.hash() for name, config in others.items()}
    assert {name for name, value in hashes.items() if value == base.hash()} == cadences
    assert len(set(hashes.values())) == len(hashes) - len(cadences) + 1
    shorter = override(base, train={"clone": {"steps": 0}})
    again = override(shorter, train={"clone": {"steps": 3_000}})
    assert shorter.hash() != again.hash() == base.hash()


def test_every_field_is_named_by_a_table_or_differs_between_presets() -> None:
    """No field is dead or constant, and there are no more than 60."""
    values: dict[tuple[str, str], set[Any]] = {}
    owner: dict[tuple[str, str], type] = {}
    for config in CONFIGS:
        for part in [*(getattr(config, part) for part in PARTS), *config.train.phases]:
            for field in dataclasses.fields(part):
                home = next(base for base in reversed(type(part).__mro__) if field.name in base.__dict__.get(
                    "__dataclass_fields__", {}))
                if field.name != "phases":
                    values.setdefault((home.__name__, field.name), set()).add(getattr(part, field.name))
                    owner[home.__name__, field.name] = home
    for kind in PHASES.values():
        assert any(isinstance(phase, kind) for config in CONFIGS for phase in config.train.phases), f"no preset has {kind}"
    assert len(values) <= 60
    for (home, name), seen in values.items():
        meaning = docs(owner[home, name])[name]
        named = any(word in meaning for word in ("Table ", "App. B", "Eq. 9", "P_node"))
        assert len(seen) > 1 or named or name in CADENCES, f"{home}.{name} is {seen} in every preset"


def test_every_field_says_what_it_is_and_where_it_comes_from() -> None:
    for cls in (*PARTS.values(), *PHASES.values()):
        for name in hints(cls):
            meaning = docs(cls)[name]
            assert any(word in meaning for word in ("Table", "Eq.", "App.", "ours", "learnt, in this order")), (cls, name)
    described = {name for name, *_ in describe(make_config("SpiralMaze"))}
    assert {"model.encoder", "train.joint.c1", "train.clone.steps", "planner.p_sparse", "controller.n_replan"} <= described
    assert all(all(row) for row in describe(make_config("SpiralMaze")))


@pytest.mark.parametrize(("make", "field"), [
    (lambda: TrainConfig(group_windows=0), "group_windows"), (lambda: TrainConfig(group_reach=0), "group_reach"),
    (lambda: ModelConfig(frame_stack=0), "frame_stack"), (lambda: ModelConfig(norm="group"), "norm"),  # type: ignore[arg-type]
    (lambda: ModelConfig(n_global=0), "n_global"), (lambda: ModelConfig(command_dims=-1), "command_dims"),
    (lambda: TrainConfig(discount=1.0), "discount"), (lambda: TrainConfig(target_rate=0.0), "target_rate"),
    (lambda: TrainConfig(phases=()), "at least one phase"), (lambda: JointPhase(4, window=2), r"joint\.window"),
    (lambda: JointPhase(0), r"joint\.steps"), (lambda: JointPhase(4, rewarded_share=1.5), r"joint\.rewarded_share"),
    (lambda: JointPhase(4, dynamics_loss="l1"), r"joint\.dynamics_loss"),  # type: ignore[arg-type]
    (lambda: EncoderPhase(4, pairs=0), r"encoder\.pairs"), (lambda: LatentPhase(4, horizon=0), r"latent\.horizon"),
    (lambda: EnsemblePhase(4, members=0), r"ensemble\.members"), (lambda: ClonePhase(4, candidates=0), r"clone\.candidates"),
    (lambda: TrainConfig(phases=(LatentPhase(1), JointPhase(1))), "before those on frozen latents"),
    (lambda: TrainConfig(phases=(JointPhase(1), JointPhase(2))), "each kind of phase once"),
    (lambda: PlannerConfig(n_iter=0), "n_iter"), (lambda: PlannerConfig(p_sparse=0.95), "p_sparse"),
    (lambda: PlannerConfig(anchor="glue"), "anchor"),  # type: ignore[arg-type]
    (lambda: ControllerConfig(n_replan=0), "n_replan"),
])
def test_values_out_of_range_name_their_field(make: Any, field: str) -> None:
    with pytest.raises(ConfigError, match=field):
        make()


@pytest.mark.parametrize(("part", "change", "expected"), [
    ("planner", {"discard_low_exponent": "abc"}, r"planner\.discard_low_exponent` is 'abc'; expected float or null"),
    ("planner", {"n_iter": 2.5}, r"planner\.n_iter` is 2.5; expected int"),
    ("planner", {"n_iter": None}, r"planner\.n_iter` is None; expected int"),
    ("planner", {"coherent_noise": 1}, r"planner\.coherent_noise` is 1; expected bool"),
    ("planner", {"anchor": "glue"}, "expected 'auto' or 'none' or 'snap'"),
    ("train", {"joint": {"steps": True}}, r"train\.joint\.steps` is True; expected int"),
    ("train", {"joint": {"stpes": 1}}, r"`train\.joint` has no field 'stpes'; expected some of .*steps"),
    ("train", {"clone": {"candidates": 1}}, r"no phase 'clone'.*train\.clone\.steps"),
    ("train", {"joint_steps": 1}, r"`train` has no field 'joint_steps'"),
    ("trian", {"c0": 1.0}, "no part 'trian'"),
])
def test_changes_of_another_type_or_name_are_refused(part: str, change: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        override(make_config("SpiralMaze"), **{part: change})


def test_whole_numbers_and_null_are_taken_where_they_fit() -> None:
    config = override(make_config("SpiralMaze"), planner={"discard_low_exponent": 7, "p_sparse": 0})
    assert (config.planner.discard_low_exponent, config.planner.p_sparse) == (7.0, 0.0)
    assert type(config.planner.discard_low_exponent) is float
    assert override(config, planner={"discard_low_exponent": None}).planner.discard_low_exponent is None


def test_phases_are_changed_put_in_and_left_out_by_their_label() -> None:
    base = make_config("DrawerButton")
    labels = [phase.label for phase in base.train.phases]
    assert labels == ["encoder", "latent", "ensemble", "clone"]
    changed = override(base, train={"ensemble": {"members": 2}, "clone": {"steps": 0}, "joint": {"steps": 7, "c1": 0.5}})
    assert [phase.label for phase in changed.train.phases] == ["encoder", "joint", "latent", "ensemble"]
    ensemble, joint = changed.train.phases[3], changed.train.phases[1]
    assert isinstance(ensemble, EnsemblePhase) and ensemble.members == 2
    assert joint == JointPhase(7, c1=0.5)
    assert override(base, train={"joint": {"steps": 0}}) == base
    assert override(make_config("SpiralMaze"), train={"clone": {"steps": 9}}).train.clones


def test_unknown_names_and_broken_files_are_refused() -> None:
    whole = json.loads(Config("task", "default").to_json())
    for change, expected in (
        ({"extra": 1}, r"unknown fields \['extra'\]"), ({"schema": 5}, "schema 5; expected 4"),
        ({"model": {}}, r"`config\.model`.* lacks \['bank_size'"), ({"planner": 4}, r"`config\.planner` is int"),
        ({"train": {**whole["train"], "phases": [{"phase": "dream"}]}}, "kind 'dream'"),
        ({"train": {**whole["train"], "c0": "big"}}, r"config\.train\.c0` is 'big'; expected float"),
    ):
        with pytest.raises(ConfigError, match=expected):
            Config.from_json(json.dumps({**whole, **change}))
    with pytest.raises(ConfigError, match="not JSON"):
        Config.from_json("{")
    with pytest.raises(UnknownTaskError, match=r"unknown task 'spiralmaze'.*SpiralMaze"):
        get_task("spiralmaze")
    with pytest.raises(UnknownTaskError, match=r"unknown preset 'best'"):
        make_config("SpiralMaze", "best")


def test_configs_are_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config("task", "default").train.discount = 0.5  # type: ignore[misc]


def test_cross_entropy_asks_for_bounded_critics() -> None:
    config = make_config("SpiralMaze")
    with pytest.raises(ConfigError, match="critic_bounded"):
        override(config, train={"critic_loss": "cross_entropy"}, model={"critic_bounded": False})
    assert override(config, train={"critic_loss": "cross_entropy"}).hash() != config.hash()
    with pytest.raises(ConfigError, match="critic_floor"):
        override(config, train={"critic_loss": "mse", "critic_floor": 0.01})


def test_a_phase_is_a_kind_with_fields_of_its_own() -> None:
    assert {kind.name for kind in PHASES.values()} == set(PHASES)
    assert all(issubclass(kind, Phase) and kind(1).updates >= 1 for kind in PHASES.values())
