"""Phases of Figures 5 and 6: those of the package, with a choice of the losses that shape φ and of the loss of h.

In `ObjectivePhase` dynamics, critics, policies and g learn by the same losses on the same batches whatever shapes φ: only
the gradient into φ differs. Letters: M latents of a batch, D latent.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import JointPhase, LatentPhase, ModelConfig
from velap.config.training import DYNAMICS_HORIZON, PHASES, DynamicsLoss
from velap.data.sampling import Batch, FirstTransitions
from velap.losses import Info, infonce_loss, model_loss, rollout_mse_loss, weighted_mean
from velap.models.encoders.conv import ConvEncoder
from velap.models.networks import MLP
from velap.models.velap import LatentModel
from velap.registry import register_encoder
from velap.training.capture import adam
from velap.training.encoder import INVERSE
from velap.training.encoding import known_at
from velap.training.joint import LEARNING_RATE, RECONSTRUCTION, JointLearner, rollouts
from velap.training.latent import LATENT_BATCH, LatentLearner
from velap.training.loop import ON_FRAMES, ON_LATENTS
from velap.training.phase import Run, few_threads

Objective = Literal["joint", "contrastive", "values", "reconstruction", "inverse", "none"]
SHAPED_BY: dict[str, tuple[str, ...]] = {
    "joint": ("dynamics", "values"), "contrastive": ("dynamics",), "values": ("values",), "reconstruction": ("pixels",),
    "inverse": ("actions",), "none": (),
}
"""Losses whose gradient reaches φ. `joint` is Eq. 2."""


@dataclass(frozen=True)
class ObjectivePhase(JointPhase):
    """The joint phase, in which the losses of one objective alone shape φ."""

    name: ClassVar[str] = "objective"

    objective: Objective = "joint"
    """A key of `SHAPED_BY`."""
    horizon: int = DYNAMICS_HORIZON
    """k, steps that h is unrolled [steps]."""


@dataclass(frozen=True)
class DynamicsPhase(LatentPhase):
    """The latent phase, in which h goes on by the loss that it had on frames."""

    name: ClassVar[str] = "dynamics"

    dynamics_loss: DynamicsLoss = "infonce"


@contextlib.contextmanager
def known_phases() -> Iterator[None]:
    """Within, trainings and checkpoints may have the phases of this module; the package's own commands never see them."""
    tables: tuple[dict[Any, Any], ...] = (PHASES, ON_FRAMES, ON_LATENTS)
    before = [dict(table) for table in tables]
    PHASES.update({kind.name: kind for kind in (ObjectivePhase, DynamicsPhase)})
    ON_FRAMES[ObjectivePhase], ON_LATENTS[DynamicsPhase] = ObjectiveLearner, DynamicsLearner
    try:
        yield
    finally:
        for table, content in zip(tables, before, strict=True):
            table.clear()
            table.update(content)


def dynamics_loss(model: LatentModel, latents: Tensor, batch: Batch, kind: str, horizon: int,
                  square: Tensor) -> tuple[Tensor, Info]:
    """Eq. 9, or the mean-squared error of App. E.3 in units of `square`, over `horizon` steps. latents [M, D]."""
    predicted, truth, valid = rollouts(model, latents, batch, horizon)
    if kind == "mse":
        return rollout_mse_loss(predicted, latents[truth], valid, square)
    windows, length = batch.valid.shape
    known = model.seen_dim  # what is known beside the frames would tell the candidates apart in place of φ
    return infonce_loss(predicted[..., :known], truth, latents[: windows * (length + 1), :known], valid)


class ObjectiveLearner(JointLearner):
    """The joint training with a choice of what shapes φ."""

    phase: ObjectivePhase

    def __init__(self, phase: ObjectivePhase, run: Run) -> None:
        super().__init__(phase, run)
        self.shaped_by = SHAPED_BY[phase.objective]
        if "actions" in self.shaped_by:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(run.weight_seed)
                self.inverse = MLP(2 * run.model.seen_dim, INVERSE, run.sampler.actions.shape[1], "layer")
            self.inverse.to(run.sampler.device)
            self.modules = {**self.modules, "inverse": self.inverse}
            self.optimizers["inverse"] = adam(self.inverse.parameters(), LEARNING_RATE)

    def _update(self, policies: bool) -> Info:
        run, model, config = self.run, self.run.model, self.run.config
        batch = run.sampler.sample(self.draw, run.generator, self.phase.rewarded_share)
        steps = [optimizer for name, optimizer in self.optimizers.items() if name != "policy"]
        for optimizer in steps:
            optimizer.zero_grad(set_to_none=True)
        seen = model.encoder.encode(run.features[run.sampler.stack_rows(batch.rows)])
        latents = model.with_known(seen, *known_at(model, run.sampler, batch.rows))
        fixed = latents.detach()
        with few_threads(batch):
            dynamics, info = dynamics_loss(model, latents if "dynamics" in self.shaped_by else fixed, batch,
                                           self.phase.dynamics_loss, self.phase.horizon, torch.ones((), device=seen.device))
            local, task, more = run.actor_critic.critic_losses(latents if "values" in self.shaped_by else fixed, batch)
            loss = model_loss(local, task, dynamics, config.c0, self.phase.c1)  # Eq. 2
            info = {"dynamics/loss": info["loss"], **more}
            if "pixels" in self.shaped_by:
                assert self.decoder is not None, "the phase asks for one by `reconstruction_side`"
                pixels, told = self.decoder.loss(seen, run.sampler.frames[batch.rows], run.generator)
                loss, info["reconstruction/loss"] = loss + RECONSTRUCTION * pixels, told["loss"]
            if "actions" in self.shaped_by:
                actions = inverse_loss(self.inverse, seen, batch)
                loss, info["inverse/loss"] = loss + actions, actions.detach()
            loss.backward()
            for optimizer in steps:
                optimizer.step()
            run.actor_critic.follow()
            if policies:  # Eq. 5
                info |= run.actor_critic.improve_policies(self.optimizers["policy"], fixed, batch, run.generator)
        return info


def inverse_loss(inverse: nn.Module, seen: Tensor, batch: Batch) -> Tensor:
    """Squared error of the action between a state and the next one. seen [M, D]."""
    between = inverse(torch.cat([seen[batch.now_at], seen[batch.now_at + 1]], -1))
    return weighted_mean((between - batch.action).square().mean(-1), batch.weight)


class DynamicsLearner(LatentLearner):
    """h by the loss of the phase, critics by Eq. 3 and 4, policies by Eq. 5, and g, on frozen latents."""

    phase: DynamicsPhase

    def _update(self, policies: bool) -> Info:
        run, phase = self.run, self.phase
        batch = run.sampler.sample(FirstTransitions(LATENT_BATCH, phase.horizon), run.generator, phase.rewarded_share)
        latents = self.frozen.latents[batch.rows]
        self.optimizers["model"].zero_grad(set_to_none=True)
        with few_threads(batch):
            dynamics, info = dynamics_loss(run.model, latents, batch, phase.dynamics_loss, phase.horizon,
                                           self.frozen.step_square)
            local, task, more = run.actor_critic.critic_losses(latents, batch)
            model_loss(local, task, dynamics, run.config.c0, 1.0).backward()
            self.optimizers["model"].step()
            run.actor_critic.follow()
            info = {"dynamics/loss": info["loss"], **more}
            if policies:
                info |= run.actor_critic.improve_policies(self.optimizers["policy"], latents, batch, run.generator)
        return info


@register_encoder("random-conv")
class RandomConvEncoder(ConvEncoder):
    """Table 2 with the weights that it starts with; its outputs are standardised over the data."""

    SAMPLE = 1000
    """Frames that mean and deviation are measured on."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__(config, size)
        self.requires_grad_(False)
        self.dtype = torch.float32  # what random weights tell of a frame is little beside their mean
        self.register_buffer("mean", torch.zeros(config.latent_dim))
        self.register_buffer("deviation", torch.ones(config.latent_dim))
        self.frame_stack = config.frame_stack
        self.mean: Tensor
        self.deviation: Tensor

    @torch.no_grad()
    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Mean and deviation of the outputs over frames from all over the data."""
        rows = torch.from_numpy(np.linspace(0, len(frames) - 1, min(self.SAMPLE, len(frames))).astype(np.int64))
        stacks = frames[rows.to(frames.device)].unsqueeze(1).expand(-1, self.frame_stack, -1, -1, -1)
        found = super().encode(stacks)
        self.mean.copy_(found.mean(0))
        self.deviation.copy_(found.std(0).clamp(min=1e-6))
        return frames

    def encode(self, stacks: Tensor) -> Tensor:
        """uint8 [M, N, H, W, 3] → [M, D]."""
        return (super().encode(stacks) - self.mean) / self.deviation
