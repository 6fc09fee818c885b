"""IRIS, Sec. 5.1, App. D.6 and D.7, after Mandlekar et al., "IRIS: Implicit Reinforcement without Interaction at Scale
from Offline Robot Manipulation Data", 2020.

The manager is a cVAE over the latent n steps ahead, the worker a goal-conditioned policy that imitates the way there. App.
D.6 is empty, so everything that D.7 and Table 4 do not say is ours. B rows of a batch, D latent, m noise dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from velap.losses import Info, action_model_loss, cloning_error, reparameterise
from velap.models.heads import SubgoalHead
from velap.training.frozen import FrozenLearner, LatentData, LearnerConfig


@dataclass(frozen=True)
class SubgoalConfig(LearnerConfig):
    """IRIS. Learning rate, batch and length follow D.1 in `paper`; D.6 gives none."""

    steps: int = 10_000
    """Updates. ours: see docs/decisions.md; 3·10⁵ in `paper`."""
    horizon: int = 10
    """n, how far ahead a subgoal lies [steps]. D.7: 5 for the multi-step variant. ours: 10 for IRIS, the default of its
    authors' code (robomimic)."""
    kl_weight: float = 1.0
    """β of the cVAE. ours: Table 4's 0.01 is for actions; on latents it leaves holes in the prior (docs/decisions.md)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("horizon", self.horizon >= 1, "at least 1 step")
        self.require("kl_weight", self.kl_weight >= 0, "a weight of 0 or more")


PAPER_IRIS = SubgoalConfig(steps=300_000, batch=128, learning_rate=3e-4, cosine=False)
MULTISTEP = SubgoalConfig(horizon=5)
"""D.7: a generative model for a horizon of 5."""
PAPER_MULTISTEP = SubgoalConfig(steps=300_000, batch=128, learning_rate=3e-4, cosine=False, horizon=5)


def future_rows(rows: Tensor, last: Tensor, ahead: Tensor | int) -> Tensor:
    """Rows [B] `ahead` steps on, the episode's final row where it ends before (as the authors pad): int64 [B] each."""
    return torch.minimum(rows + ahead, last)


class SubgoalLearner(FrozenLearner[SubgoalConfig, SubgoalHead]):
    """The manager learns z_{t+n} given z_t, the worker a_t given z_t and a state at most n steps ahead."""

    def __init__(self, head: SubgoalHead, data: LatentData, config: SubgoalConfig, generator: torch.Generator) -> None:
        super().__init__(head, data, config, generator)
        ahead = future_rows(data.training, data.last[data.training], config.horizon)
        change = data.latents[ahead] - data.latents[data.training]
        head.change_scale.copy_(change.square().mean().sqrt().clamp(min=1e-6))
        head.steps_ahead.fill_(config.horizon)

    def loss(self, rows: Tensor) -> tuple[Tensor, Info]:
        """β-VAE of the change over n steps in units of its root mean square, plus hindsight imitation."""
        data, head, last = self.data, self.model, self.data.last[rows]
        latent = data.latents[rows]
        change = (data.latents[future_rows(rows, last, self.config.horizon)] - latent) / head.change_scale
        mean, log_variance = head.manager.posterior(latent, change)
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        decoded = head.manager.decode(latent, reparameterise(mean, log_variance, noise))
        counted = torch.ones_like(latent[:, 0])
        manager, info = action_model_loss(decoded, change, mean, log_variance, self.config.kl_weight, counted)
        ahead = 1 + self._integers(self.config.horizon, len(rows))
        goal = data.latents[future_rows(rows, last, ahead)]
        worker = cloning_error(head.act(latent, goal), data.actions[rows]).mean()
        return manager + worker, {"manager": info["loss"], "reconstruction": info["reconstruction"], "kl": info["kl"],
                                  "worker": worker.detach()}
