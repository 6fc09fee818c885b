"""Whether and when a policy gets to the goal by the model (ours).

V variants of the policy, B states, D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

CHECK_EVERY = 3
"""Simulated steps from one look at Q^g to the next [steps]."""
GAINS = (1.0, 1.5, 2.5)
"""How much stronger than a policy says the actions are that compete with its own, before they are cut to the limits."""


class Arrivals(NamedTuple):
    """Simulations of all variants from all states."""

    steps: Tensor
    """[V, B] float, when the goal is there; infinite where it is not reached [steps]."""
    first: Tensor
    """[V, B, A] the first actions."""


def arrivals(policy: Callable[[Tensor], Tensor], step: Callable[[Tensor, Tensor], Tensor], value: Callable[[Tensor], Tensor],
             latents: Tensor, goal_value: float, horizon: int, gains: Sequence[float] = GAINS) -> Arrivals:
    """The policy simulated by h for `horizon` steps from latents [B, D], each variant with one gain on its actions.

    Args:
        policy: `[*, D] → [*, A]` in [-1, 1].
        step: h, `[*, D], [*, A] → [*, D]`.
        value: Q^g, `[*, D] → [*]` [Q-value].
        goal_value: the goal is there where Q^g is higher [Q-value].
    """
    factors = torch.tensor(gains, device=latents.device).view(-1, 1, 1)
    z = latents.expand(len(gains), *latents.shape)
    first = actions = (factors * policy(z)).clamp(-1, 1)
    steps = torch.full(z.shape[:2], torch.inf, device=z.device)
    for count in range(1, horizon + 1):
        z = step(z, actions)
        if count % CHECK_EVERY == 0 or count == horizon:
            arrived = value(z) > goal_value
            steps = torch.where(arrived & steps.isinf(), float(count), steps)
            if bool((~steps.isinf()).any(0).all()):
                break
        actions = (factors * policy(z)).clamp(-1, 1)
    return Arrivals(steps, first)
