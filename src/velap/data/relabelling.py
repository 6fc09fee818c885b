"""Hindsight goals of App. B.4 by index. M rows to encode, T transitions, B windows, L steps."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.training import TrainConfig

GROUP_GOALS = 0.5
"""Share of the goals of strategy (c) that come from the same group of windows. ours."""


class Relabelled(NamedTuple):
    """Goals, rewards and continuation of D' for T transitions."""

    position: Tensor
    """int64 [T], position of z_* in the batch's rows."""
    reward: Tensor
    """float32 [T], 1 where the next state is the goal."""
    proceeds: Tensor
    """float32 [T], 0 where the goal is reached, else 1."""


def relabel(
    rows: Tensor, start: Tensor, inside: Tensor, valid: Tensor, config: TrainConfig, generator: torch.Generator
) -> Relabelled:
    """Goals by the three strategies of B.4, in the shares of `config`.

    (a) the next state, reward 1, end of episode; (b) a later state of the same trajectory; (c) a state of another one.
    (b) starts two steps ahead: one step ahead it is (a), and labelling it 0 would contradict (a). Whenever the drawn goal
    is the very next frame, the transition counts as (a). Of the goals (c), the share `GROUP_GOALS` comes from windows of the
    same group (ours).
    rows int64 [M]; start int64 [T] positions of z_t; inside bool [T]; valid bool [B, L].
    """
    windows, length = valid.shape
    n, width, device = len(start), length + 1, start.device
    window, step = start // width, start % width
    steps_inside = valid.sum(1)

    def uniform(high: Tensor) -> Tensor:
        """Integers [T] in [0, high)."""
        drawn = torch.rand(n, generator=generator, device=device)
        return torch.minimum((drawn * high).long(), high - 1).clamp(min=0)

    following = start + 1
    if len(rows) > windows * width:
        future = windows * width + window
        has_future = rows[future] > rows[following]
    else:
        later = steps_inside[window] - step - 1
        future = start + 2 + uniform(later)
        has_future = later > 0
        future = torch.where(has_future, future, following)
    shift = 1 + uniform(torch.full_like(window, max(windows - 1, 1)))
    elsewhere = (window + shift) % windows
    if config.group_windows > 1:
        base = window // config.group_windows * config.group_windows
        members = (windows - base).clamp(max=config.group_windows)
        beside = base + (window - base + 1 + uniform(members - 1)) % members
        near = torch.rand(n, generator=generator, device=device) < GROUP_GOALS
        elsewhere = torch.where(near & (members > 1), beside, elsewhere)
    other = elsewhere * width + uniform(steps_inside[elsewhere] + 1)

    choice = torch.rand(n, generator=generator, device=device)
    position = torch.where(choice < config.relabel_next, following, other)
    later_goal = (choice >= config.relabel_next) & (choice < config.relabel_next + config.relabel_future)
    position = torch.where(later_goal, torch.where(has_future, future, following), position)
    position = torch.where(inside, position, following)
    reached = rows[position] == rows[following]
    return Relabelled(position=position, reward=reached.float(), proceeds=(~reached).float())
