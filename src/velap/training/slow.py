"""What an encoder of colour moments learns before the joint phase (ours): the moments, and slow features of them.

What a scene is (where a drawer stands, how far it is open) changes slowly or not at all in an episode, and is a small share
of the moments' variance: an arm covers more. Slow feature analysis (Wiskott and Sejnowski 2002) finds the directions of the
moments that change least in a few steps, each with variance one, so that a drawer counts as much as an arm.

F frames of the data, C moments, S slow features, P pairs.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import eigh
from torch import Tensor

from velap.config.training import TrainConfig
from velap.data.sampling import WindowSampler
from velap.losses import Info
from velap.models.encoders.moments import MomentEncoder
from velap.models.networks import MLP
from velap.models.velap import LatentModel
from velap.training.latents import all_moments
from velap.training.pairs import Pairs

PALETTE_FRAMES = 2_000
"""Of the data that the palette is learnt from."""
SLOW = 32
"""Slow features."""
LAG = 10
"""They change least in so many steps [steps]."""
RIDGE = 1e-3
"""Added to every direction's variance before directions are compared."""
RESIDUAL = 0.5
"""Weight of what slow features differ by from their mean over the episode; that mean and the moments weigh 1."""


def fit_palette(encoder: MomentEncoder, sampler: WindowSampler, seed: int) -> None:
    """Palette and scale of the moments from frames all over the data."""
    rows = np.linspace(0, len(sampler.frames) - 1, min(PALETTE_FRAMES, len(sampler.frames))).astype(np.int64)
    frames = sampler.frames[torch.from_numpy(rows).to(sampler.device)]
    encoder.moments.fit(frames.cpu().numpy(), seed)


def slow_features(moments: Tensor, last: Tensor, count: int = SLOW) -> tuple[Tensor, Tensor]:
    """The `count` linear features of moments [F, C] that change least: mean [C] and directions [C, count], so that
    (moments - mean) @ directions has zero mean and variance one.

    last: int64 [F], last row of each row's episode. Where no episode is longer than `LAG`, each row is compared with that.
    """
    rows = torch.arange(len(moments), device=moments.device)
    ahead = torch.minimum(rows + LAG, last)
    if bool((rows + LAG <= last).any()):
        kept = rows + LAG <= last
        rows, ahead = rows[kept], ahead[kept]
    mean = moments.mean(0)
    centred = moments - mean
    change = moments[ahead] - moments[rows]
    ridge = RIDGE * np.eye(moments.shape[1])
    spread, fast = (part.T @ part / len(part) for part in (centred, change))
    _, found = eigh(fast.double().cpu().numpy() + ridge, spread.double().cpu().numpy() + ridge)
    directions = torch.from_numpy(found[:, :count]).to(moments)
    return mean, directions / (centred @ directions).std(0).clamp(min=1e-6)


class MomentObjective(Pairs):
    """Multi-step inverse dynamics, the moments of the newest frame, and the slow features of it: their means over the
    episode, which hold no accident of the moment, and the rest. Moments of all frames are measured once."""

    HIDDEN_MOMENTS = (256,)

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, generator: torch.Generator) -> None:
        super().__init__(model, config, sampler, generator)
        moments = 6 * model.config.moment_colours
        latent = model.config.learnt_dim
        self.slow = min(max(SLOW, model.config.slow_features), moments)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed() + 1)
            self.moments_head = MLP(latent, self.HIDDEN_MOMENTS, moments, "layer").to(sampler.device)
            self.slow_head = MLP(latent, (), 2 * self.slow, "layer").to(sampler.device)
        self.measured: Tensor | None = None
        """float32 [F, C], standardised moments of all frames; see `prepare`."""

    @torch.no_grad()
    def prepare(self, model: LatentModel) -> None:
        """Measure the moments of all frames and find the slow features, where that is still to do."""
        if self.measured is not None:
            return
        assert isinstance(model.encoder, MomentEncoder), "moment_colours is 0"
        sampler = self.sampler
        measured = all_moments(model.encoder, sampler)
        middle, directions = slow_features(measured, sampler.last, self.slow)
        model.encoder.keep_slow(middle, directions)
        features = (measured - middle) @ directions
        numbers = torch.unique(sampler.first, return_inverse=True)[1]
        sums = torch.zeros(int(numbers.max()) + 1, self.slow, device=sampler.device).index_add_(0, numbers, features)
        mean = (sums / torch.bincount(numbers).unsqueeze(1))[numbers]
        parts = [mean, features - mean]
        self.slow_targets = torch.cat([part / part.std(0).clamp(min=1e-6) for part in parts], 1)
        """float32 [F, 2 S], each of variance one."""
        self.measured = measured

    def stacked(self, rows: Tensor) -> Tensor:
        """Moments of the stacks that end in rows [M]: [M, N, C]."""
        assert self.measured is not None, "prepare comes first"
        return self.measured[self.sampler.stack_rows(rows)]

    def loss(self, model: LatentModel, generator: torch.Generator) -> tuple[Tensor, Info]:
        """`inverse` times the error of the summed actions, plus errors of moments and slow features in their deviations."""
        assert isinstance(model.encoder, MomentEncoder), "moment_colours is 0"
        assert self.measured is not None, "prepare comes first"
        now, then = self.draw(generator)
        rows = torch.cat([now, then])
        latents = model.encoder.learnt(self.stacked(rows))
        displacement, error = self.displacement(latents, now, then)
        moments = (self.moments_head(latents) - self.measured[rows]).square().mean()
        mean, rest = (self.slow_head(latents) - self.slow_targets[rows]).square().chunk(2, -1)
        losses = {"encoder/displacement": error, "encoder/moments": moments.detach(), "encoder/slow": mean.detach().mean()}
        return self.config.inverse * displacement + moments + mean.mean() + RESIDUAL * rest.mean(), losses
