"""Heads: networks that a method learns on the frozen latents of a joint checkpoint, and their files.

A head sees latents of that checkpoint's encoder only and is of no use without it: its file names the weights it belongs to.
`*` is any batch prefix, D the latent, A the action dimension.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from velap._version import __version__
from velap.config import Config, ModelConfig
from velap.errors import CheckpointError
from velap.methods.base import get_method, learning_methods
from velap.models.checkpoint import WEIGHTS_SHA256, find_checkpoint, restore, shared_weights
from velap.models.encoders.base import latent_width
from velap.models.networks import POLICY, Policy
from velap.registry import METHODS
from velap.runs import content_sha256, load_tensors, save_tensors


class Head(nn.Module, ABC):
    """Base of all heads. `method` and `settings` say what it is: they are kept in its file and enter record hashes.

    A subclass takes the model's config, A and S, `Head(config, action_dim, state_dim)`, and finds D in `self.latent_dim`.
    """

    method: str = ""
    """Name in records and tables."""
    settings: str = "{}"
    """Canonical JSON of the learner's config, all fields."""
    weights_sha256: str = ""
    """Hash of weights and settings, the same for the same training; set by `save_head` and `load_head`."""

    @abstractmethod
    def __init__(self, config: ModelConfig, action_dim: int, state_dim: int = 0) -> None:
        super().__init__()
        self.latent_dim = latent_width(config, action_dim, state_dim)
        """D, what the joint model's latents hold in all."""


class PolicyHead(Head):
    """A policy of Table 5: all that BC learns."""

    def __init__(self, config: ModelConfig, action_dim: int, state_dim: int = 0) -> None:
        super().__init__(config, action_dim, state_dim)
        self.policy = Policy(self.latent_dim, POLICY, action_dim, config.norm)

    def act(self, latent: Tensor) -> Tensor:
        """π: `[*, D] → [*, A]` in [-1, 1]."""
        return self.policy(latent)


HEAD_FORMAT = "velap-head/1"


def head_path(checkpoint: Path | str, method: str) -> Path:
    """Where the head of a method lies: beside the joint checkpoint."""
    return find_checkpoint(checkpoint).with_name(f"{method}.safetensors")


def make_head(method: str, config: ModelConfig, action_dim: int, state_dim: int = 0) -> Head:
    """A fresh head of that method; raises UnknownTaskError for a method without one."""
    kind = get_method(method)
    if kind.head is None:
        raise kind.nothing_to_learn()
    head = kind.head(config, action_dim, *([state_dim] if state_dim else []))
    head.method = method
    return head


def save_head(path: Path, head: Head, joint_metadata: Mapping[str, str], provenance: Mapping[str, str]) -> str:
    """One safetensors file with weights, method, settings, the joint weights it belongs to and provenance; returns its
    SHA-256."""
    weights = head.state_dict()
    head.weights_sha256 = content_sha256(weights, {"method": head.method, "settings": head.settings})
    metadata = {
        **provenance,
        WEIGHTS_SHA256: head.weights_sha256,
        "format": HEAD_FORMAT,
        "method": head.method,
        "head_config": head.settings,
        "joint": shared_weights(joint_metadata),
        "code_version": __version__,
    }
    return save_tensors(path, weights, metadata)


def load_head(path: Path | str, joint_metadata: Mapping[str, str], device: torch.device | str = "cpu") -> Head:
    """Head in eval mode for the joint checkpoint with this metadata (of `load_checkpoint`).

    Raises CheckpointError when the file is missing, damaged, no head, or belongs to other joint weights.
    """
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(f"no head at {path}; expected the file that `velap train TASK --method {path.stem}` writes "
                              "beside the joint checkpoint. Train it, or name another file.")
    tensors, metadata = load_tensors(path)
    method = metadata.get("method", "")
    found = metadata.get("format")
    if found != HEAD_FORMAT or method not in METHODS or not get_method(method).learns:
        raise CheckpointError(f"{path} has format {found!r} and method {method!r}; expected {HEAD_FORMAT!r} and one of "
                              f"{', '.join(learning_methods())}. Give the file that `velap train --method` wrote.")
    own, given = metadata.get("joint", "none"), shared_weights(joint_metadata)
    if own != given:
        raise CheckpointError(f"{path} is foreign to this joint checkpoint: it was learnt on the latents of weights "
                              f"{own[:12]}, the checkpoint has {given[:12]}. Train it again with `velap train --method "
                              f"{method}`, or give the checkpoint that lies beside it.")
    config = Config.from_json(joint_metadata["config"])
    spaces = json.loads(joint_metadata["spaces"])
    head = make_head(method, config.model, len(spaces["action_low"]), len(spaces.get("state_mean", ())))
    restore(head, tensors, path)
    head.settings, head.weights_sha256 = metadata["head_config"], metadata[WEIGHTS_SHA256]
    return head.to(device).eval().requires_grad_(False)
