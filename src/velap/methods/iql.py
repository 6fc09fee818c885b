"""Implicit Q-learning, App. D.3, after Kostrikov, Nair and Levine, "Offline Reinforcement Learning with Implicit
Q-Learning", 2022, and their code.

B rows of a batch, n critics, A action dimension. Value, critics and policy are updated together from the parameters before
the update. The policy is Table 5's deterministic one: a Gaussian of fixed width, whose log-likelihood is the squared error.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from velap.config import ModelConfig
from velap.losses import Info, cloning_error, polyak, td_target
from velap.methods.base import Agent, Method, Parts
from velap.methods.heads import PolicyHead
from velap.methods.reactive import ReactiveAgent
from velap.models.networks import CRITIC, MLP, EnsembleMLP
from velap.registry import register_method
from velap.training.encoding import evaluated
from velap.training.frozen import FrozenLearner, LatentData, LearnerConfig
from velap.training.steps import cosine


@dataclass(frozen=True)
class IQLConfig(LearnerConfig):
    """D.3, and where it is silent the authors' code."""

    steps: int = 15_000
    """Updates. D.3: 3·10⁵. ours: see docs/experiments/2026-11-heads.md."""
    learning_rate: float = 3e-4
    """D.3."""
    cosine: bool = False
    """The critics' learning rate is constant, as in the authors' code."""
    policy_cosine: bool = True
    """The policy's learning rate falls along a cosine, as in the authors' code (to a hundredth here)."""
    expectile: float = 0.7
    """τ, D.3; the authors take 0.9 in AntMaze."""
    inverse_temperature: float = 3.0
    """β, D.3; the authors take 10 in AntMaze."""
    weight_clip: float = 100.0
    """Largest advantage weight, authors' code."""
    target_rate: float = 0.02
    """Polyak rate of the target critics. Authors' code, and `paper`: 0.005. ours: four times that needs a quarter of the
    updates."""
    reward_shift: float = 0.0
    """Added to every reward. The authors take -1 in AntMaze, so that advantages are of the order of a step."""
    rewarded_share: float = 0.05
    """Share of a batch drawn among rewarded transitions, as in the joint training. ours; 0 in `paper`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require("expectile", 0.5 <= self.expectile < 1, "an expectile from 0.5 to below 1")
        self.require("inverse_temperature", self.inverse_temperature >= 0, "0 or more")
        self.require("weight_clip", self.weight_clip > 0, "a positive number")
        self.require("target_rate", 0 < self.target_rate <= 1, "a rate in (0, 1]")
        self.require("rewarded_share", 0 <= self.rewarded_share <= 1, "a share in [0, 1]")


PAPER_IQL = IQLConfig(steps=300_000, target_rate=0.005, rewarded_share=0.0)
"""D.3."""
SPARSE_IQL = IQLConfig(expectile=0.9, inverse_temperature=10.0, reward_shift=-1.0)
"""The setting of IQL's authors for sparse rewards (AntMaze), with the default preset's length and sampling."""
PAPER_SPARSE_IQL = dataclasses.replace(PAPER_IQL, expectile=0.9, inverse_temperature=10.0, reward_shift=-1.0)
"""The same with D.3's length."""

N_CRITICS = 2
"""Q-networks, of which the minimum counts (Kostrikov et al. 2022, as in TD3)."""


class IQLHead(PolicyHead):
    """The policy of Table 5 beside the critics Q and V of Table 6."""

    def __init__(self, config: ModelConfig, action_dim: int, state_dim: int = 0) -> None:
        super().__init__(config, action_dim, state_dim)
        self.critics = EnsembleMLP(N_CRITICS, self.latent_dim + action_dim, CRITIC, config.norm)
        self.value_net = MLP(self.latent_dim, CRITIC, 1, config.norm)

    def qs(self, latent: Tensor, action: Tensor) -> Tensor:
        """Q of every critic: `[*, D], [*, A] → [n, *]` [Q-value, in units of the learner's reward]."""
        return self.critics(torch.cat([latent, action], -1))

    def value(self, latent: Tensor) -> Tensor:
        """V: `[*, D] → [*]` [Q-value, in units of the learner's reward]."""
        return self.value_net(latent).squeeze(-1)


def expectile_loss(value: Tensor, target: Tensor, expectile: float) -> Tensor:
    """L2^τ, Eq. 5 of IQL: |τ - 1(u < 0)| · u² with u = target - value, averaged; all [B]."""
    error = target - value
    return (torch.where(error > 0, expectile, 1 - expectile) * error.square()).mean()


def advantage_weights(q: Tensor, value: Tensor, inverse_temperature: float, clip: float) -> Tensor:
    """min(exp(β · (Q - V)), clip), Eq. 7 of IQL; all [B], no gradient."""
    return (inverse_temperature * (q - value)).exp().clamp(max=clip).detach()


class IQLLearner(FrozenLearner[IQLConfig, IQLHead]):
    """V by expectile regression on the target critics, Q by V of the next state, π by advantage-weighted cloning."""

    def __init__(self, head: IQLHead, data: LatentData, config: IQLConfig, generator: torch.Generator) -> None:
        super().__init__(head, data, config, generator)
        self.target = copy.deepcopy(head.critics).requires_grad_(False).eval()
        self.companions = {"critics": self.target}
        self.optimizers = {"values": self._adam(head.critics, head.value_net), "policy": self._adam(head.policy)}
        self._pairs = (
            list(self.target.parameters()), list(head.critics.parameters()),
            list(self.target.buffers()), list(head.critics.buffers()),
        )

    def loss(self, rows: Tensor) -> tuple[Tensor, Info]:
        """Sum of the three losses; each reaches its own network only, so one gradient serves all."""
        data, config, head = self.data, self.config, self.model
        latent, action = data.latents[rows], data.actions[rows]
        with torch.no_grad(), evaluated(head.value_net):
            proceeds = (~data.terminated[rows]).float()
            reward = data.rewards[rows] + config.reward_shift
            goal = td_target(reward, proceeds, head.value(data.latents[rows + 1]), data.discount)
            estimate = self.target(torch.cat([latent, action], -1)).amin(0)
        value = head.value(latent)
        value_loss = expectile_loss(value, estimate, config.expectile)
        critic_loss = (head.qs(latent, action) - goal).square().sum(0).mean()
        weight = advantage_weights(estimate, value, config.inverse_temperature, config.weight_clip)
        error = cloning_error(head.act(latent), action)
        policy_loss = (weight * error).mean()
        info = {
            "value": value_loss.detach(),
            "critics": critic_loss.detach(),
            "policy": policy_loss.detach(),
            "cloning": error.detach().mean(),
            "v": value.detach().mean(),
            "weight": weight.mean(),
            "clipped": (weight >= config.weight_clip).float().mean(),
        }
        return value_loss + critic_loss + policy_loss, info

    def draw(self) -> Tensor:
        """Uniform rows [B], a fixed share of them replaced by rewarded transitions where there are any."""
        rows, rewarded = super().draw(), self.data.rewarded
        count = round(self.config.rewarded_share * len(rows))
        if count and len(rewarded):
            rows[:count] = rewarded[self._integers(len(rewarded), count)]
        return rows

    def schedule(self, done: float) -> None:
        """A cosine for the policy, and for the critics where the config says so."""
        rate = self.config.learning_rate
        if self.config.policy_cosine:
            self._set_rate("policy", rate * cosine(done))
        if self.config.cosine:
            self._set_rate("values", rate * cosine(done))

    def follow(self) -> None:
        """Target critics by Polyak averaging; running statistics are copied."""
        target, source, target_buffers, source_buffers = self._pairs
        polyak(target, source, self.config.target_rate)
        for old, new in zip(target_buffers, source_buffers, strict=True):
            old.copy_(new)


@register_method("iql")
class IQL(Method):
    """IQL with D.3's τ and β."""

    label = "IQL"
    head, learner = IQLHead, IQLLearner
    learning, paper_learning = IQLConfig(), PAPER_IQL

    def agent(self, parts: Parts) -> Agent:
        """The policy at every step."""
        return ReactiveAgent(self.name, parts.model, parts.head.act)


@register_method("iql-sparse")
class SparseIQL(IQL):
    """IQL as its authors set it for sparse rewards."""

    label = "IQL (0.9 / 10)"
    learning, paper_learning = SPARSE_IQL, PAPER_SPARSE_IQL
