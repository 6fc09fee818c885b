"""What the presets change beyond the fields' own defaults; `tasks.py` applies it, and the per-task overrides after it."""

from __future__ import annotations

from typing import Any

DEFAULT_TRAIN: dict[str, Any] = {
    "joint_steps": 5_000,
    "group_windows": 6,
    "group_reach": 4,
    "reconstruction": 0.05,
}
"""The default preset beyond the fields' own defaults: training for many scenes."""
DEFAULT_CONTROLLER: dict[str, Any] = {"residuals": 40, "n_replan": 8, "waypoint_exponent": 1.5}
"""The default preset beyond the fields' own defaults: models of new scenes err at corners."""
ONE_SCENE: dict[str, dict[str, Any]] = {
    "train": {
        "joint_steps": 4_000,
        "group_windows": 1,
        "group_reach": 8,
        "reconstruction": 0.0,
    },
    "controller": {"residuals": 0, "n_replan": 15, "waypoint_exponent": 3.0},
}
"""What replaces both where all episodes share one scene: there a short training knows it exactly."""
PAPER_MODEL: dict[str, Any] = {
    "norm": "batch",
    "dynamics_residual": False,
    "critic_bounded": False,
    "n_global": 1,
    "bank_size": 0,
}
PAPER_TRAIN: dict[str, Any] = {
    "batch_windows": 64,
    "window": 3,
    "whole_windows": False,
    "value_transitions": 0,
    "dynamics_rollouts": 0,
    "latent_steps": 0,
    "rewarded_share": 0.0,
    "target_rate": 0.005,
    "policy_every": 1,
    "joint_steps": 24_000,
}
PAPER_CONTROLLER: dict[str, Any] = {"lookahead": 0}
PAPER_PLANNER: dict[str, Any] = {
    "coherent_noise": False,
    "expansion_weight": 0.0,
    "anchor": "none",
    "discard_low_exponent": None,
}
