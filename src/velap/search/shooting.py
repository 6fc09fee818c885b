"""Trajectory optimisation by shooting: what MPPI (App. D.4) and MBOP (App. D.5) share, the score and the choice of elites.

B environments, S sampled trajectories, H horizon [steps], E elites, D latent, A action dimension. A method is a way to
propose trajectories, and a centre that its elites move.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.planning import Precision
from velap.errors import ConfigError
from velap.search.types import SearchFns


@dataclass(frozen=True)
class ShootingConfig:
    """What App. D.4 and D.5 give for both methods, and how their agents use it."""

    samples: int = 1000
    """S, trajectories an iteration, App. D.4 and D.5."""
    horizon: int = 50
    """H [steps], App. D.4 and D.5."""
    elites: int = 64
    """E, App. D.4 and D.5."""
    iterations: int = 5
    """App. D.4 and D.5."""
    temperature: float = 0.5
    """Elite weights are softmax(temperature × score); TD-MPC `temperature`. MBOP's κ, which its paper tunes by task."""
    goal_ends: bool = False
    """Reaching the goal ends an episode, which h does not know: a trajectory keeps the highest value that it has met. Summed
    as D.4 says it, values behind the goal count, and MPPI hovers two steps before it. ours, on in the default preset."""
    replan_every: int = 5
    """Steps of a plan that an agent executes [steps], App. D.4 and D.5."""
    arithmetic: Precision = "bfloat16"
    """Hidden layers of the networks while an agent plans; the functions given to `shoot` carry their own. ours: 61 of the 64
    elites are those of float32 and plans score the same within what another seed changes, in 0.6 of the time."""

    def __post_init__(self) -> None:
        for name, (holds, range_) in self._ranges().items():
            if not holds:
                method = type(self).__name__.removesuffix("Config")
                raise ConfigError(f"{method} field `{name}` is {getattr(self, name)!r}; expected {range_}. "
                                  "Change that field and start again.")

    def _ranges(self) -> dict[str, tuple[bool, str]]:
        """Field → whether it holds, and what is expected."""
        return {
            "samples": (self.samples >= 1, "at least 1"),
            "horizon": (self.horizon >= 1, "at least 1 step"),
            "elites": (1 <= self.elites <= self.samples, f"1 to samples = {self.samples}"),
            "iterations": (self.iterations >= 1, "at least 1"),
            "temperature": (self.temperature > 0, "a positive number"),
            "replan_every": (self.replan_every >= 1, "at least 1 step"),
            "arithmetic": (self.arithmetic in ("float32", "bfloat16"), "float32 or bfloat16"),
        }


class Shot(NamedTuple):
    """Outcome of one optimisation."""

    actions: Tensor
    """[B, H, A] in [-1, 1]: MPPI draws an elite by its weight, MBOP takes the mean."""
    score: Tensor
    """[B] best score of the last iteration [sum of Q-values]."""
    mean: Tensor
    """[B, H, A] mean of the last elites; `shift_mean` it to start the next optimisation from."""


def shift_mean(mean: Tensor, steps: int) -> Tensor:
    """The mean [B, H, A] `steps` [steps] later: what was executed falls out, zeros move in."""
    return torch.cat([mean[:, steps:], torch.zeros_like(mean[:, :steps])], 1)


class Elites(NamedTuple):
    """The best trajectories of a row, best first."""

    actions: Tensor
    """[B, E, H, A]."""
    scores: Tensor
    """[B, E] [sum of Q-values]."""
    weights: Tensor
    """[B, E], sum 1 over the elites."""

    def mean(self) -> Tensor:
        """[B, H, A] weighted mean of the actions."""
        return (self.weights[:, :, None, None] * self.actions).sum(1)

    def std(self) -> Tensor:
        """[B, H, A] weighted deviation of the actions from their mean."""
        deviations = (self.actions - self.mean().unsqueeze(1)).square()
        return (self.weights[:, :, None, None] * deviations).sum(1).sqrt()


def choose_elites(actions: Tensor, scores: Tensor, cfg: ShootingConfig) -> Elites:
    """The E best of actions [B, S, H, A] by scores [B, S], weighted by softmax(temperature × score)."""
    best, index = scores.topk(cfg.elites, 1)
    elites = actions.gather(1, index[:, :, None, None].expand(-1, -1, *actions.shape[2:]))
    return Elites(elites, best, (cfg.temperature * best).softmax(1))


def score(fns: SearchFns, z: Tensor, actions: Tensor, goal_ends: bool = False) -> Tensor:
    """Accumulated state-action values (App. D.4): z [B, 1, D], actions [B, S, H, A] → [B, S], the sum of Q^g(z_t, a_t).

    With `goal_ends` the sum of max_{i <= t} Q^g(z_i, a_i).
    """
    z = z.expand(-1, actions.shape[1], -1)
    total = value = z.new_zeros(z.shape[:2])
    for step in range(actions.shape[2]):
        value = step_score(fns.q(z, actions[:, :, step]), value, step, goal_ends)
        total = total + value
        if step + 1 < actions.shape[2]:
            z = fns.step(z, actions[:, :, step])
    return total


def step_score(q: Tensor, before: Tensor, step: int, goal_ends: bool) -> Tensor:
    """What step `step` adds to a score, given Q^g there and what the step before added."""
    return torch.maximum(q, before) if goal_ends and step else q
