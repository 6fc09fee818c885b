"""Several policies cloned from the successes, of which the one that gets to the goal most often by the model is kept (ours).

Successes cover a part of the states only; where a clone goes from anywhere else is an accident of its first weights. h and
Q^g tell the accidents apart without an environment.

F frames, D latent.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from velap.models.arrivals import arrivals
from velap.models.horizon import q_from_steps
from velap.models.latent import LatentModel

STATES = 3_000
"""States of the data that are looked at; simulations start from the half of them that is farther from the goal by Q^g."""
HORIZON = 150
"""Simulated steps [steps]."""
GOAL_EXPONENT = 5.0
"""The goal is there where Q^g is above γ^this, as in Table 8."""


def fresh(policy: nn.Module, generator: torch.Generator) -> None:
    """New weights for all layers."""
    seed = int(torch.randint(2**31, (1,), generator=generator, device=generator.device))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for module in policy.modules():
            if isinstance(module, nn.Linear | nn.LayerNorm | nn.BatchNorm1d):
                module.reset_parameters()


@torch.no_grad()
def arrival_rate(model: LatentModel, states: Tensor) -> float:
    """Share of the states [*, D] in the half farther from the goal from where the cloned policy gets there by h, averaged
    over the gains that the controller tries: one that arrives at any gain tells good clones apart better than the best."""
    assert model.success_policy is not None, "the model has no policy cloned from successes"
    values = model.value(states)
    far = states[values <= values.median()]
    goal_value = q_from_steps(GOAL_EXPONENT, model.discount)
    found = arrivals(model.success_policy, model.step, model.value, far, goal_value, HORIZON)
    return float((~found.steps.isinf()).float().mean())


class Clones(nn.Module):
    """The best clone so far."""

    def __init__(self, policy: nn.Module) -> None:
        super().__init__()
        self.best = copy.deepcopy(policy).requires_grad_(False)
        self.register_buffer("rate", torch.tensor(-1.0))
        self.rate: Tensor
        """float32 [], its arrival rate; -1 before the first."""

    def judge(self, model: LatentModel, cache: Tensor, rows: Tensor, generator: torch.Generator) -> float:
        """Keep the model's clone if it arrives more often than the best one; returns its arrival rate.

        cache [F, D] are latents, `rows` int64 [*] those to draw states from.
        """
        assert model.success_policy is not None, "the model has no policy cloned from successes"
        drawn = rows[torch.randint(len(rows), (STATES,), generator=generator, device=rows.device)]
        rate = arrival_rate(model, cache[drawn])
        if rate > float(self.rate):
            self.best.load_state_dict(model.success_policy.state_dict())
            self.rate.fill_(rate)
        return rate
