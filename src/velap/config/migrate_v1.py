"""Configs of schema 1 (velap 0.1): read as today's, and written as they were, so that old hashes are recognised.

`v1.json` is a frozen copy of what schema 1 was: every field with its default, the fields that it left out of files at their
defaults (`younger`), those that only VELAP itself acted by (`own`), and the presets' differences from the defaults. Nothing
here depends on today's defaults.
"""

from __future__ import annotations

import copy
import hashlib
import json
import math
from functools import cache
from importlib.resources import files
from typing import Any

from velap.config.model import ModelConfig
from velap.config.planning import HELD_TURN, ControllerConfig, PlannerConfig
from velap.config.serialise import HOLD, Config
from velap.config.training import (
    DYNAMICS_HORIZON,
    ClonePhase,
    EncoderPhase,
    EnsemblePhase,
    JointPhase,
    LatentPhase,
    Phase,
    TrainConfig,
    ValuePhase,
)
from velap.errors import ConfigError

V1 = dict[str, dict[str, Any]]
"""Fields of a schema 1 config by part."""
CARRIED = {
    "model": ("frame_stack", "norm", "dynamics_residual", "critic_bounded", "n_global", "bank_size"),
    "train": ("discount", "c0", "c2", "c3", "critic_loss", "critic_floor", "target_rate", "policy_every", "group_windows",
              "group_reach", "log_every", "checkpoint_every"),
    "planner": tuple(PlannerConfig.__dataclass_fields__),
    "controller": tuple(ControllerConfig.__dataclass_fields__),
}
"""Fields that are the same today."""
FIXED = {
    "model": ("encoder_filters", "encoder_kernels", "encoder_strides", "encoder_dense", "dynamics_dense", "generative_dense",
              "noise_dim", "policy_dense", "critic_dense", "n_ens", "latent_norm", "command_scale"),
    "train": ("encoder_reach", "encoder_rewarded_share", "encoder_learning_rate", "learning_rate", "anneal", "shift",
              "temperature", "kl_weight", "dynamics_horizon", "relabel_next", "relabel_future", "relabel_other",
              "group_goals", "latent_batch", "latent_value_batch", "latent_dynamics_steps", "latent_heads", "held_actions",
              "holdout_episodes", "latent_learning_rate", "precision"),
    "planner": ("discard_std", "neighbour_distance_factor", "max_neighbours", "temperature_sparse", "temperature_value",
                "rehearsals", "anchor_factor"),
    "controller": ("lookahead_samples",),
}
"""Fields that have one value today, their default then."""
MOMENTS, MEMORY = 24, 0.7
"""Colours of the palette, and the memory of past commands, of every config that had them."""
DISTIL = 3_000
"""Updates of every distillation."""


@cache
def _table() -> dict[str, Any]:
    loaded: dict[str, Any] = json.loads(files("velap.config").joinpath("v1.json").read_text())
    return loaded


def _preset(task: str, preset: str) -> V1:
    """Every field of a schema 1 preset; a task that it did not know had the preset for foreign data."""
    table = _table()
    changes = table["presets"].get(f"{task}/{preset}", table["presets"].get(preset, {}))
    return {part: {**copy.deepcopy(defaults), **changes.get(part, {})} for part, defaults in table["defaults"].items()}


def from_v1(raw: Any) -> Config:
    """Today's config from a parsed schema 1 file; raises ConfigError where it names what today's velap cannot do."""
    defaults = _table()["defaults"]
    if not isinstance(raw, dict) or set(raw) != {"task", "preset", *defaults}:
        raise ConfigError(f"the config has no schema and is {sorted(raw) if isinstance(raw, dict) else raw!r}; expected "
                          "the parts of a config that velap saved. Restore the file.")
    whole: V1 = {}
    for part, known in defaults.items():
        unknown = sorted(set(raw[part]) - set(known))
        if unknown:
            raise ConfigError(f"`config.{part}` has unknown fields {unknown}; expected some of {sorted(known)}. "
                              "The file may come from another version of velap.")
        whole[part] = {**known, **raw[part]}
        for name in FIXED[part]:
            _refuse_unless(whole[part][name] == known[name], f"{part}.{name}", whole[part][name], known[name])
    return Config(
        task=raw["task"], preset=raw["preset"], model=_model(whole["model"]), train=_train(whole),
        planner=PlannerConfig(**_carried("planner", whole)), controller=_controller(whole))


def _refuse_unless(holds: bool, name: str, got: Any, expected: Any) -> None:
    if not holds:
        raise ConfigError(f"the file was made by velap 0.1 with `{name}` = {got!r}; today's velap has {expected!r} there "
                          "and no such option. Use the file with velap 0.1, or train again.")


def _carried(part: str, whole: V1) -> dict[str, Any]:
    return {name: whole[part][name] for name in CARRIED[part]}


def _model(old: dict[str, Any]) -> ModelConfig:
    colours, slow, kept = old["moment_colours"], old["slow_features"], old["keep_moments"]
    _refuse_unless((colours, slow, kept) in ((0, 0, False), (MOMENTS, 32, False), (MOMENTS, 0, True)),
                   "model.moment_colours, slow_features, keep_moments", (colours, slow, kept), (MOMENTS, 32, False))
    _refuse_unless(old["command_memory"] in (0.0, MEMORY), "model.command_memory", old["command_memory"], MEMORY)
    commands = 0 if old["command_memory"] == 0 else old["command_dims"]
    _refuse_unless(commands > 0 or old["command_memory"] == 0, "model.command_dims", commands, "the number of actions")
    encoder = "conv" if not colours else "moments" if kept else "slow-moments"
    return ModelConfig(encoder=encoder, latent_dim=old["latent_dim"] - slow - kept * 6 * colours, command_dims=commands,
                       **_carried("model", {"model": old}))


def _train(whole: V1) -> TrainConfig:
    old = whole["train"]
    relative = old["critic_loss"] == "cross_entropy"
    _refuse_unless(old["policy_relative"] == relative, "train.policy_relative", old["policy_relative"], relative)
    phases = tuple(_phases(old))
    _refuse_unless(old["heads_afresh"] == (old["joint_steps"] == 0 and whole["model"]["command_memory"] > 0),
                   "train.heads_afresh", old["heads_afresh"], not old["heads_afresh"])
    config = TrainConfig(phases=phases, **_carried("train", whole))
    for name, has in (("success_policy", config.clones), ("held_policy", config.holds)):
        _refuse_unless(whole["model"][name] == has, f"model.{name}", whole["model"][name], has)
    return config


def _phases(old: dict[str, Any]) -> list[Phase]:
    """The phases that the steps, weights and batches of schema 1 stand for."""
    phases: list[Phase] = []
    later = old["rewarded_share"] if old["latent_rewarded_share"] is None else old["latent_rewarded_share"]
    if old["encoder_steps"]:
        phases.append(EncoderPhase(old["encoder_steps"], pairs=old["encoder_pairs"], inverse=old["inverse"]))
    if old["joint_steps"]:
        weight, side = old["reconstruction"], old["reconstruction_side"]
        _refuse_unless(weight in (0.0, 0.05), "train.reconstruction", weight, 0.05)
        starts_of = {"value_transitions": old["window"], "dynamics_rollouts": old["window"] - DYNAMICS_HORIZON + 1}
        for name, starts in starts_of.items():
            drawn, there = old[name] or math.inf, old["batch_windows"] * starts
            _refuse_unless(not old["whole_windows"] or min(drawn, there) == min(4 * old["batch_windows"], there),
                           f"train.{name}", old[name], 4 * old["batch_windows"])
        phases.append(JointPhase(
            old["joint_steps"], rewarded_share=old["rewarded_share"], c1=old["c1"], dynamics_loss=old["dynamics_loss"],
            windows=old["batch_windows"], window=old["window"] if old["whole_windows"] else 1,
            reconstruction_side=side if weight else 0))
    if old["latent_steps"]:
        phases.append(LatentPhase(old["latent_steps"], rewarded_share=later, horizon=old["latent_horizon"]))
    if old["latent_value_steps"]:
        phases.append(ValuePhase(old["latent_value_steps"], rewarded_share=later))
    if old["member_steps"]:
        phases.append(EnsemblePhase(old["member_steps"], members=old["members"], noise=old["member_noise"]))
    if old["held_steps"]:
        phases.append(EnsemblePhase(old["held_steps"], members=old["held_members"], hold=HOLD, noise=old["member_noise"]))
    if old["member_steps"] or old["held_steps"]:
        _refuse_unless(old["distil_steps"] == DISTIL, "train.distil_steps", old["distil_steps"], DISTIL)
    if old["clone_steps"]:
        phases.append(ClonePhase(old["clone_steps"], candidates=old["clone_candidates"], reach=old["clone_reach"]))
    return phases


def _controller(whole: V1) -> ControllerConfig:
    turn = HELD_TURN if whole["train"]["held_steps"] else 0
    _refuse_unless(whole["controller"]["held_turn"] == turn, "controller.held_turn", whole["controller"]["held_turn"], turn)
    return ControllerConfig(**_carried("controller", whole))


def to_v1(config: Config) -> V1 | None:
    """Every field of schema 1 for today's config; None for a config that schema 1 could not say.

    Fields without effect on this config keep the value of the schema 1 preset: they were in the hash all the same.
    """
    old = _preset(config.task, config.preset)
    for part, names in CARRIED.items():
        old[part] |= {name: getattr(getattr(config, part), name) for name in names}
    model, train = old["model"], old["train"]
    kept = config.model.encoder == "moments"
    slow = 32 * (config.model.encoder == "slow-moments")
    moments = MOMENTS * (config.model.encoder != "conv")
    model |= {"moment_colours": moments, "slow_features": slow, "keep_moments": kept, "success_policy": config.train.clones,
              "held_policy": config.train.holds, "latent_dim": config.model.latent_dim + slow + kept * 6 * moments,
              "command_memory": MEMORY if config.model.command_dims else 0.0, "command_dims": config.model.command_dims}
    old["controller"]["held_turn"] = HELD_TURN if config.train.holds else 0
    train["policy_relative"] = config.train.critic_loss == "cross_entropy"
    for kind in ("encoder", "joint", "latent", "latent_value", "member", "held", "clone"):
        train[f"{kind}_steps"] = 0
    for phase in config.train.phases:
        _add_phase(train, phase)
    train["distil_steps"] = DISTIL if train["member_steps"] or train["held_steps"] else 0
    train["heads_afresh"] = train["joint_steps"] == 0 and config.model.command_dims > 0
    try:
        same = from_v1({"task": config.task, "preset": config.preset, **old}) == config
    except ConfigError:
        return None
    return old if same else None


def _add_phase(train: dict[str, Any], phase: Phase) -> None:
    """The fields of schema 1 that a phase decides."""
    match phase:
        case EncoderPhase():
            train |= {"encoder_steps": phase.steps, "encoder_pairs": phase.pairs, "inverse": phase.inverse}
        case JointPhase():
            whole = phase.window > 1
            train |= {"joint_steps": phase.steps, "rewarded_share": phase.rewarded_share, "c1": phase.c1,
                      "dynamics_loss": phase.dynamics_loss, "batch_windows": phase.windows, "whole_windows": whole,
                      "window": phase.window if whole else train["window"],
                      "reconstruction": 0.05 if phase.reconstruction_side else 0.0,
                      "reconstruction_side": phase.reconstruction_side or train["reconstruction_side"]}
        case LatentPhase() | ValuePhase():
            if isinstance(phase, LatentPhase):
                train |= {"latent_steps": phase.steps, "latent_horizon": phase.horizon}
            else:
                train["latent_value_steps"] = phase.steps
            inherited = train["latent_rewarded_share"] is None and train["rewarded_share"] == phase.rewarded_share
            train["latent_rewarded_share"] = None if inherited else phase.rewarded_share
        case EnsemblePhase():
            held = phase.hold > 1
            train |= {"held_steps" if held else "member_steps": phase.steps, "member_noise": phase.noise,
                      "held_members" if held else "members": phase.members}
        case ClonePhase():
            train |= {"clone_steps": phase.steps, "clone_candidates": phase.candidates, "clone_reach": phase.reach}


def legacy_json(config: Config) -> str | None:
    """What schema 1 saved of this config; None where it could not."""
    old = to_v1(config)
    if old is None:
        return None
    table = _table()
    written = {part: {name: value for name, value in fields.items()
                      if name not in table["younger"][part] or value != table["defaults"][part][name]}
               for part, fields in old.items()}
    return json.dumps({"task": config.task, "preset": config.preset, **written}, sort_keys=True)


def legacy_shared_json(config: Config) -> str | None:
    """What schema 1 hashed for methods other than VELAP: no planner, no controller, no policies that VELAP alone acts by."""
    text = legacy_json(config)
    if text is None:
        return None
    raw = json.loads(text)
    for part, name in _table()["own"]:
        raw[part].pop(name, None)
    return json.dumps({name: raw[name] for name in ("task", "preset", "model", "train")}, sort_keys=True)


def legacy_hash(config: Config) -> str | None:
    """`Config.hash` of schema 1, by which records of velap 0.1 name this config; None where schema 1 could not say it."""
    text = legacy_json(config)
    return None if text is None else hashlib.sha256(text.encode()).hexdigest()[:12]
