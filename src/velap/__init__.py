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

__all__ = [
    "__version__", "evaluate", "load", "make_dataset", "register_encoder", "register_method", "register_planner",
    "register_reader", "register_task", "train",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module 'velap' has no attribute {name!r}; it has {', '.join(__all__)}")
    return getattr(import_module("velap.api"), name)


def __dir__() -> list[str]:
    return __all__
