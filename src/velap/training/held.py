"""Actions that are held for several steps, as transitions: what the critics of `held_policy` learn from (ours,
after action chunks as in Q-chunking, arXiv 2507.07969).

One action changes Q by a few hundredths of itself, less than what a critic mistakes, and the sign of that change is all
that a policy learns from. Several steps in one direction change it several times as much, and where the data's actions are
coherent the mean of the next few says what was done. Near contacts it says too little: there other policies have to act.

F frames, A action dimension.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.data.sampling import WindowSampler


class Held(NamedTuple):
    """Every row of the data as a transition of several steps, fewer before the end of an episode."""

    actions: Tensor
    """float32 [F, A], mean action of those steps in [-1, 1]."""
    rewards: Tensor
    """float32 [F], discounted sum of their rewards."""
    alive: Tensor
    """float32 [F], what the value of `following` counts, less one γ: γ^(steps-1), or 0 where the task ended."""
    following: Tensor
    """int64 [F], the row after those steps."""


def hold(sampler: WindowSampler, steps: int, discount: float) -> Held:
    """Every row's transition of `steps` steps; with 1 they are those of the data. The last row of an episode, which no
    transition starts from, stands for itself."""
    at = torch.arange(len(sampler.actions), device=sampler.device)
    actions, rewards = torch.zeros_like(sampler.actions), torch.zeros_like(sampler.rewards)
    count, alive = torch.zeros_like(rewards), torch.ones_like(rewards)
    for _ in range(steps):
        inside = at < sampler.last
        going = inside & (alive > 0)
        actions += torch.where(going[:, None], sampler.actions[at], 0.0)
        rewards += torch.where(going, discount**count * sampler.rewards[at], 0.0)
        count += going
        alive = torch.where(going & sampler.terminated[at], 0.0, alive)
        at = torch.where(inside, at + 1, at)
    taken = count.clamp(min=1)
    return Held(actions / taken[:, None], rewards, alive * discount ** (taken - 1), at)
