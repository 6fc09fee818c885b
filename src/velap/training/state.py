"""The state of a learner as one checksummed file: weights, targets, optimisers, generator. No pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import torch
from torch import Tensor, nn

from velap.errors import CheckpointError
from velap.runs import load_tensors, save_tensors

STATE_FORMAT = "velap-training-state/1"
SCHEDULE = "schedule"
"""Metadata key of what has no effect before its phase begins: whoever resumes compares it."""


class Learner(Protocol):
    """What has a state: the joint learner, and those on frozen latents."""

    generator: torch.Generator
    updates: int
    """Updates so far, for what happens every few of them."""
    cache: Tensor | None
    """float32 [F, D] latents of all frames once the encoder is frozen."""

    @property
    def model(self) -> nn.Module:
        """What is learnt."""
        ...

    @property
    def companions(self) -> Mapping[str, nn.Module]:
        """Networks beside the model by name: targets, and what is thrown away after training."""
        ...

    @property
    def optimizers(self) -> Mapping[str, torch.optim.Optimizer]:
        """Optimisers by name."""
        ...

    def begin_latent_phase(self) -> None:
        """Freeze the encoder and fill the cache, where that is still to do."""
        ...


def save_state(path: Path, learner: Learner, metadata: Mapping[str, str]) -> None:
    """Write everything that a resume to the same bits needs, atomically."""
    tensors = {f"model/{name}": value for name, value in learner.model.state_dict().items()}
    for name, module in learner.companions.items():
        tensors |= {f"target/{name}/{key}": value for key, value in module.state_dict().items()}
    for name, optimizer in learner.optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer/{name}/{index}/{key}": torch.as_tensor(value) for key, value in moments.items()}
    tensors["generator"] = learner.generator.get_state()
    progress = {"updates": str(learner.updates), "latent_phase": str(int(learner.cache is not None))}
    save_tensors(path, tensors, {**metadata, **progress, "format": STATE_FORMAT})


def load_state(path: Path, learner: Learner, identity: Mapping[str, str]) -> dict[str, str]:
    """Restore a learner and return the metadata; raises CheckpointError where `identity` differs from what was saved."""
    tensors, metadata = load_tensors(path)
    for key, value in {"format": STATE_FORMAT, **identity}.items():
        if key != SCHEDULE and metadata.get(key) != value:
            raise CheckpointError(
                f"{path} was made with another {key}: it has {_short(metadata.get(key, 'none'), value)}, this command "
                f"has {_short(value, metadata.get(key, ''))}. Resume with the same task, preset, seed and dataset, or "
                "start a new run elsewhere with --out."
            )
    learner.model.load_state_dict(_under("model/", tensors))
    if metadata["latent_phase"] == "1":
        learner.begin_latent_phase()
    for name, module in learner.companions.items():
        kept = _under(f"target/{name}/", tensors)
        if kept:  # what a phase to come needs did not exist when the state was written
            module.load_state_dict(kept)
    for name, optimizer in learner.optimizers.items():
        _restore(optimizer, _under(f"optimizer/{name}/", tensors))
    learner.generator.set_state(tensors["generator"])
    learner.updates = int(metadata["updates"])
    return metadata


def _restore(optimizer: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Moments `index/field` into the optimiser, with the strides of their parameter: the fused update walks memory."""
    parameters = optimizer.param_groups[0]["params"]
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, field = key.split("/")
        like = parameters[int(index)]
        kept = torch.empty_like(like).copy_(value) if value.shape == like.shape else value
        state.setdefault(int(index), {})[field] = kept
    optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors below a prefix, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _short(text: str, other: str, width: int = 60) -> str:
    """The part of `text` around its first difference from `other`."""
    at = next((i for i, (a, b) in enumerate(zip(text, other, strict=False)) if a != b), 0)
    start = max(at - width // 2, 0)
    return ("…" if start else "") + text[start : start + width] + ("…" if start + width < len(text) else "")
