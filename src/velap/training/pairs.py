"""What the encoder learns before the joint phase (ours): where things are, and what the actions between two states were.

M frames, P pairs, N frames of a stack, D latent, A action dimension.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from velap.config.training import TrainConfig
from velap.data.commands import remembered
from velap.data.sampling import WindowSampler
from velap.losses import Info, displacement_loss, reconstruction_loss
from velap.models.networks import MLP
from velap.models.velap import LatentModel


class FrameDecoder(MLP):
    """Latents → the newest frame of the stack, shrunk (ours). It learns beside the encoder and is thrown away."""

    FRAMES = 160
    """Frames a batch that are decoded: more cost more than they teach."""
    WIDTH = 16
    """Hidden units for each pixel of the side."""

    def __init__(self, model: LatentModel, side: int, sampler: WindowSampler, generator: torch.Generator) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed())
            super().__init__(model.config.latent_dim, (self.WIDTH * side,), 3 * side**2, "layer")
        self.side = side
        """Of the shrunk frames [px]."""
        self.to(sampler.device)
        step = max(len(sampler.frames) // 2048, 1)
        sample = self.shrink(sampler.stacks(torch.arange(0, len(sampler.frames), step, device=sampler.device)))
        self.mean = sample.mean(0)
        """float32 [C], mean frame of the data."""
        self.deviation = (sample - self.mean).square().mean().sqrt().clamp(min=1e-3)
        """float32 [], of the data from it."""

    def shrink(self, stacks: Tensor) -> Tensor:
        """uint8 [M, N, H, W, 3] → the newest frames, float32 [M, 3 · side²] in [0, 1]."""
        newest = stacks[:, -1].permute(0, 3, 1, 2).float() / 255
        return nn.functional.adaptive_avg_pool2d(newest, self.side).flatten(1)

    def loss(self, latents: Tensor, stacks: Tensor, generator: torch.Generator) -> tuple[Tensor, Info]:
        """Reconstruction loss of some of the frames. latents [M, D]; stacks uint8 [M, N, H, W, 3]."""
        chosen = torch.randperm(len(latents), generator=generator, device=latents.device)[: self.FRAMES]
        return reconstruction_loss(self(latents[chosen]), self.shrink(stacks[chosen]), self.mean, self.deviation)


class Pairs(nn.Module):
    """Pairs of states of one trajectory, from all over the data, and a multi-step inverse model on them.

    Windows of neighbouring scenes, which the joint phase needs, are few different pictures. What is learnt beside the
    encoder is thrown away.
    """

    HIDDEN = (256, 256)
    """Layers of the inverse model."""
    REACH = 20
    """Most steps between the two states of a pair [steps]. ours."""

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, generator: torch.Generator) -> None:
        super().__init__()
        self.config, self.sampler = config, sampler
        actions = sampler.actions.shape[1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed())
            self.inverse = MLP(2 * model.config.learnt_dim, self.HIDDEN, actions, "layer").to(sampler.device)
        moved, memory = sampler.actions, model.config.command_memory
        if memory > 0:
            moved = remembered(sampler.commands(torch.arange(len(moved), device=sampler.device), memory), moved, memory)
        self.before = moved.double().cumsum(0) - moved
        """float64 [F, A], sum of all actions before each row, or of their leaky mean where the model has a memory of them:
        what lags behind its commands has gone as far as that mean says."""

    def draw(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Rows int64 [P] of a state and of one at most `REACH` steps later in the same episode."""
        sampler, shape = self.sampler, (self.config.encoder_pairs,)
        pool, device = sampler.transitions, sampler.device
        now = pool[torch.randint(len(pool), shape, generator=generator, device=device)]
        ahead = torch.randint(1, self.REACH + 1, shape, generator=generator, device=device)
        return now, torch.minimum(now + ahead, sampler.last[now])

    def displacement(self, latents: Tensor, now: Tensor, then: Tensor) -> tuple[Tensor, Tensor]:
        """Loss of the inverse model between rows `now` and `then` [P], whose latents stand one after the other [2 P, D], and
        its error."""
        truth = (self.before[then] - self.before[now]).float()
        loss, info = displacement_loss(self.inverse(torch.cat(latents.chunk(2), -1)), truth)
        return loss, info["error"]


class PairObjective(Pairs):
    """Multi-step inverse dynamics and reconstruction of single frames."""

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, generator: torch.Generator) -> None:
        super().__init__(model, config, sampler, generator)
        self.decoder = FrameDecoder(model, config.reconstruction_side, sampler, generator)

    def loss(self, model: LatentModel, generator: torch.Generator) -> tuple[Tensor, Info]:
        """`inverse` times the error of the summed actions, plus the reconstruction loss of at most `FRAMES` frames."""
        now, then = self.draw(generator)
        stacks = self.sampler.stacks(torch.cat([now, then]))
        latents = model.encoder(stacks)
        displacement, error = self.displacement(latents, now, then)
        pixels, seen = self.decoder.loss(latents, stacks, generator)
        losses = {"encoder/displacement": error, "encoder/reconstruction": seen["loss"]}
        return self.config.inverse * displacement + pixels, losses
