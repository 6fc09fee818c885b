"""Latents of a dataset's rows. M rows, F frames of the dataset, D latent, A action dimension."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from velap.data.windows import WindowSampler
from velap.models.latent import LatentModel


@contextmanager
def evaluated(*modules: nn.Module) -> Iterator[None]:
    """Modules that are only evaluated use running statistics (BatchNorm): targets, and critics under the policy loss."""
    trained = [module for module in modules if module.training]
    for module in trained:
        module.eval()
    try:
        yield
    finally:
        for module in trained:
            module.train()


def commands_before(model: LatentModel, sampler: WindowSampler, rows: Tensor) -> Tensor | None:
    """What the model remembers of the actions before rows: int64 [M] -> [M, A]; None where it has no memory of them."""
    memory = model.config.command_memory
    return sampler.commands(rows, memory) if memory > 0 else None


def encode_rows(model: LatentModel, sampler: WindowSampler, rows: Tensor, chunk: int = 1024) -> Tensor:
    """Latents of rows of the dataset: int64 [M] -> [M, D]."""
    parts = rows.split(chunk)
    return torch.cat([model.encode(sampler.stacks(part), commands_before(model, sampler, part)) for part in parts])


@torch.no_grad()
def encode_all(model: LatentModel, sampler: WindowSampler) -> Tensor:
    """Latents of every frame of the dataset, float32 [F, D], running statistics."""
    with evaluated(model):
        return encode_rows(model, sampler, torch.arange(len(sampler.frames), device=sampler.device))
