"""A leaky mean of the past actions, which stands behind the output of φ where a config has `command_dims` (ours).

What follows its commands slowly has a speed, and a lag behind them, that a stack of frames shows to a pixel a step at best.
The actions are known, so the mean of them is exact. F frames of a dataset, A action dimension; `*` is any batch prefix.
"""

from __future__ import annotations

import torch
from torch import Tensor


def remembered(commands: Tensor, action: Tensor, memory: float) -> Tensor:
    """The mean one step on: m' = memory · m + (1 - memory) · a. commands and action `[*, A]`, in [-1, 1]."""
    return memory * commands + (1 - memory) * action.clamp(-1, 1)


def past_commands(actions: Tensor, first: Tensor, memory: float) -> Tensor:
    """The mean before every row's own action: actions float32 [F, A] in [-1, 1] → float32 [F, A].

    first: int64 [F], first row of each row's episode, where the mean is 0.
    """
    commands = torch.zeros_like(actions)
    rows = torch.arange(len(first), device=first.device)
    by_age = torch.argsort(rows - first, stable=True)
    for now in by_age.split(torch.bincount(rows - first).tolist())[1:]:
        commands[now] = remembered(commands[now - 1], actions[now - 1], memory)
    return commands
