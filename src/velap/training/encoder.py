"""What the encoder learns before the joint phase (ours): where things are, and what the actions between two states were.

M frames, F frames of the data, P pairs, N frames of a stack, D learnt dimensions of the latent, A action dimension.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from velap.config import EncoderPhase
from velap.data.commands import remembered
from velap.data.sampling import WindowSampler
from velap.losses import Info, displacement_loss, reconstruction_loss
from velap.models.encoders.base import Target
from velap.models.networks import MLP
from velap.models.velap import LatentModel
from velap.training.capture import adam
from velap.training.phase import PhaseLearner, Run
from velap.training.steps import cosine

LEARNING_RATE = 1e-3
"""Peak learning rate, cosine to a hundredth. ours."""
REACH = 20
"""Most steps between the two states of a pair [steps]. ours."""
INVERSE = (256, 256)
"""Hidden layers of the inverse model. ours."""
SIDE = 32
"""Side of the frames that are reconstructed [px]. ours."""


class FrameDecoder(MLP):
    """Latents → the newest frame of the stack, shrunk (ours). It learns beside the encoder and is thrown away."""

    FRAMES = 160
    """Frames a batch that are decoded: more cost more than they teach."""
    WIDTH = 16
    """Hidden units for each pixel of the side."""

    def __init__(self, inputs: int, side: int, sampler: WindowSampler, seed: int) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            super().__init__(inputs, (self.WIDTH * side,), 3 * side**2, "layer")
        self.side = side
        """Of the shrunk frames [px]."""
        self.to(sampler.device)
        step = max(len(sampler.frames) // 2048, 1)
        sample = self.shrink(sampler.frames[torch.arange(0, len(sampler.frames), step, device=sampler.device)])
        self.mean = sample.mean(0)
        """float32 [C], mean frame of the data."""
        self.deviation = (sample - self.mean).square().mean().sqrt().clamp(min=1e-3)
        """float32 [], of the data from it."""

    def shrink(self, frames: Tensor) -> Tensor:
        """uint8 [M, H, W, 3] → float32 [M, 3 · side²] in [0, 1]."""
        return nn.functional.adaptive_avg_pool2d(frames.permute(0, 3, 1, 2).float() / 255, self.side).flatten(1)

    def loss(self, latents: Tensor, frames: Tensor, generator: torch.Generator) -> tuple[Tensor, Info]:
        """Reconstruction loss of some of the frames. latents [M, D]; frames uint8 [M, H, W, 3]."""
        chosen = torch.randperm(len(latents), generator=generator, device=latents.device)[: self.FRAMES]
        return reconstruction_loss(self(latents[chosen]), self.shrink(frames[chosen]), self.mean, self.deviation)


class TargetHeads(nn.Module):
    """Small networks that predict an encoder's own targets from its latents."""

    def __init__(self, inputs: int, targets: tuple[Target, ...], sampler: WindowSampler, seed: int) -> None:
        super().__init__()
        self.targets = targets
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.heads = nn.ModuleList(
                MLP(inputs, target.hidden, sum(part.shape[1] for part in target.parts), "layer") for target in targets)
        self.to(sampler.device)
        self.values = [torch.cat(target.parts, 1) for target in targets]
        """float32 [F, C] each."""

    def loss(self, latents: Tensor, rows: Tensor) -> tuple[Tensor, Info]:
        """Weighted mean-squared errors of all parts. latents [M, D], rows int64 [M]."""
        total, info = torch.zeros((), device=latents.device), Info()
        for target, head, values in zip(self.targets, self.heads, self.values, strict=True):
            errors = (head(latents) - values[rows]).square().chunk(len(target.parts), -1)
            for weight, error in zip(target.weights, errors, strict=True):
                total = total + weight * error.mean()
            info[f"encoder/{target.name}"] = errors[0].detach().mean()
        return total, info


class Pairs(NamedTuple):
    """States of one trajectory."""

    now: Tensor
    """int64 [P] rows."""
    then: Tensor
    """int64 [P] rows, at most `REACH` steps later."""


def draw_pairs(sampler: WindowSampler, count: int, generator: torch.Generator) -> Pairs:
    """Pairs from all over the data."""
    pool, device = sampler.transitions, sampler.device
    now = pool[torch.randint(len(pool), (count,), generator=generator, device=device)]
    ahead = torch.randint(1, REACH + 1, (count,), generator=generator, device=device)
    return Pairs(now, torch.minimum(now + ahead, sampler.last[now]))


def actions_before(model: LatentModel, sampler: WindowSampler) -> Tensor:
    """Sum of all actions before each row, or of their leaky mean where the latent holds it: what lags behind its commands
    has gone as far as that mean says. float64 [F, A]."""
    moved = sampler.actions
    if model.memory > 0:
        rows = torch.arange(len(moved), device=sampler.device)
        moved = remembered(sampler.commands(rows, model.memory), moved, model.memory)
    return moved.double().cumsum(0) - moved


class EncoderLearner(PhaseLearner[EncoderPhase]):
    """Multi-step inverse dynamics on pairs of states, and what the encoder is to tell of each: its own targets, or the
    pixels.

    Windows of neighbouring scenes, which the joint phase needs, are few different pictures. What is learnt beside the
    encoder is thrown away.
    """

    def __init__(self, phase: EncoderPhase, run: Run) -> None:
        super().__init__(phase, run)
        model, sampler = run.model, run.sampler
        latent = model.encoder.learnt_width(model.config)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(run.weight_seed)
            self.inverse = MLP(2 * latent, INVERSE, sampler.actions.shape[1], "layer").to(sampler.device)
        self.before = actions_before(model, sampler)
        targets = model.encoder.targets(run.features, sampler.first, sampler.last)
        self.teacher: FrameDecoder | TargetHeads = (
            TargetHeads(latent, targets, sampler, run.weight_seed + 1) if targets
            else FrameDecoder(latent, SIDE, sampler, run.weight_seed))
        self.modules = {"inverse": self.inverse, "teacher": self.teacher}
        learnt = (model.encoder, self.inverse, self.teacher)
        self.optimizers = {"encoder": adam([p for part in learnt for p in part.parameters()], LEARNING_RATE)}

    def update(self, done: int) -> Info:
        """One update on fresh pairs."""
        self.set_rate(LEARNING_RATE * cosine(done / self.phase.steps))
        return self.captured("pairs", self._update)

    def _update(self) -> Info:
        optimizer = self.optimizers["encoder"]
        optimizer.zero_grad(set_to_none=True)
        loss, info = self.loss(draw_pairs(self.run.sampler, self.phase.pairs, self.run.generator))
        loss.backward()
        optimizer.step()
        return info

    def loss(self, pairs: Pairs) -> tuple[Tensor, Info]:
        """`inverse` times the error of the summed actions, plus what the encoder is to tell of the states."""
        run, rows = self.run, torch.cat(pairs)
        latents = run.model.encoder.learnt(run.features[run.sampler.stack_rows(rows)])
        truth = (self.before[pairs.then] - self.before[pairs.now]).float()
        displacement, moved = displacement_loss(self.inverse(torch.cat(latents.chunk(2), -1)), truth)
        if isinstance(self.teacher, TargetHeads):
            told, info = self.teacher.loss(latents, rows)
        else:
            told, pixels = self.teacher.loss(latents, run.sampler.frames[rows], run.generator)
            info = {"encoder/reconstruction": pixels["loss"]}
        return self.phase.inverse * displacement + told, {"encoder/displacement": moved["error"], **info}
