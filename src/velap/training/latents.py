"""Latents of a dataset's rows. M rows, F frames of the dataset, D latent, A action dimension."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from velap.data.sampling import WindowSampler
from velap.models.encoders.moments import MomentEncoder
from velap.models.velap import LatentModel


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
def all_moments(encoder: MomentEncoder, sampler: WindowSampler) -> Tensor:
    """Standardised colour moments of every frame of the dataset, float32 [F, C]; a stack would measure its frames again."""
    return torch.cat([encoder.moments(frames) for frames in sampler.frames.split(500)])


@torch.no_grad()
def encode_all(model: LatentModel, sampler: WindowSampler) -> Tensor:
    """Latents of every frame of the dataset, float32 [F, D], running statistics."""
    rows = torch.arange(len(sampler.frames), device=sampler.device)
    with evaluated(model):
        if not isinstance(model.encoder, MomentEncoder):
            return encode_rows(model, sampler, rows)
        moments = all_moments(model.encoder, sampler)
        seen = [model.encoder.from_moments(moments[sampler.stack_rows(part)]) for part in rows.split(4096)]
        return model.with_commands(torch.cat(seen), commands_before(model, sampler, rows))
