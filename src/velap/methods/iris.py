"""IRIS, Sec. 5.1, App. D.6 and D.7, after Mandlekar et al., "IRIS: Implicit Reinforcement without Interaction at Scale
from Offline Robot Manipulation Data", 2020, and its extension to several steps.

A manager proposes latents n steps ahead from a cVAE, the value picks one, a worker imitates the way there for n steps. App.
D.6 is empty, so everything that Sec. 5.1, D.7 and Table 4 do not say is ours.

B rows of a batch or environments, P rows that plan at one step, S samples, R subgoals of a rollout, D latent, A action
dimension, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.config import ModelConfig
from velap.errors import ConfigError
from velap.losses import Info, action_model_loss, cloning_error, reparameterise
from velap.methods.base import Agent, Method, Parts
from velap.methods.heads import Head
from velap.methods.planning import PlanningAgent
from velap.models.action_model import GENERATIVE, NOISE_DIM, ConditionalVAE
from velap.models.networks import POLICY, Policy
from velap.registry import register_method
from velap.search.sampling import normal
from velap.training.frozen import FrozenLearner, LatentData, LearnerConfig

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


@dataclass(frozen=True)
class SubgoalConfig(LearnerConfig):
    """IRIS. Learning rate, batch and length follow D.1 in `paper`; D.6 gives none."""

    steps: int = 10_000
    """Updates. ours: see docs/experiments/2026-11-heads.md; 3·10⁵ in `paper`."""
    horizon: int = 10
    """n, how far ahead a subgoal lies [steps]. D.7: 5 for the multi-step variant. ours: 10 for IRIS, the default of its
    authors' code (robomimic)."""
    kl_weight: float = 1.0
    """β of the cVAE. ours: Table 4's 0.01 is for actions; on latents it leaves holes in the prior (ADR 57)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("horizon", self.horizon >= 1, "at least 1 step")
        self.require("kl_weight", self.kl_weight >= 0, "a weight of 0 or more")


PAPER_SUBGOALS = SubgoalConfig(steps=300_000, batch=128, learning_rate=3e-4, cosine=False)
MULTISTEP_SUBGOALS = SubgoalConfig(horizon=5)
"""D.7: a generative model for a horizon of 5."""
PAPER_MULTISTEP_SUBGOALS = SubgoalConfig(steps=300_000, batch=128, learning_rate=3e-4, cosine=False, horizon=5)


@dataclass(frozen=True)
class IRISConfig:
    """How the manager chooses. How far ahead a subgoal lies is the head's: it was trained for that."""

    samples: int = 256
    """S, rollouts a plan, App. D.7. For IRIS itself ours: as many candidates as the extension has, so that the two differ
    in the rollouts alone."""
    rollout: int = 1
    """R, subgoals of a rollout; 1 is IRIS, 5 in App. D.7."""

    def __post_init__(self) -> None:
        for name in ("samples", "rollout"):
            if getattr(self, name) < 1:
                raise ConfigError(f"IRIS field `{name}` is {getattr(self, name)!r}; expected at least 1. "
                                  "Change that field and start again.")


MULTISTEP_IRIS = IRISConfig(rollout=5)
"""App. D.7."""


class SubgoalHead(Head):
    """A cVAE (Table 4) over latents `horizon` steps ahead, and a worker (Table 5) that reaches them.

    The value that ranks subgoals is the joint checkpoint's `LatentModel.value`, as in D.4 and D.5.
    """

    def __init__(self, config: ModelConfig, action_dim: int, state_dim: int = 0) -> None:
        super().__init__(config, action_dim, state_dim)
        latent, norm = self.latent_dim, config.norm
        self.manager = ConditionalVAE(latent, latent, NOISE_DIM, GENERATIVE, norm, bounded=False)
        self.worker = Policy(2 * latent, POLICY, action_dim, norm)
        self.register_buffer("steps_ahead", torch.tensor(0))
        self.register_buffer("change_scale", torch.ones(()))
        self.steps_ahead: Tensor
        self.change_scale: Tensor

    @property
    def horizon(self) -> int:
        """How far ahead a subgoal lies [steps]."""
        return int(self.steps_ahead)

    @property
    def noise_dim(self) -> int:
        """m."""
        return self.manager.noise_dim

    def propose(self, latent: Tensor, noise: Tensor) -> Tensor:
        """Subgoals from standard noise: `[*, D], [*, m] → [*, D]`."""
        return latent + self.change_scale * self.manager.decode(latent, noise)

    def act(self, latent: Tensor, subgoal: Tensor) -> Tensor:
        """Worker: `[*, D], [*, D] → [*, A]` in [-1, 1]."""
        return self.worker(torch.cat([latent, subgoal], -1))


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


def choose_subgoal(propose: Callable[[Tensor, Tensor], Tensor], value: Callable[[Tensor], Tensor], latents: Tensor,
                   noise: Tensor) -> Tensor:
    """The first subgoal [P, D] of the best of S rollouts of R subgoals each.

    A rollout is worth the highest value that it meets: it may reach the goal before its end (ours; D.7 says no more than
    that the best is chosen). With R = 1 that is IRIS: the candidate of highest value.

    Args:
        propose: the manager: latents [*, D], noise [*, m] → subgoals [*, D].
        value: latents [*, D] → [*] [Q-value].
        latents: [P, D].
        noise: [P, S, R, m] standard normal.
    """
    subgoal = latents.unsqueeze(1).expand(-1, noise.shape[1], -1)
    rollout = []
    for step in range(noise.shape[2]):
        subgoal = propose(subgoal, noise[:, :, step])
        rollout.append(subgoal)
    best = torch.stack([value(reached) for reached in rollout]).amax(0).argmax(1)
    return rollout[0][torch.arange(len(best), device=best.device), best]


class IRISAgent(PlanningAgent):
    """Every `head.horizon` steps the manager picks a subgoal; in between the worker acts towards it."""

    def __init__(self, method: str, model: LatentModel, head: SubgoalHead, settings: IRISConfig) -> None:
        super().__init__(method, model, head.horizon)
        self._head = head
        self._settings = settings
        self._subgoals: Tensor | None = None

    def subgoal(self, row: int) -> Tensor:
        """[D] the subgoal that `row` heads for."""
        assert self._subgoals is not None, "no row has planned yet"
        return self._subgoals[row].clone()

    def _allocate(self, batch: int) -> None:
        self._subgoals = None

    def _forget(self, row: int) -> None:
        pass

    def _plan(self, rows: NDArray[np.int64], latents: Tensor, generators: list[torch.Generator]) -> None:
        shape = (self._settings.samples, self._settings.rollout, self._head.noise_dim)
        chosen = choose_subgoal(self._head.propose, self._model.value, latents, normal(shape, latents, generators))
        if self._subgoals is None:
            self._subgoals = latents.new_zeros(len(self._age), latents.shape[-1])
        self._subgoals[torch.from_numpy(rows).to(self._device)] = chosen

    def _follow(self, latents: Tensor) -> Tensor:
        assert self._subgoals is not None, "every row has planned"
        return self._head.act(latents, self._subgoals)


@register_method("iris")
class IRIS(Method):
    """IRIS: the subgoal of highest value."""

    label = "IRIS"
    settings = IRISConfig()
    head, learner = SubgoalHead, SubgoalLearner
    learning, paper_learning = SubgoalConfig(), PAPER_SUBGOALS

    def agent(self, parts: Parts) -> Agent:
        """Manager and worker."""
        return IRISAgent(self.name, parts.model, parts.head, parts.settings)


@register_method("iris-multistep")
class MultistepIRIS(IRIS):
    """Rollouts of several subgoals, D.7."""

    label = "IRIS (multi-step)"
    settings = MULTISTEP_IRIS
    learning, paper_learning = MULTISTEP_SUBGOALS, PAPER_MULTISTEP_SUBGOALS
