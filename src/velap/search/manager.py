"""How a manager of subgoals chooses: random shooting of subgoal sequences (App. D.6, D.7).

P rows, S samples, R subgoals of a rollout, D latent, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from velap.errors import ConfigError


@dataclass(frozen=True)
class IRISConfig:
    """How the manager chooses. How far ahead a subgoal lies is the head's: it was trained for that."""

    samples: int = 256
    """S, rollouts a plan, App. D.7. For IRIS itself ours: as many candidates as the extension has, so that the two differ
    in the rollouts alone."""
    rollout: int = 1
    """R, subgoals of a rollout; 1 is IRIS, 5 in App. D.7."""

    def __post_init__(self) -> None:
        for name in ("samples", "rollout"):
            if getattr(self, name) < 1:
                raise ConfigError(f"IRIS field `{name}` is {getattr(self, name)!r}; expected at least 1. "
                                  "Change that field and start again.")


MULTISTEP = IRISConfig(rollout=5)
"""App. D.7."""


def choose_subgoal(propose: Callable[[Tensor, Tensor], Tensor], value: Callable[[Tensor], Tensor], latents: Tensor,
                   noise: Tensor) -> Tensor:
    """The first subgoal [P, D] of the best of S rollouts of R subgoals each.

    A rollout is worth the highest value that it meets: it may reach the goal before its end (ours; D.7 says no more than
    that the best is chosen). With R = 1 that is IRIS: the candidate of highest value.

    Args:
        propose: the manager: latents [*, D], noise [*, m] → subgoals [*, D].
        value: latents [*, D] → [*] [Q-value].
        latents: [P, D].
        noise: [P, S, R, m] standard normal.
    """
    subgoal = latents.unsqueeze(1).expand(-1, noise.shape[1], -1)
    rollout = []
    for step in range(noise.shape[2]):
        subgoal = propose(subgoal, noise[:, :, step])
        rollout.append(subgoal)
    best = torch.stack([value(reached) for reached in rollout]).amax(0).argmax(1)
    return rollout[0][torch.arange(len(best), device=best.device), best]
