"""Configs of older schemas, read as today's. Schema 1 is velap 0.1's, schema 2 that of its successors before one search,
schema 3 that of the one search with settings for lookahead and crowding.

What a training made is kept. How it acts is today's: planner and controller of older files have today's defaults, and
mechanisms that only acted at run time are left out, with the policies that only they used. Files of the preset `paper` keep
their planner and controller, which are the paper's.
"""

from __future__ import annotations

import math
from typing import Any

from velap.config.fields import hints
from velap.config.model import ModelConfig
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.serialise import Config, build
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

V1_DEFAULTS: dict[str, dict[str, Any]] = {
    "model": {
        "frame_stack": 3, "latent_dim": 32, "norm": "layer", "moment_colours": 0, "slow_features": 0, "keep_moments": False,
        "encoder_filters": [32, 32, 64, 64], "encoder_kernels": [4, 4, 4, 4], "encoder_strides": [2, 2, 2, 2],
        "encoder_dense": [256, 128], "dynamics_dense": [128, 128, 128, 128], "dynamics_residual": True,
        "generative_dense": [128, 128, 128], "noise_dim": 16, "policy_dense": [128, 128, 128],
        "critic_dense": [128, 128, 128], "critic_bounded": True, "n_ens": 3, "n_global": 2, "success_policy": False,
        "held_policy": False, "latent_norm": False, "command_memory": 0.0, "command_scale": 2.0, "command_dims": 0,
        "half_weights": False, "bank_size": 4096,
    },
    "train": {
        "encoder_steps": 0, "encoder_pairs": 64, "encoder_reach": 20, "encoder_rewarded_share": 0.0,
        "encoder_learning_rate": 0.001, "inverse": 0.3, "joint_steps": 4000, "batch_windows": 24, "window": 20,
        "whole_windows": True, "value_transitions": 96, "dynamics_rollouts": 96, "learning_rate": 0.0003, "anneal": False,
        "c0": 0.2, "c1": 0.01, "shift": 0, "reconstruction": 0.0, "reconstruction_side": 16, "c2": 0.001, "c3": 0.001,
        "discount": 0.96, "temperature": 1.0, "kl_weight": 0.01, "dynamics_horizon": 3, "dynamics_loss": "infonce",
        "critic_loss": "mse", "critic_floor": 0.0, "policy_relative": False, "relabel_next": 0.2, "relabel_future": 0.4,
        "relabel_other": 0.4, "group_windows": 1, "group_reach": 8, "group_goals": 0.5, "rewarded_share": 0.05,
        "target_rate": 0.05, "policy_every": 2, "heads_afresh": False, "latent_steps": 4000, "latent_batch": 256,
        "latent_horizon": 5, "latent_rewarded_share": None, "latent_dynamics_steps": 0, "latent_dynamics_batch": 512,
        "latent_dynamics_horizon": 3, "latent_priority": 0.5, "latent_ridge": 0.1, "latent_value_steps": 0,
        "latent_value_batch": 512, "member_steps": 0, "members": 4, "member_noise": 0.0, "distil_steps": 0, "held_steps": 0,
        "held_actions": 5, "held_members": 3, "latent_heads": True, "clone_steps": 0, "clone_candidates": 1,
        "clone_reach": 0, "holdout_episodes": 16, "latent_learning_rate": 0.001, "precision": "bfloat16", "log_every": 50,
        "diagnose_every": 1000, "checkpoint_every": 500,
    },
}
"""Fields of schema 1 and their values where a file leaves them out."""
CARRIED = {
    "model": ("frame_stack", "norm", "dynamics_residual", "critic_bounded", "n_global", "bank_size"),
    "train": ("discount", "c0", "c2", "c3", "critic_loss", "critic_floor", "target_rate", "policy_every", "group_windows",
              "group_reach", "log_every", "checkpoint_every"),
}
"""Fields of schema 1 that are the same today."""
FIXED = {
    "model": ("encoder_filters", "encoder_kernels", "encoder_strides", "encoder_dense", "dynamics_dense", "generative_dense",
              "noise_dim", "policy_dense", "critic_dense", "n_ens", "latent_norm", "command_scale"),
    "train": ("encoder_reach", "encoder_rewarded_share", "encoder_learning_rate", "learning_rate", "anneal", "shift",
              "temperature", "kl_weight", "dynamics_horizon", "relabel_next", "relabel_future", "relabel_other",
              "group_goals", "latent_batch", "latent_value_batch", "latent_dynamics_steps", "latent_heads",
              "holdout_episodes", "latent_learning_rate", "precision"),
}
"""Fields of schema 1 that have one value today, their default then."""
MOMENTS, MEMORY = 24, 0.7
"""Colours of the palette, and the memory of past commands, of every config that had them."""
DISTIL = 3_000
"""Updates of every distillation."""


def from_older(raw: dict[str, Any]) -> Config:
    """Today's config from parsed JSON of schema 1, 2 or 3; raises ConfigError where it names what today's velap cannot
    do."""
    return _from_v1(raw) if "schema" not in raw else _from_later(raw)


def _from_later(raw: dict[str, Any]) -> Config:
    try:
        train = raw["train"]
        phases = [{name: value for name, value in phase.items() if name not in ("hold", "reach")}
                  for phase in train["phases"] if phase.get("hold", 1) == 1]
        planner, controller = _acting(raw)
        today = {**raw, "train": {**train, "phases": phases}, "planner": planner, "controller": controller}
    except (KeyError, AttributeError, TypeError) as error:
        raise ConfigError(f"the config of schema {raw['schema']} lacks parts or has others than it should ({error!r}); "
                          "expected a config that velap saved. Restore the file.") from error
    del today["schema"]
    config: Config = build(Config, today, "config")
    return config


def _acting(raw: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Fields of today's planner and controller for a file of an older schema."""
    if raw["preset"] != "paper":
        planner, controller = PlannerConfig(), ControllerConfig()
        return dict(vars(planner)), dict(vars(controller))
    from velap.config.presets import paper

    own = paper(raw["task"])
    return _kept(own.planner, raw["planner"]), _kept(own.controller, raw["controller"])


def _kept(part: PlannerConfig | ControllerConfig, fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a part of today's config, with what a file says of them."""
    return {**vars(part), **{name: fields[name] for name in hints(type(part)) if name in fields}}


def _from_v1(raw: dict[str, Any]) -> Config:
    if set(raw) != {"task", "preset", "model", "train", "planner", "controller"}:
        raise ConfigError(f"the config has no schema and is {sorted(raw)!r}; expected the parts of a config that velap "
                          "saved. Restore the file.")
    whole: dict[str, dict[str, Any]] = {}
    for part, known in V1_DEFAULTS.items():
        unknown = sorted(set(raw[part]) - set(known))
        if unknown:
            raise ConfigError(f"`config.{part}` has unknown fields {unknown}; expected some of {sorted(known)}. "
                              "The file may come from another version of velap.")
        whole[part] = {**known, **raw[part]}
        for name in FIXED[part]:
            _refuse_unless(whole[part][name] == known[name], f"{part}.{name}", whole[part][name], known[name])
    planner, controller = _acting(raw)
    return Config(task=raw["task"], preset=raw["preset"], model=_model(whole["model"]), train=_train(whole),
                  planner=PlannerConfig(**planner), controller=ControllerConfig(**controller))


def _refuse_unless(holds: bool, name: str, got: Any, expected: Any) -> None:
    if not holds:
        raise ConfigError(f"the file was made by velap 0.1 with `{name}` = {got!r}; today's velap has {expected!r} there "
                          "and no such option. Use the file with velap 0.1, or train again.")


def _model(old: dict[str, Any]) -> ModelConfig:
    colours, slow, kept = old["moment_colours"], old["slow_features"], old["keep_moments"]
    _refuse_unless((colours, slow, kept) in ((0, 0, False), (MOMENTS, 32, False), (MOMENTS, 0, True)),
                   "model.moment_colours, slow_features, keep_moments", (colours, slow, kept), (MOMENTS, 32, False))
    _refuse_unless(old["command_memory"] in (0.0, MEMORY), "model.command_memory", old["command_memory"], MEMORY)
    commands = 0 if old["command_memory"] == 0 else old["command_dims"]
    _refuse_unless(commands > 0 or old["command_memory"] == 0, "model.command_dims", commands, "the number of actions")
    encoder = "conv" if not colours else "moments" if kept else "slow-moments"
    return ModelConfig(encoder=encoder, latent_dim=old["latent_dim"] - slow - kept * 6 * colours, command_dims=commands,
                       **{name: old[name] for name in CARRIED["model"]})


def _train(whole: dict[str, dict[str, Any]]) -> TrainConfig:
    old = whole["train"]
    relative = old["critic_loss"] == "cross_entropy"
    _refuse_unless(old["policy_relative"] == relative, "train.policy_relative", old["policy_relative"], relative)
    phases = tuple(_phases(old))
    _refuse_unless(old["heads_afresh"] == (old["joint_steps"] == 0 and whole["model"]["command_memory"] > 0),
                   "train.heads_afresh", old["heads_afresh"], not old["heads_afresh"])
    config = TrainConfig(phases=phases, **{name: old[name] for name in CARRIED["train"]})
    has = whole["model"]["success_policy"]
    _refuse_unless(has == config.clones, "model.success_policy", has, config.clones)
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
        _refuse_unless(old["distil_steps"] == DISTIL, "train.distil_steps", old["distil_steps"], DISTIL)
    if old["clone_steps"]:
        phases.append(ClonePhase(old["clone_steps"], candidates=old["clone_candidates"]))
    return phases
