"""Trajectory optimisation by shooting: MPPI as in TD-MPC (Hansen et al. 2022, Alg. 1) with the score of App. D.4.

B environments, S sampled trajectories, H horizon [steps], E elites, D latent, A action dimension. A method is a way to
propose trajectories; scoring and the elite update are shared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from velap.errors import ConfigError
from velap.search.sampling import normal, uniform
from velap.search.types import RowGenerator, SearchFns


@dataclass(frozen=True)
class MPPIConfig:
    """MPPI. D.4 gives samples, horizon, elites and iterations; it builds on TD-MPC, whose defaults fill the rest."""

    samples: int = 1000
    """S, trajectories an iteration, those of π^g included, App. D.4."""
    horizon: int = 50
    """H [steps], App. D.4."""
    elites: int = 64
    """E, App. D.4."""
    iterations: int = 5
    """App. D.4."""
    policy_share: float = 0.05
    """Share of the trajectories that follow π^g; TD-MPC `mixture_coef`."""
    policy_std: float = 0.05
    """Standard deviation of the noise on π^g's actions; TD-MPC `min_std`."""
    temperature: float = 0.5
    """Elite weights are softmax(temperature × score); TD-MPC `temperature`."""
    momentum: float = 0.1
    """Share of the old mean in the new one; TD-MPC `momentum`."""
    std_min: float = 0.05
    """TD-MPC `min_std`."""
    std_max: float = 2.0
    """Also the standard deviation of the first iteration; TD-MPC."""

    def __post_init__(self) -> None:
        expected = {
            "samples": (self.samples >= 1, "at least 1"),
            "horizon": (self.horizon >= 1, "at least 1 step"),
            "elites": (1 <= self.elites <= self.samples, f"1 to samples = {self.samples}"),
            "iterations": (self.iterations >= 1, "at least 1"),
            "policy_share": (0 <= self.policy_share <= 1, "a share in [0, 1]"),
            "policy_std": (self.policy_std >= 0, "0 or more"),
            "temperature": (self.temperature > 0, "a positive number"),
            "momentum": (0 <= self.momentum < 1, "a share in [0, 1)"),
            "std_min": (0 < self.std_min <= self.std_max, f"above 0, at most std_max = {self.std_max}"),
        }
        for name, (holds, range_) in expected.items():
            if not holds:
                raise ConfigError(f"MPPI field `{name}` is {getattr(self, name)!r}; expected {range_}. "
                                  "Change that field and start again.")


class Shot(NamedTuple):
    """Outcome of one optimisation."""

    actions: Tensor
    """[B, H, A] an elite trajectory drawn by its weight, in [-1, 1]."""
    score: Tensor
    """[B] best score of the last iteration [sum of Q-values]."""
    mean: Tensor
    """[B, H, A] mean of the last elites; `shift_mean` it to start the next optimisation from."""


def shift_mean(mean: Tensor, steps: int) -> Tensor:
    """The mean [B, H, A] `steps` [steps] later: what was executed falls out, zeros move in."""
    return torch.cat([mean[:, steps:], torch.zeros_like(mean[:, :steps])], 1)


@torch.inference_mode()
def shoot(
    fns: SearchFns, z_root: Tensor, cfg: MPPIConfig, generator: RowGenerator, previous_mean: Tensor | None = None
) -> Shot:
    """MPPI from z_root [B, D]; `previous_mean` [B, H, A] (already shifted) takes the place of zeros."""
    followers = round(cfg.policy_share * cfg.samples)
    z = z_root.unsqueeze(1)
    guided = follow_policy(fns, z, cfg, generator, followers)
    action_dim = guided.shape[-1]
    shape = (cfg.samples - followers, cfg.horizon, action_dim)
    mean = guided.new_zeros(len(z_root), cfg.horizon, action_dim) if previous_mean is None else previous_mean
    std = torch.full_like(mean, cfg.std_max)
    for _ in range(cfg.iterations):
        sampled = torch.addcmul(mean.unsqueeze(1), std.unsqueeze(1), normal(shape, z_root, generator)).clamp_(-1, 1)
        actions = torch.cat([sampled, guided], 1)
        best, index = score(fns, z, actions).topk(cfg.elites, 1)
        elites = actions.gather(1, index[:, :, None, None].expand(-1, -1, *shape[1:]))
        weights = (cfg.temperature * best).softmax(1)[:, :, None, None]
        centre = (weights * elites).sum(1)
        std = (weights * (elites - centre.unsqueeze(1)).square()).sum(1).sqrt().clamp(cfg.std_min, cfg.std_max)
        mean = cfg.momentum * mean + (1 - cfg.momentum) * centre
    drawn = weights[:, :, 0, 0].cumsum(1).lt(uniform((1,), z_root, generator)).sum(1).clamp(max=cfg.elites - 1)
    chosen = elites.gather(1, drawn[:, None, None, None].expand(-1, 1, *shape[1:])).squeeze(1)
    return Shot(chosen, best[:, 0], mean)


def follow_policy(fns: SearchFns, z: Tensor, cfg: MPPIConfig, generator: RowGenerator, count: int) -> Tensor:
    """Actions [B, count, H, A] of π^g with noise, rolled out by the dynamics from z [B, 1, D]."""
    action_dim = fns.act_global(z).shape[-1]
    noise = normal((count, cfg.horizon, action_dim), z, generator) * cfg.policy_std
    z = z.expand(-1, count, -1)
    actions = []
    for step in range(cfg.horizon):
        actions.append((fns.act_global(z) + noise[:, :, step]).clamp_(-1, 1))
        z = fns.step(z, actions[-1])
    return torch.stack(actions, 2)


def score(fns: SearchFns, z: Tensor, actions: Tensor) -> Tensor:
    """Accumulated state-action values (App. D.4): z [B, 1, D], actions [B, S, H, A] → [B, S], the sum of Q^g(z_t, a_t)."""
    z = z.expand(-1, actions.shape[1], -1)
    total = z.new_zeros(z.shape[:2])
    for step in range(actions.shape[2]):
        total += fns.q(z, actions[:, :, step])
        if step + 1 < actions.shape[2]:
            z = fns.step(z, actions[:, :, step])
    return total
