"""MBOP, App. D.5: Argenson and Dulac-Arnold 2021, Alg. 2, with π^g as its policy and accumulated state-action values as its
score.

B environments, S sampled trajectories, H horizon [steps], E elites, D latent, A action dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from velap.methods.base import Agent, Method, Parts
from velap.methods.mpc import MPCAgent
from velap.registry import register_method
from velap.search.sampling import normal
from velap.search.shooting import ShootingConfig, Shot, choose_elites, step_score
from velap.search.types import RowGenerator, SearchFns


@dataclass(frozen=True)
class MBOPConfig(ShootingConfig):
    """MBOP. D.5 gives the counts and β; of the noise it says that it is small."""

    beta: float = 0.7
    """β, share of the previous plan in a sampled action, App. D.5."""
    noise_std: float = 0.2
    """σ, standard deviation of the noise on π^g's actions, before the mixture; actions lie in [-1, 1]. ours."""

    def _ranges(self) -> dict[str, tuple[bool, str]]:
        return super()._ranges() | {
            "beta": (0 <= self.beta < 1, "a share in [0, 1)"),
            "noise_std": (self.noise_std >= 0, "0 or more"),
        }


@torch.inference_mode()
def shoot(
    fns: SearchFns, z_root: Tensor, cfg: MBOPConfig, generator: RowGenerator, previous_plan: Tensor | None = None
) -> Shot:
    """MBOP from z_root [B, D]; `previous_plan` [B, H, A] (already shifted) takes the place of zeros, MBOP's T_0.

    Each iteration is one pass of MBOP's Algorithm 2 whose previous plan is the result of the one before; D.5 has five of
    them and averages over elites.
    """
    z = z_root.unsqueeze(1)
    action_dim = fns.act_global(z_root).shape[-1]
    plan = z.new_zeros(len(z_root), cfg.horizon, action_dim) if previous_plan is None else previous_plan
    for _ in range(cfg.iterations):
        noise = normal((cfg.samples, cfg.horizon, action_dim), z_root, generator).mul_(cfg.noise_std)
        elites = choose_elites(*mixed_rollouts(fns, z, plan, noise, cfg), cfg)
        plan = elites.mean()
    return Shot(plan, elites.scores[:, 0], plan)


def mixed_rollouts(fns: SearchFns, z: Tensor, plan: Tensor, noise: Tensor, cfg: MBOPConfig) -> tuple[Tensor, Tensor]:
    """MBOP's proposals: a_t = (1 - β) (π^g(z_t) + noise_t) + β plan_t, kept in [-1, 1], rolled out by the dynamics.

    Args:
        fns: dynamics, policy and critic.
        z: [B, 1, D] where every trajectory begins.
        plan: [B, H, A] the previous plan.
        noise: [B, S, H, A].
        cfg: with β.

    Returns:
        Actions [B, S, H, A] and their accumulated state-action values [B, S], as `score` gives them.
    """
    z = z.expand(-1, noise.shape[1], -1)
    total = value = z.new_zeros(z.shape[:2])
    actions = []
    for step in range(noise.shape[2]):
        proposed = (fns.act_global(z) + noise[:, :, step]).mul_(1 - cfg.beta)
        actions.append(proposed.add_(plan[:, None, step], alpha=cfg.beta).clamp_(-1, 1))
        value = step_score(fns.q(z, actions[-1]), value, step, cfg.goal_ends)
        total = total + value
        if step + 1 < noise.shape[2]:
            z = fns.step(z, actions[-1])
    return torch.stack(actions, 2), total


@register_method("mbop")
class MBOP(Method):
    """MBOP on the joint checkpoint's h, π^g and Q^g."""

    label = "MBOP"
    settings, paper_settings = MBOPConfig(goal_ends=True), MBOPConfig()

    def agent(self, parts: Parts) -> Agent:
        """Replans every few steps."""
        return MPCAgent(self.name, parts.model, parts.settings, shoot)
