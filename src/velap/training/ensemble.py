"""Several π^g, each with critics of its own, whose median becomes the model's (ours).

Where a policy goes from a state that the data hardly hold is an accident of its first weights, and a task of many steps
meets such states. What several policies agree on is no accident; the median of their actions is taught to one policy of the
model, so that nothing acts slower.

E members, B transitions of each, F frames, D latent, A action dimension.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from velap.config import EnsemblePhase
from velap.losses import Info, cloning_error, critic_loss, global_critic_loss, policy_loss, polyak
from velap.models.networks import CRITIC, POLICY, EnsembleMLP
from velap.models.velap import UNREWARDED
from velap.training.capture import adam
from velap.training.phase import FROZEN_RATE, Frozen, PhaseLearner, Run
from velap.training.steps import cosine

BATCH = 512
"""Transitions a batch of each member. ours."""
CLOSE = 1e-4
"""Squared distance of actions, averaged over A, within which the distance has no edge."""


class EnsembleLearner(PhaseLearner[EnsemblePhase]):
    """E pairs of policy and critics by Eq. 4 and 5; each draws transitions of its own. Then the model's policy is taught."""

    def __init__(self, phase: EnsemblePhase, run: Run, frozen: Frozen) -> None:
        super().__init__(phase, run)
        model, shape, action = run.model, run.model.config, run.model.action_dim
        self.latents = frozen.latents
        latent = self.latents.shape[1]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(run.weight_seed + 2)
            self.policies = EnsembleMLP(phase.members, latent, POLICY, shape.norm, action)
            self.critics = EnsembleMLP(phase.members * shape.n_global, latent + action, CRITIC, shape.norm)
        if shape.critic_bounded:
            nn.init.constant_(self.critics.biases[-1], UNREWARDED)
        self.target = copy.deepcopy(self.critics).requires_grad_(False)
        self.modules = {"policies": self.policies, "critics": self.critics, "target": self.target}
        for module in self.modules.values():
            module.to(run.sampler.device)
        learnt = {"critics": [*self.critics.parameters()], "policies": [*self.policies.parameters()],
                  "taught": [*model.global_policy.parameters(), *model.global_critic.parameters()]}
        self.optimizers = {name: adam(parameters, FROZEN_RATE) for name, parameters in learnt.items()}
        self.deviation = self.latents.std(0)
        """float32 [D], of each dimension over the data."""

    def update(self, done: int) -> Info:
        """One update of the members, or after those of what they teach."""
        steps = self.phase.steps
        if done >= steps:
            self.set_rate(FROZEN_RATE * cosine((done - steps) / (self.phase.updates - steps)))
            return self.captured("distil", self._distil)
        self.set_rate(FROZEN_RATE * cosine(done / steps))
        return self.in_turn(self._learn)

    def _learn(self, policies: bool) -> Info:
        rows = self.draw(self.phase.members)
        noise = self.noise(rows)
        self.optimizers["critics"].zero_grad(set_to_none=True)
        loss, info = self.value_loss(rows, noise)
        loss.backward()
        self.optimizers["critics"].step()
        polyak(list(self.target.parameters()), list(self.critics.parameters()), self.run.config.target_rate)
        if not policies:
            return info
        self.optimizers["policies"].zero_grad(set_to_none=True)
        loss, more = self.acting_loss(rows, noise)
        loss.backward(inputs=list(self.policies.parameters()))
        self.optimizers["policies"].step()
        return {**info, **more}

    def _distil(self) -> Info:
        self.optimizers["taught"].zero_grad(set_to_none=True)
        rows = self.draw(1)[0]
        loss, info = self.distil_loss(rows)
        loss.backward()
        self.optimizers["taught"].step()
        return info

    def draw(self, members: int) -> Tensor:
        """Rows of transitions from all over the data: int64 [members, B]."""
        pool = self.run.sampler.transitions
        return pool[torch.randint(len(pool), (members, BATCH), generator=self.run.generator, device=pool.device)]

    def noise(self, rows: Tensor) -> Tensor | float:
        """Noise on the latents of rows int64 [E, B]: [E, B, D]. Both states of a transition get the same: where φ mistakes a
        place, it mistakes it a step later too."""
        if self.phase.noise == 0:
            return 0.0
        drawn = torch.randn(*rows.shape, len(self.deviation), generator=self.run.generator, device=rows.device)
        return self.phase.noise * self.deviation * drawn

    def act(self, latents: Tensor) -> Tensor:
        """Each member's action: [E, B, D] → [E, B, A] in [-1, 1]."""
        return torch.tanh(self.policies.each(latents))

    def qs(self, critics: EnsembleMLP, latents: Tensor, actions: Tensor) -> Tensor:
        """Each member's critics: [E, B, D], [E, B, A] → [E, n_global, B] [Q-value]."""
        n_global = self.run.model.config.n_global
        joined = torch.cat([latents, actions], -1).repeat_interleave(n_global, 0)
        return self.run.model.bound(critics.each(joined).squeeze(-1)).view(self.phase.members, n_global, -1)

    def value_loss(self, rows: Tensor, noise: Tensor | float = 0.0) -> tuple[Tensor, Info]:
        """Eq. 4 of every member. rows int64 [E, B], noise [E, B, D]."""
        data, config, weight = self.run.sampler, self.run.config, torch.ones(rows.shape[1], device=rows.device)
        with torch.no_grad():
            then = self.latents[rows + 1] + noise
            next_q = self.qs(self.target, then, self.act(then)).amin(1, keepdim=True)
        q = self.qs(self.critics, self.latents[rows] + noise, data.actions[rows])
        alive = (~data.terminated[rows]).float()
        loss, info = global_critic_loss(
            q, data.rewards[rows].unsqueeze(1), alive.unsqueeze(1), next_q, weight, discount=config.discount,
            kind=config.critic_loss, floor=config.critic_floor)
        return loss, {"ensemble/loss": info["loss"], "ensemble/q": info["q"]}

    def acting_loss(self, rows: Tensor, noise: Tensor | float = 0.0) -> tuple[Tensor, Info]:
        """Eq. 5 of every member. rows int64 [E, B], noise [E, B, D]."""
        config, weight = self.run.config, torch.ones(rows.shape[1], device=rows.device)
        latents = self.latents[rows] + noise
        action = self.act(latents)
        q = self.qs(self.critics, latents, action).amin(1)
        loss, info = policy_loss(q, action, self.run.sampler.actions[rows], config.c3, weight,
                                 relative=config.critic_loss == "cross_entropy")
        return loss, {"ensemble/policy": info["loss"], "ensemble/imitation": info["imitation"]}

    def distil_loss(self, rows: Tensor) -> tuple[Tensor, Info]:
        """π^g against the members' actions, by distance, not by its square: it learns their median, and one
        that stands alone is not heard. π^g's critic learns the mean of their minima, at the data's and at π^g's own actions.

        rows int64 [B].
        """
        model, config, latents, count = self.run.model, self.run.config, self.latents[rows], self.phase.members
        action = model.global_policy(latents)
        at = torch.cat([self.run.sampler.actions[rows], action.detach()])
        with torch.no_grad():
            every = latents.expand(count, -1, -1)
            actions = self.act(every)
        acting = (cloning_error(action, actions) + CLOSE).sqrt().mean()
        with torch.no_grad():
            value = self.qs(self.critics, every.repeat(1, 2, 1), at.expand(count, -1, -1)).amin(1).mean(0)
        values, _ = critic_loss(model.global_qs(latents.repeat(2, 1), at), value, torch.ones_like(value),
                                kind=config.critic_loss, floor=config.critic_floor)
        return acting + values, {"ensemble/distil": acting.detach(), "ensemble/distil_q": values.detach()}
