"""Behavioural cloning, App. D.1: BC on all transitions, BC(D*) on those of successful episodes only.

B rows of a batch, A action dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from velap.errors import DatasetError
from velap.losses import Info, cloning_error
from velap.methods.base import Agent, Method, Parts
from velap.methods.heads import PolicyHead
from velap.methods.reactive import ReactiveAgent
from velap.registry import register_method
from velap.training.frozen import FrozenLearner, LatentData, LearnerConfig


@dataclass(frozen=True)
class BCConfig(LearnerConfig):
    """D.1."""

    passes: int = 100
    """Most passes over the transitions; they end the training before `steps`, but not before `LEAST_STEPS`. 0 disables it.
    ours: beyond that BC(D*) overfits on a hundred transitions. 0 in `paper`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("passes", self.passes >= 0, "0 or more passes")

    def length(self, transitions: int) -> int:
        """Updates of a training on this number of transitions, limited by `passes` [steps]."""
        enough = max(LEAST_STEPS, -(-self.passes * transitions // self.batch))
        return min(self.steps, enough) if self.passes else self.steps


PAPER_BC = BCConfig(steps=300_000, batch=128, learning_rate=3e-4, cosine=False, passes=0)
"""D.1."""
LEAST_STEPS = 50
"""Fewest updates that `passes` leaves. ours."""


class BCLearner(FrozenLearner[BCConfig, PolicyHead]):
    """π(z) → a by mean-squared error."""

    def loss(self, rows: Tensor) -> tuple[Tensor, Info]:
        """Mean squared error of the predicted actions, D.1."""
        data = self.data
        loss = cloning_error(self.model.act(data.latents[rows]), data.actions[rows]).mean()
        return loss, {"loss": loss.detach()}


class SuccessBCLearner(BCLearner):
    """BC(D*): the transitions of successful episodes only."""

    def __init__(self, head: PolicyHead, data: LatentData, config: BCConfig, generator: torch.Generator) -> None:
        super().__init__(head, data, config, generator)
        if len(data.success_training) == 0:
            raise DatasetError(f"{data.dataset_id} has no successful episode; BC(D*) learns from those alone and expects at "
                               "least one with a reward of 1. Collect or label some successes, or use `--method bc`.")
        self.pool, self.held_out = data.success_training, data.success_held_out


@register_method("bc")
class BC(Method):
    """BC on all transitions."""

    label = "BC"
    head, learner = PolicyHead, BCLearner
    learning, paper_learning = BCConfig(), PAPER_BC

    def agent(self, parts: Parts) -> Agent:
        """The cloned policy at every step."""
        return ReactiveAgent(self.name, parts.model, parts.head.act)


@register_method("bc-success")
class SuccessBC(BC):
    """BC(D*)."""

    label = "BC (D*)"
    learner = SuccessBCLearner
