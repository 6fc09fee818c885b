"""What leads in place of Algorithm 2 (ours).

A leader takes over a row while its condition holds; of several leaders the first one acts. Policies in place of π^g lead
where Algorithm 2 asks for π^g: near the goal, and where a plan leads nowhere.

B environments, S actions to choose from, D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from velap.config import Config
from velap.config.planning import HELD_TURN
from velap.errors import ConfigError
from velap.models.arrivals import GAINS, arrivals
from velap.models.horizon import q_from_steps
from velap.models.velap import LatentModel
from velap.search.types import SearchFns


class Lead(NamedTuple):
    """A leader's answer for every row."""

    leads: Tensor
    """[B] bool."""
    actions: Tensor
    """[B, A] in [-1, 1], where it leads."""


class Leader(Protocol):
    """Leads some rows in place of Algorithm 2, by their latents alone."""

    def lead(self, latents: Tensor, near_goal: Tensor) -> Lead:
        """Latents [B, D], and where Algorithm 2 leaves planning to π^g, bool [B] → which rows it leads, and how."""
        ...


class GlobalPolicy(Protocol):
    """π^g, or what acts in its place."""

    name: str
    """In words, for videos."""

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        ...

    def __call__(self, latents: Tensor) -> Tensor:
        """Latents [B, D], those of the next step at every call → actions [B, A] in [-1, 1]."""
        ...


def leaders_of(config: Config, fns: SearchFns) -> list[Leader]:
    """The leaders that a config asks for, the first one first."""
    controller, leaders = config.controller, list[Leader]()
    if controller.success_exponent > 0 and fns.act_success is not None:
        leaders.append(CloneNearGoal(fns, q_from_steps(controller.success_exponent, fns.discount)))
    if controller.success_rollout > 0:
        goal_value = q_from_steps(config.planner.goal_exponent, fns.discount)
        leaders.append(CloneByRollout(fns, controller.success_rollout, goal_value, GAINS))
    return leaders


def global_policy_of(config: Config, model: LatentModel, fns: SearchFns) -> GlobalPolicy:
    """π^g, or the policy that the config puts in its place."""
    policy: GlobalPolicy = Held(model, HELD_TURN) if model.held_policy is not None else Plain(model)
    return Strongest(policy, fns, config.controller.goal_lookahead) if config.controller.goal_lookahead > 0 else policy


class CloneNearGoal:
    """The policy cloned from successes acts near the goal, unless revisits have lowered Q^g there."""

    def __init__(self, fns: SearchFns, close: float) -> None:
        """`close` [Q-value]: it leads where Q^g is above that."""
        assert fns.act_success is not None
        self._policy, self._value, self._close = fns.act_success, fns.value, close

    def lead(self, latents: Tensor, near_goal: Tensor) -> Lead:
        """Rows where both the learnt and the corrected Q^g put the goal close."""
        return Lead(near_goal & (self._value(latents) > self._close), self._policy(latents))


class CloneByRollout:
    """The policy cloned from successes acts wherever it reaches the goal in the model: h simulates it with its own and with
    stronger actions, and Q^g says whether the goal is reached.

    A search finds the places where h errs in its favour, and plans through objects that h does not know to be solid. A
    policy that was learnt without h does not seek those errors, so its simulated arrival is more credible than a planned
    one.
    """

    def __init__(self, fns: SearchFns, horizon: int, goal_value: float, gains: Sequence[float]) -> None:
        if fns.act_success is None:
            raise ConfigError("config field `success_rollout` is set, but the model has no policy cloned from successes; "
                              "expected 0. Train with `success_policy` and `clone_steps`.")
        self._policy, self._step, self._value = fns.act_success, fns.step, fns.value
        self._horizon, self._goal_value, self._gains = horizon, goal_value, gains

    def lead(self, latents: Tensor, near_goal: Tensor) -> Lead:
        """Rows where a simulation reaches the goal, and the first action of the variant that reaches it first."""
        found = arrivals(self._policy, self._step, self._value, latents, self._goal_value, self._horizon, self._gains)
        soonest, variant = found.steps.min(0)
        return Lead(~soonest.isinf(), found.first[variant, torch.arange(len(latents), device=latents.device)])


class Plain:
    """π^g."""

    name = "global policy"

    def __init__(self, model: LatentModel) -> None:
        self._model = model

    def forget(self, rows: Tensor) -> None:
        """It remembers nothing."""

    def __call__(self, latents: Tensor) -> Tensor:
        """π^g."""
        return self._model.act_global(latents)


class Held:
    """The held policy, or that one and π^g in turns."""

    def __init__(self, model: LatentModel, turn: int) -> None:
        """`turn` [steps] is as long as one of them leads, the held policy first; 0 leaves π^g out."""
        assert model.held_policy is not None
        self._held, self._global, self._turn = model.held_policy, model.act_global, turn
        self._steps = torch.empty(0, dtype=torch.long)
        self.name = "held or global policy" if turn else "held policy"

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        if len(rows) != len(self._steps):
            self._steps = torch.zeros_like(rows, dtype=torch.long)
        self._steps[rows] = 0

    def __call__(self, latents: Tensor) -> Tensor:
        """The action of the policy whose turn it is in each row."""
        held = self._held(latents)
        if self._turn == 0:
            return held
        first = self._steps // self._turn % 2 == 0
        self._steps += 1
        return torch.where(first[:, None], held, self._global(latents))


class Strongest:
    """A policy's action, or a stronger version of it that Q^g prefers after a few steps of h."""

    def __init__(self, policy: GlobalPolicy, fns: SearchFns, count: int) -> None:
        """`count` [steps] is as long as every version is simulated."""
        self._policy, self._fns, self._count, self.name = policy, fns, count, policy.name

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        self._policy.forget(rows)

    def __call__(self, latents: Tensor) -> Tensor:
        """The version of the highest Q^g at its end."""
        policy = self._policy(latents)
        gains = torch.tensor(GAINS, device=policy.device).view(-1, 1)
        actions = (gains * policy.unsqueeze(1)).clamp(-1, 1)
        values = self._fns.value(simulate_held(self._fns, latents, actions, self._count))
        return actions[torch.arange(len(actions), device=actions.device), values.argmax(1)]


def simulate_held(fns: SearchFns, latents: Tensor, actions: Tensor, count: int) -> Tensor:
    """Where `count` steps of each of `actions` [B, S, A] lead from latents [B, D]: [B, S, D]."""
    ends = latents.unsqueeze(1).expand(-1, actions.shape[1], -1)
    for _ in range(count):
        ends = fns.step(ends, actions)
    return ends
