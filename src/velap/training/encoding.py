"""Latents of a dataset's rows. M rows, F frames of the dataset, D latent, A action dimension."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn

from velap.data.sampling import WindowSampler
from velap.models.encoders.base import in_parts
from velap.models.velap import LatentModel


@contextmanager
def evaluated(*modules: nn.Module) -> Iterator[None]:
    """Within, modules use running statistics (BatchNorm): targets, and critics under the policy loss."""
    trained = [module for module in modules if module.training]
    for module in trained:
        module.eval()
    try:
        yield
    finally:
        for module in trained:
            module.train()


def known_at(model: LatentModel, sampler: WindowSampler, rows: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """What is known at rows int64 [M] beside the frames: the remembered commands [M, A] and the state [M, S]; None for a
    model or data without."""
    return (sampler.commands(rows, model.memory) if model.memory > 0 else None,
            None if sampler.states is None else sampler.states[rows])


def encode_rows(model: LatentModel, sampler: WindowSampler, rows: Tensor, chunk: int = 1024) -> Tensor:
    """Latents of rows of the dataset: int64 [M] -> [M, D]."""
    return in_parts(lambda part: model.encode(sampler.stacks(part), *known_at(model, sampler, part)), rows, chunk)


@torch.no_grad()
def encode_all(model: LatentModel, sampler: WindowSampler, features: Tensor | None = None) -> Tensor:
    """Latents of every frame of the dataset, float32 [F, D], running statistics; `features` [F, ...] of the frames, where
    they were measured before."""
    rows = torch.arange(len(sampler.frames), device=sampler.device)
    with evaluated(model):
        measured = model.encoder.measure(sampler.frames) if features is None else features
        seen = in_parts(lambda part: model.encoder.encode(measured[sampler.stack_rows(part)]), rows, model.encoder.chunk)
        return model.with_known(seen, *known_at(model, sampler, rows))
