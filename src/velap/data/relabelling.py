"""Hindsight goals of App. B.4 by index. M rows to encode, T transitions, B windows, L steps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.training import TrainConfig

NEXT, FUTURE = 0.2, 0.4
"""Shares of the goals that are the next state (strategy a of B.4) and a later one of the trajectory (b); the rest are states
of other trajectories (c). ours: the paper gives no shares."""
GROUP_GOALS = 0.5
"""Share of the goals of strategy (c) that come from the same group of windows. ours."""


class Later(NamedTuple):
    """A later state of the same trajectory for each transition, two steps ahead or more."""

    at: Tensor
    """int64 [T], its position in the batch's rows."""
    exists: Tensor
    """bool [T], false where the trajectory or the window ends before."""


def _uniform(high: Tensor, generator: torch.Generator) -> Tensor:
    """Integers int64 [T] in [0, high)."""
    drawn = torch.rand(len(high), generator=generator, device=high.device)
    return torch.minimum((drawn * high).long(), high - 1).clamp(min=0)


def later_in_window(now_at: Tensor, valid: Tensor, generator: torch.Generator) -> Later:
    """A later state of each transition's own window: now_at int64 [T] positions of z_t, valid bool [B, L]."""
    width = valid.shape[1] + 1
    ahead = valid.sum(1)[now_at // width] - now_at % width - 1
    return Later(now_at + 2 + _uniform(ahead, generator), ahead > 0)


def goal_positions(
    now_at: Tensor, inside: Tensor, valid: Tensor, later: Later, config: TrainConfig, generator: torch.Generator
) -> Tensor:
    """Positions int64 [T] of the goals by the three strategies of B.4, in the shares of `config`.

    (a) The next state, reward 1, end of episode; (b) a later state of the same trajectory; (c) a state of another one.
    (b) starts two steps ahead: one step ahead it is (a), and labelling it 0 would contradict (a). Whenever the drawn goal
    is the very next frame, the transition counts as (a). Of the goals (c), the share `GROUP_GOALS` comes from windows of the
    same group (ours).

    Args:
        now_at: int64 [T], position of z_t; z_{t+1} is the next one.
        inside: bool [T], the transition lies inside its episode.
        valid: bool [B, L], the same for every step of the windows.
        later: goals (b).
    """
    windows, length = valid.shape
    n, width, device = len(now_at), length + 1, now_at.device
    window, next_at = now_at // width, now_at + 1
    shift = 1 + _uniform(torch.full_like(window, max(windows - 1, 1)), generator)
    elsewhere = (window + shift) % windows
    if config.group_windows > 1:
        base = window // config.group_windows * config.group_windows
        members = (windows - base).clamp(max=config.group_windows)
        beside = base + (window - base + 1 + _uniform(members - 1, generator)) % members
        near = torch.rand(n, generator=generator, device=device) < GROUP_GOALS
        elsewhere = torch.where(near & (members > 1), beside, elsewhere)
    other_at = elsewhere * width + _uniform(valid.sum(1)[elsewhere] + 1, generator)
    later_at = torch.where(later.exists, later.at, next_at)

    choice = torch.rand(n, generator=generator, device=device)
    goal_at = torch.where(choice < NEXT + FUTURE, later_at, other_at)
    return torch.where(inside & (choice >= NEXT), goal_at, next_at)
