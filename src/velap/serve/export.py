"""`velap export`: encoder and policies as programs that run without velap, compared with the model before they are kept.

A program is a file of torch.export; `torch.export.load(file).module()` runs it. `export.json` beside the programs holds
their inputs and outputs, and what else acting needs: bounds of the actions, frames a state, memory of commands.
`*` is the batch, N frames a state, H×W frame [px], D latent, A action.
"""

from __future__ import annotations

import copy
import json
import shutil
import tempfile
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from velap._version import __version__
from velap.config import Config
from velap.errors import ConfigError, VelapError
from velap.models.checkpoint import WEIGHTS_SHA256, load_checkpoint
from velap.models.velap import LatentModel
from velap.runs import storage_errors, write_atomic

EXPORT_FORMAT = "velap-export/1"
DESCRIPTION = "export.json"
BATCHES = (1, 2, 5, 32)
"""Batches that a program is compared on. ours."""
TOLERANCE = 1e-4
"""Largest difference between a program's output and the model's that is let pass; latents and actions are about 1. ours."""
MAX_BATCH = 4096


@dataclass(frozen=True)
class Program:
    """One exported function of the model."""

    file: str
    inputs: tuple[str, ...]
    output: str
    max_difference: float
    """From the model's output, the largest over all entries and `BATCHES`."""


@dataclass(frozen=True)
class _Function:
    """What is exported: a function of the model, and the modules that it reads."""

    name: str
    module: str
    inputs: tuple[str, ...]
    output: str


STATE = "state float32 [*, S]"
FRAMES, COMMANDS = "frames uint8 [*, N, H, W, 3]", "commands float32 [*, A] in [-1, 1]"
LATENT, GOAL, ACTION = "latent float32 [*, D]", "goal float32 [*, D]", "action float32 [*, A] in [-1, 1]"
FUNCTIONS = (
    _Function("encode", "encoder", (FRAMES, COMMANDS), LATENT),
    _Function("act_global", "global_policy", (LATENT,), ACTION),
    _Function("act_local", "local_policy", (LATENT, GOAL), ACTION),
    _Function("success_policy", "success_policy", (LATENT,), ACTION),
)
"""φ, π^g, π^l, and the policies that not every config has."""


def _functions(model: LatentModel) -> list[_Function]:
    """Those of the model; the encoder of one with a state takes it too."""
    found = [function for function in FUNCTIONS if getattr(model, function.module) is not None]
    return [replace(each, inputs=(*each.inputs, STATE)) if each.name == "encode" and model.spaces.state_dim else each
            for each in found]


class _Alone(nn.Module):
    """A function of the model, with a copy of the one module that it reads."""

    def __init__(self, model: LatentModel, function: _Function) -> None:
        super().__init__()
        kept = {id(child): None for name, child in model.named_children() if name != function.module}
        self.model = copy.deepcopy(model, kept)
        self.model.bank_latents, self.model.bank_rows = torch.zeros(1), torch.zeros(1)
        self._function = function.name

    def forward(self, *inputs: Tensor) -> Tensor:
        output: Tensor = getattr(self.model, self._function)(*inputs)
        return output


def export(checkpoint: Path | str, out: Path | str, tolerance: float = TOLERANCE) -> dict[str, Program]:
    """Write the programs of a checkpoint and their description into the new folder `out`; all of them or nothing.

    Raises VelapError where a program read back from its file differs from the model by more than `tolerance`.
    """
    out = Path(out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out} exists and is not an empty folder; expected a new one. Name another with --out.")
    model, config, metadata = load_checkpoint(checkpoint)
    with storage_errors(out):
        out.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    try:
        programs = {function.name: _export(model, function, work, tolerance) for function in _functions(model)}
        description = _describe(model, config, metadata, programs)
        write_atomic(work / DESCRIPTION, (json.dumps(description, indent=2) + "\n").encode())
        with storage_errors(out):
            work.chmod(0o755)
            work.replace(out)
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return programs


def _export(model: LatentModel, function: _Function, folder: Path, tolerance: float) -> Program:
    """Export one function, read it back and compare it with the model."""
    alone, inputs = _Alone(model, function), _inputs(model, function, 2)
    batch = torch.export.Dim("batch", min=1, max=MAX_BATCH)
    path = folder / f"{function.name}.pt2"
    with warnings.catch_warnings(), storage_errors(path):
        warnings.filterwarnings("ignore", module=r"torch\..*")
        program = torch.export.export(alone, inputs, dynamic_shapes={"inputs": tuple({0: batch} for _ in inputs)})
        torch.export.save(program, path)
        read_back = torch.export.load(path).module()
    difference = 0.0
    for size in BATCHES:
        tried = _inputs(model, function, size)
        with torch.no_grad():
            expected, got = getattr(model, function.name)(*tried), read_back(*tried)
        difference = max(difference, float((expected - got).abs().nan_to_num(torch.inf).max()))
    if difference > tolerance:
        raise VelapError(f"the exported {function.name} differs from the model by {difference:.2g}; expected at most "
                         f"{tolerance:.2g}. Nothing was written; allow more with --tolerance where the robot stands it.")
    return Program(path.name, function.inputs, function.output, difference)


def _inputs(model: LatentModel, function: _Function, batch: int) -> tuple[Tensor, ...]:
    """Inputs of noise; the latents are those of frames of noise."""
    generator = torch.Generator().manual_seed(batch)
    shape = (batch, model.config.frame_stack, model.spaces.height, model.spaces.width, 3)

    def draw(kind: str) -> Tensor:
        if kind == STATE:
            noise = torch.randn(batch, model.spaces.state_dim, generator=generator)
            return model.state_mean + noise / model.state_scale.clamp(min=1e-6)
        if kind == COMMANDS:
            return 2 * torch.rand(batch, model.action_dim, generator=generator) - 1
        frames = torch.randint(0, 256, shape, dtype=torch.uint8, generator=generator)
        if kind == FRAMES:
            return frames
        with torch.no_grad():
            return model.encode(frames, draw(COMMANDS), draw(STATE) if model.spaces.state_dim else None)

    return tuple(draw(kind) for kind in function.inputs)


def _describe(model: LatentModel, config: Config, metadata: Mapping[str, str],
              programs: Mapping[str, Program]) -> dict[str, Any]:
    """What `export.json` holds."""
    spaces = model.spaces
    return {
        "format": EXPORT_FORMAT, "velap": __version__, "torch": torch.__version__, "task": config.task,
        "weights_sha256": metadata[WEIGHTS_SHA256], "frame_stack": config.model.frame_stack,
        "image_shape": [spaces.height, spaces.width, 3], "action_low": list(spaces.action_low),
        "action_high": list(spaces.action_high), "command_memory": model.memory, "state_size": model.spaces.state_dim,
        "reading": json.loads(metadata.get("reading", "null")),
        "programs": {name: asdict(program) for name, program in programs.items()},
    }
