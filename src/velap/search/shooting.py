"""Trajectory optimisation by shooting: MPPI as in TD-MPC (Hansen et al. 2022, Alg. 1) with the score of App. D.4, and MBOP
(Argenson and Dulac-Arnold 2021, Alg. 2) with the policy and score of App. D.5.

B environments, S sampled trajectories, H horizon [steps], E elites, D latent, A action dimension. A method is a way to
propose trajectories and a centre that its elites move; score and choice of the elites are shared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from velap.config.training import Precision
from velap.errors import ConfigError
from velap.search.sampling import normal, uniform
from velap.search.types import RowGenerator, SearchFns


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


@torch.inference_mode()
def shoot_mbop(
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
        value = _value(fns.q(z, actions[-1]), value, step, cfg.goal_ends)
        total = total + value
        if step + 1 < noise.shape[2]:
            z = fns.step(z, actions[-1])
    return torch.stack(actions, 2), total


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


def score(fns: SearchFns, z: Tensor, actions: Tensor, goal_ends: bool = False) -> Tensor:
    """Accumulated state-action values (App. D.4): z [B, 1, D], actions [B, S, H, A] → [B, S], the sum of Q^g(z_t, a_t).

    With `goal_ends` the sum of max_{i <= t} Q^g(z_i, a_i).
    """
    z = z.expand(-1, actions.shape[1], -1)
    total = value = z.new_zeros(z.shape[:2])
    for step in range(actions.shape[2]):
        value = _value(fns.q(z, actions[:, :, step]), value, step, goal_ends)
        total = total + value
        if step + 1 < actions.shape[2]:
            z = fns.step(z, actions[:, :, step])
    return total


def _value(q: Tensor, before: Tensor, step: int, goal_ends: bool) -> Tensor:
    """What step `step` adds to a score, given Q^g there and what the step before added."""
    return torch.maximum(q, before) if goal_ends and step else q
