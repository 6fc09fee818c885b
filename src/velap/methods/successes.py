"""Following the policy cloned from successes where, by the model, it gets to the goal (ours).

B environments, D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from velap.errors import ConfigError
from velap.models.arrivals import arrivals
from velap.search.types import SearchFns


class Lead(NamedTuple):
    """What the policy says of every row."""

    arrives: Tensor
    """[B] bool: the simulation gets to the goal."""
    actions: Tensor
    """[B, A] the first action of the variant that is there first."""


class SuccessRollouts:
    """The policy simulated by h, slow as the data and with stronger actions, until Q^g says that the goal is there.

    A search finds where h errs to advantage, and leads through what h does not know to be solid. A policy that was learnt
    without h does not seek those errors, so that a simulated arrival can be believed where a planned one cannot.
    """

    def __init__(self, fns: SearchFns, horizon: int, goal_value: float, gains: Sequence[float]) -> None:
        if fns.act_success is None:
            raise ConfigError("config field `success_rollout` is set, but the model has no policy cloned from successes; "
                              "expected 0. Train with `success_policy` and `clone_steps`.")
        self._policy, self._step, self._value = fns.act_success, fns.step, fns.value
        self._horizon, self._goal_value, self._gains = horizon, goal_value, gains

    def lead(self, latents: Tensor) -> Lead:
        """From latents [B, D]."""
        found = arrivals(self._policy, self._step, self._value, latents, self._goal_value, self._horizon, self._gains)
        soonest, variant = found.steps.min(0)
        return Lead(~soonest.isinf(), found.first[variant, torch.arange(len(latents), device=latents.device)])
