"""What h learns once the encoder is frozen (ours): transitions of all of the data, those that it gets wrong more often.

P transitions of the data, R rows of a batch, k rollout steps, D latent dimensions.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from velap.config.training import TrainConfig
from velap.data.sampling import WindowSampler
from velap.losses import Info, rollout_metric_loss
from velap.models.velap import LatentModel


def step_metric(changes: Tensor, ridge: float) -> Tensor:
    """W [D, D] that makes one-step changes [P, D] white: ‖change · W‖² counts every direction in its own size.

    What moves seldom or little, a handle or a drawer, is a small part of a squared latent error, and the hand all of it.
    `ridge` times the mean variance is added to every direction's, so that what never moves is not blown up.
    """
    # the eigenvectors' signs do not matter to the loss, their order neither
    variance, directions = torch.linalg.eigh(changes.T @ changes / len(changes))
    variance = variance.clamp(min=0)
    return directions * (variance + ridge * variance.mean().clamp(min=1e-12)).rsqrt()


class TransitionObjective(nn.Module):
    """Short rollouts of h in the metric of one-step changes, half of them drawn by how wrong h was there before.

    Contacts are a few transitions in a hundred, and what stops or moves at them decides whether a plan can be followed
    (prioritised replay, Schaul et al., 2016, without its correction: h is deterministic and has no mean to bias).
    """

    CLIP = 400.0
    """Squared error of a step from which on it counts linearly: a jump that no model foretells is not chased. ours."""
    REFRESH = 500
    """Draws between two updates of the cumulated priorities. ours: cumulating all of them costs as much as a batch."""
    LEAST, MOST = 1e-3, 100.0
    """Bounds of a priority [squared error of a step]. ours."""

    def __init__(self, config: TrainConfig, sampler: WindowSampler, cache: Tensor) -> None:
        super().__init__()
        self.config, self.sampler, self.cache = config, sampler, cache
        rows = sampler.transitions
        self.register_buffer("metric", step_metric(cache[rows + 1] - cache[rows], config.latent_ridge))
        self.register_buffer("priority", torch.ones(len(rows), device=rows.device))
        self.register_buffer("cumulated", torch.arange(1.0, len(rows) + 1, device=rows.device))
        self.register_buffer("draws", torch.zeros((), dtype=torch.int64))
        self.metric: Tensor
        """float32 [D, D], `step_metric`."""
        self.priority: Tensor
        """float32 [P], the last squared error of each transition's rollout, 1 before it was drawn."""
        self.cumulated: Tensor
        """float32 [P], sums of `priority ** latent_priority` at the last refresh."""
        self.draws: Tensor
        """int64 []."""

    def draw(self, generator: torch.Generator) -> Tensor:
        """Numbers int64 [R] of transitions: the first half uniform, the rest by priority."""
        config, count, device = self.config, len(self.priority), self.priority.device
        if int(self.draws) % self.REFRESH == 0:
            self.cumulated = (self.priority**config.latent_priority).cumsum(0)
        self.draws += 1
        by_priority = config.latent_dynamics_batch // 2 if config.latent_priority > 0 else 0
        uniform = torch.randint(count, (config.latent_dynamics_batch - by_priority,), generator=generator, device=device)
        if by_priority == 0:
            return uniform
        at = torch.rand(by_priority, generator=generator, device=device) * self.cumulated[-1]
        return torch.cat([uniform, torch.searchsorted(self.cumulated, at).clamp(max=count - 1)])

    def loss(self, model: LatentModel, generator: torch.Generator) -> tuple[Tensor, Info]:
        """Mean error of k steps from the drawn transitions; their priorities follow."""
        sampler, cache = self.sampler, self.cache
        drawn = self.draw(generator)
        rows = sampler.transitions[drawn]
        last, latent = sampler.last[rows], cache[rows]
        predicted, truth, valid = [], [], []
        for step in range(self.config.latent_dynamics_horizon):
            now = torch.minimum(rows + step, last - 1)
            latent = model.step(latent, sampler.actions[now])
            predicted.append(latent)
            truth.append(cache[now + 1])
            valid.append(rows + step < last)
        loss, errors, info = rollout_metric_loss(
            torch.stack(predicted), torch.stack(truth), torch.stack(valid), self.metric, self.CLIP)
        self.priority[drawn] = errors.clamp(self.LEAST, self.MOST)
        return loss, info
