"""What to look at before believing a loss curve: rollout error against displacement, and Q-values against true steps.

Measured on held-out episodes. Letters: F frames, D latent, S starts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from velap.data.sampling import WindowSampler
from velap.models.horizon import steps_from_q
from velap.models.velap import LatentModel
from velap.training.encoding import encode_all, encode_rows, evaluated

HORIZONS = (1, 3, 10)
"""Rollout lengths that are reported [steps]."""


@dataclass(frozen=True)
class Horizon:
    """Every pair of states of held-out episodes that lie `length` steps apart."""

    length: int
    """k [steps]."""
    error: Tensor
    """[S] distance between the k-step prediction of h and the encoded truth [latent distance]."""
    moved: Tensor
    """[S] distance between start and truth [latent distance]."""
    local_steps: Tensor
    """[S] log_γ Q_min from start to truth [steps]."""


@torch.no_grad()
def horizons(
    model: LatentModel, sampler: WindowSampler, episodes: list[tuple[int, int]], lengths: Sequence[int], cache: Tensor | None
) -> list[Horizon]:
    """The pairs at each of `lengths` [steps] that some episode is long enough for.

    `episodes` are (first row, last row) pairs; `cache` [F, D] holds latents when the encoder is frozen.
    """
    found = []
    with evaluated(model):
        if cache is None:
            rows = torch.cat([torch.arange(first, last + 1) for first, last in episodes]).to(sampler.device)
            latents = encode_rows(model, sampler, rows)
            offsets = torch.cumsum(torch.tensor([0] + [last - first + 1 for first, last in episodes]), 0).tolist()
        else:
            rows = torch.arange(len(cache), device=sampler.device)
            latents, offsets = cache, [first for first, _ in episodes]
        for k in lengths:
            starts = [
                torch.arange(o, o + last - first + 1 - k)
                for o, (first, last) in zip(offsets, episodes, strict=False)
                if last - first >= k
            ]
            if not starts:
                continue
            start = torch.cat(starts).to(sampler.device)
            predicted = latents[start]
            for i in range(k):
                predicted = model.step(predicted, sampler.actions[rows[start + i]])
            truth = latents[start + k]
            q_min, _ = model.reach(latents[start], truth)
            found.append(Horizon(k, (predicted - truth).norm(dim=-1), (truth - latents[start]).norm(dim=-1),
                                 steps_from_q(q_min, model.discount)))
    return found


def diagnose(
    model: LatentModel, sampler: WindowSampler, episodes: list[tuple[int, int]], cache: Tensor | None
) -> dict[str, float]:
    """Rollout error and displacement (in one-step lengths), and Q^l in steps, at each of `HORIZONS`; `horizons` in numbers.

    Keys: `rollout/error_k`, `rollout/moved_k` [one-step lengths, NaN where held-out frames do not change], `local/steps_k`
    [steps], `latent/step` [latent distance].
    """
    report: dict[str, float] = {}
    one_step = float("nan")
    for horizon in horizons(model, sampler, episodes, HORIZONS, cache):
        moved = horizon.moved.mean().item()
        if horizon.length == 1:
            report["latent/step"] = moved
            one_step = moved if moved > 0 else one_step
        report[f"rollout/error_{horizon.length}"] = horizon.error.mean().item() / one_step
        report[f"rollout/moved_{horizon.length}"] = moved / one_step
        report[f"local/steps_{horizon.length}"] = horizon.local_steps.median().item()
    return report


@torch.no_grad()
def measure_latents(model: LatentModel, sampler: WindowSampler, generator: torch.Generator) -> None:
    """Sets `step_distance` (upper 5-percentile of one-step latent distances, Table 8) and the bank of dataset latents."""
    latents = encode_all(model, sampler)
    rows = sampler.transitions
    distances = (latents[rows + 1] - latents[rows]).norm(dim=-1)
    model.step_distance.copy_(torch.quantile(distances[:1_000_000].float(), 0.95))
    size = model.config.bank_size
    if size:
        everything = torch.arange(len(latents), device=latents.device)
        order = torch.randperm(len(everything), generator=generator, device=generator.device).to(latents.device)
        picked = everything[order].repeat(-(-size // len(everything)))[:size].sort().values
        model.bank_latents.copy_(latents[picked])
        model.bank_rows.copy_(picked)


GAP_SHARE = 0.9
"""Share of held-out latents that lie within `bank_gap`. ours."""


@torch.no_grad()
def measure_gap(model: LatentModel, sampler: WindowSampler, episodes: list[tuple[int, int]], cache: Tensor | None) -> None:
    """Sets `bank_gap` from held-out episodes, (first row, last row) each, and the bank's latents of the other ones; it stays
    as it is where there are none of either."""
    if not episodes or not model.config.bank_size:
        return
    rows = torch.cat([torch.arange(first, last + 1) for first, last in episodes]).to(sampler.device)
    latents = encode_rows(model, sampler, rows) if cache is None else cache[rows]
    own = torch.isin(model.bank_rows.long(), rows)
    if own.all():
        return
    distance = torch.cdist(latents, model.bank_latents.float()[~own]).amin(1)
    model.bank_gap.copy_(torch.quantile(distance, GAP_SHARE) / model.step_distance.clamp(min=1e-6))
