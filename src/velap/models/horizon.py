"""The only place that turns Q-values into steps and back.

A goal that is reached after n steps under a terminal reward of 1 has the return γ^n (Sec. 4, "Tree expansion"), so a
Q-value is read as a temporal distance by log_γ Q. Thresholds are given as exponents of γ (Table 8) and go the other way.
"""

from __future__ import annotations

import math
from typing import overload

import torch

Q_FLOOR = 1e-6
"""Smallest Q-value that is read as a distance [Q-value]. ours: critics err, log_γ of 0 or less has no value. At γ = 0.96 it
stands for 338 steps, twice the longest task of the paper."""


@overload
def steps_from_q(q: float, discount: float) -> float: ...
@overload
def steps_from_q(q: torch.Tensor, discount: float) -> torch.Tensor: ...
def steps_from_q(q: float | torch.Tensor, discount: float) -> float | torch.Tensor:
    """log_γ q, the distance proxy of Eq. 8, finite and never negative.

    Args:
        q: [*] Q-values; clamped to [Q_FLOOR, 1], so q <= 0 reads as log_γ Q_FLOOR and q > 1 as 0 steps. NaN stays NaN.
        discount: γ in (0, 1).

    Returns:
        [*] distances [steps].
    """
    if isinstance(q, torch.Tensor):
        return q.clamp(Q_FLOOR, 1.0).log() / math.log(discount) + 0.0
    return math.log(min(max(q, Q_FLOOR), 1.0)) / math.log(discount) + 0.0


@overload
def q_from_steps(steps: float, discount: float) -> float: ...
@overload
def q_from_steps(steps: torch.Tensor, discount: float) -> torch.Tensor: ...
def q_from_steps(steps: float | torch.Tensor, discount: float) -> float | torch.Tensor:
    """γ^steps: the Q-value [Q-value] of a goal that is `steps` [*] away [steps]."""
    return discount**steps
