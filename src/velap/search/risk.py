"""What an edge risks, by what came of such promises on the data (ours).

A search among thousands of edges finds those whose promise is an error of the model. How often a proposer's promises are
errors can be counted without an environment: for g, how often h misses the true end of n steps of held-out data; for a
policy, how much of the progress that Q^g promises it h confirms, by the distance of the goal.

P policies, S states, V classes of distance, D latent dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from velap.models.functions import SearchFns
from velap.models.horizon import steps_from_q

Policy = Callable[[Tensor], Tensor]
"""Latents [*, D] → actions [*, A] in [-1, 1]."""
COST = 150.0
"""What a promise costs that is not kept [steps]. ours: the longest episode that most tasks allow."""
DISTANCES = (20.0, 40.0, 70.0, 110.0)
"""Borders of the classes of distance to the goal [steps]. ours."""
AHEAD = 10
"""Steps after which a promise counts [steps]. ours."""
NEAR = 5.0
"""States nearer to the goal than this have no progress to promise [steps]: τ_stop of Table 9."""
PRIOR = 10
"""States of all distances that each class is filled up with. ours."""


@dataclass(frozen=True)
class Risk:
    """Steps that an edge of each proposer costs besides its own."""

    of_model: float
    """An edge of g [steps]."""
    of_policies: Tensor
    """[P, V] an edge of each policy by the distance of its start [steps]."""

    def of_policy(self, proposers: Tensor, steps_to_goal: Tensor) -> Tensor:
        """Of edges [*] of policies: proposers [*] from 1, steps_to_goal [*] of their starts [steps]."""
        borders = torch.tensor(DISTANCES, device=steps_to_goal.device)
        return self.of_policies[(proposers - 1).clamp(min=0), torch.bucketize(steps_to_goal.contiguous(), borders)]


@torch.inference_mode()
def measured_risk(fns: SearchFns, policies: Sequence[Policy], states: Tensor, missed: float) -> Risk:
    """The risk of every proposer.

    Args:
        fns: the model.
        policies: all that propose besides g.
        states: [S, D] latents of the data.
        missed: share of held-out walks that h misses.
    """
    to_go = steps_from_q(fns.value(states).clamp(min=1e-6), fns.discount)
    far = to_go >= NEAR
    classes = torch.bucketize(to_go, torch.tensor(DISTANCES, device=states.device))
    rows = []
    for policy in policies:
        z = states
        for _ in range(AHEAD):
            z = fns.step(z, policy(z))
        left = steps_from_q(fns.value(z).clamp(min=1e-6), fns.discount)
        kept = ((to_go - left) / to_go.clamp(max=float(AHEAD))).clamp(0, 1)
        usual = kept[far].mean() if far.any() else kept.new_zeros(())
        rows.append(torch.stack([
            (kept[far & (classes == number)].sum() + PRIOR * usual) / ((far & (classes == number)).sum() + PRIOR)
            for number in range(len(DISTANCES) + 1)]))
    return Risk(COST * missed, COST * (1 - torch.stack(rows)))
