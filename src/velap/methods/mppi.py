"""MPPI, App. D.4: as in TD-MPC (Hansen et al. 2022, Alg. 1), with accumulated state-action values as its score.

B environments, S sampled trajectories, H horizon [steps], E elites, D latent, A action dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from velap.methods.base import Agent, Method, Parts
from velap.methods.mpc import MPCAgent
from velap.registry import register_method
from velap.search.sampling import normal, uniform
from velap.search.shooting import ShootingConfig, Shot, choose_elites, score
from velap.search.types import RowGenerator, SearchFns


@dataclass(frozen=True)
class MPPIConfig(ShootingConfig):
    """MPPI. D.4 builds on TD-MPC, whose defaults fill what it leaves open."""

    policy_share: float = 0.05
    """Share of the trajectories that follow π^g; TD-MPC `mixture_coef`."""
    policy_std: float = 0.05
    """Standard deviation of the noise on π^g's actions; TD-MPC `min_std`."""
    momentum: float = 0.1
    """Share of the old mean in the new one; TD-MPC `momentum`."""
    std_min: float = 0.05
    """TD-MPC `min_std`."""
    std_max: float = 2.0
    """Also the standard deviation of the first iteration; TD-MPC."""

    def _ranges(self) -> dict[str, tuple[bool, str]]:
        return super()._ranges() | {
            "policy_share": (0 <= self.policy_share <= 1, "a share in [0, 1]"),
            "policy_std": (self.policy_std >= 0, "0 or more"),
            "momentum": (0 <= self.momentum < 1, "a share in [0, 1)"),
            "std_min": (0 < self.std_min <= self.std_max, f"above 0, at most std_max = {self.std_max}"),
        }


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
        elites = choose_elites(actions, score(fns, z, actions, cfg.goal_ends), cfg)
        centre, std = elites.mean(), elites.std().clamp(cfg.std_min, cfg.std_max)
        mean = cfg.momentum * mean + (1 - cfg.momentum) * centre
    drawn = elites.weights.cumsum(1).lt(uniform((1,), z_root, generator)).sum(1).clamp(max=cfg.elites - 1)
    chosen = elites.actions[torch.arange(len(drawn), device=drawn.device), drawn]
    return Shot(chosen, elites.scores[:, 0], mean)


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


@register_method("mppi")
class MPPI(Method):
    """MPPI on the joint checkpoint's h, π^g and Q^g."""

    label = "MPPI"
    settings, paper_settings = MPPIConfig(goal_ends=True), MPPIConfig()

    def agent(self, parts: Parts) -> Agent:
        """Replans every few steps."""
        return MPCAgent(self.name, parts.model, parts.settings, shoot)
