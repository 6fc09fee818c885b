"""The state of a training as one checksummed file: networks, optimisers, generator. No pickle."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from velap.errors import CheckpointError
from velap.runs import load_tensors, save_tensors

STATE_FORMAT = "velap-training-state/2"


def save_state(path: Path, modules: Mapping[str, nn.Module], optimizers: Mapping[str, torch.optim.Optimizer],
               generator: torch.Generator, metadata: Mapping[str, str]) -> None:
    """Write everything that a resume to the same bits needs, atomically."""
    tensors: dict[str, Tensor] = {}
    for name, module in modules.items():
        tensors |= {f"module/{name}/{key}": value for key, value in module.state_dict().items()}
    for name, optimizer in optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            tensors |= {f"optimizer/{name}/{index}/{key}": torch.as_tensor(value) for key, value in moments.items()}
    tensors["generator"] = generator.get_state()
    save_tensors(path, tensors, {**metadata, "format": STATE_FORMAT})


class SavedState:
    """A state that was read; its parts go back where they came from, in any order."""

    def __init__(self, path: Path) -> None:
        """Raises CheckpointError for a file that is no state of today's format."""
        self.path = path
        self._tensors, self.metadata = load_tensors(path)
        found = self.metadata.get("format")
        if found != STATE_FORMAT:
            raise CheckpointError(f"{path} has format {found!r}; expected {STATE_FORMAT!r}. An unfinished training of "
                                  "another version of velap goes on with that one; otherwise start a new run elsewhere "
                                  "with --out.")

    def require(self, identity: Mapping[str, str]) -> None:
        """Raises CheckpointError where what must agree differs from what was saved."""
        for key, value in identity.items():
            saved = self.metadata.get(key, "none")
            if saved != value:
                raise CheckpointError(
                    f"{self.path} was made with another {key}: it has {_short(saved, value)}, this command has "
                    f"{_short(value, saved)}. Resume with the same task, preset, seed and dataset, or start a new run "
                    "elsewhere with --out.")

    def modules(self, modules: Mapping[str, nn.Module]) -> None:
        """Load networks."""
        for name, module in modules.items():
            module.load_state_dict(_under(f"module/{name}/", self._tensors))

    def optimizers(self, optimizers: Mapping[str, torch.optim.Optimizer]) -> None:
        """Load moments, with the strides of their parameter: the fused update walks memory."""
        for name, optimizer in optimizers.items():
            parameters = optimizer.param_groups[0]["params"]
            state: dict[int, dict[str, Tensor]] = {}
            for key, value in _under(f"optimizer/{name}/", self._tensors).items():
                index, field = key.split("/")
                like = parameters[int(index)]
                kept = torch.empty_like(like).copy_(value) if value.shape == like.shape else value
                state.setdefault(int(index), {})[field] = kept
            optimizer.load_state_dict({"state": state, "param_groups": optimizer.state_dict()["param_groups"]})

    def generator(self, generator: torch.Generator) -> None:
        """Load random numbers."""
        generator.set_state(self._tensors["generator"])


def _under(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors below a prefix, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def _short(text: str, other: str, width: int = 60) -> str:
    """The part of `text` around its first difference from `other`."""
    at = next((i for i, (a, b) in enumerate(zip(text, other, strict=False)) if a != b), 0)
    start = max(at - width // 2, 0)
    return ("…" if start else "") + text[start : start + width] + ("…" if start + width < len(text) else "")
