"""VELAP: value-guided expansive latent planning for sparse-reward offline reinforcement learning from images (CoRL 2023).

The names below load on first use, so that `import velap` and the command line start at once.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from velap._version import __version__
from velap.registry import register_encoder, register_method, register_planner, register_reader, register_task

if TYPE_CHECKING:
    from velap.api import evaluate, load, make_dataset, train
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
        ValuePhase,
    )
    from velap.data.frames import Episode, FrameStore
    from velap.data.loading import load_store
    from velap.models.velap import LatentModel
    from velap.tasks import make_config

_HOMES = {
    "velap.api": ("evaluate", "load", "make_dataset", "train"),
    "velap.config": ("ClonePhase", "Config", "ControllerConfig", "EncoderPhase", "EnsemblePhase", "JointPhase",
                     "LatentPhase", "ModelConfig", "PlannerConfig", "TrainConfig", "ValuePhase"),
    "velap.data.frames": ("Episode", "FrameStore"),
    "velap.data.loading": ("load_store",),
    "velap.models.velap": ("LatentModel",),
    "velap.tasks": ("make_config",),
}
"""Modules of the names that load on first use."""

__all__ = [
    "ClonePhase", "Config", "ControllerConfig", "EncoderPhase", "EnsemblePhase", "Episode", "FrameStore",
    "JointPhase", "LatentModel", "LatentPhase", "ModelConfig", "PlannerConfig", "TrainConfig", "ValuePhase",
    "__version__", "evaluate", "load", "load_store", "make_config", "make_dataset", "register_encoder",
    "register_method", "register_planner", "register_reader", "register_task", "train",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module 'velap' has no attribute {name!r}; it has {', '.join(__all__)}")


def __dir__() -> list[str]:
    return __all__
