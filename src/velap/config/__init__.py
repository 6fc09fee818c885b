"""Frozen, typed configuration. Each default cites the table of the paper it comes from, or says `ours` and why."""

from velap.config.model import ModelConfig, Norm
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.serialise import Config, describe, override
from velap.config.training import (
    ClonePhase,
    EncoderPhase,
    EnsemblePhase,
    JointPhase,
    LatentPhase,
    Phase,
    TrainConfig,
    ValuePhase,
)

__all__ = [
    "ClonePhase", "Config", "ControllerConfig", "EncoderPhase", "EnsemblePhase", "JointPhase", "LatentPhase", "ModelConfig",
    "Norm", "Phase", "PlannerConfig", "TrainConfig", "ValuePhase", "describe", "override",
]
