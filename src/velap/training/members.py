"""Several π^g, each with critics of its own, whose median becomes the model's (ours).

Where a policy goes from a state that the data hardly hold is an accident of its first weights, and a task of many steps
meets such states. What several policies agree on is no accident; the median of their actions is taught to the one policy
of the model, so that nothing acts slower.

E members, B transitions of each, F frames, D latent, A action dimension.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from velap.config.training import TrainConfig
from velap.data.sampling import WindowSampler
from velap.losses import (
    Info,
    cloning_error,
    critic_error,
    policy_loss,
    polyak,
    td_target,
)
from velap.models.networks import EnsembleMLP
from velap.models.velap import UNREWARDED, LatentModel
from velap.training.capture import adam
from velap.training.held import hold as held_transitions

BATCH = 512
"""Transitions a batch of each member. ours."""
HELD_ACTIONS = 5
"""Steps that the held policy's members take as one transition; its action is the mean of as many [steps]. ours."""
HELD_MEMBERS = 3
"""Members of the held policy. ours."""
CLOSE = 1e-4
"""Squared distance of actions, averaged over A, within which the distance has no edge."""


class Members(nn.Module):
    """E pairs of policy and critics that learn Eq. 4 and 5 on cached latents; each draws transitions of its own.

    With `hold` above 1 [steps] a transition is of so many steps, and the members are those of the held policy.
    """

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, generator: torch.Generator,
                 hold: int = 1) -> None:
        super().__init__()
        self.config, self.sampler, self.bound = config, sampler, model.bound
        shape, action = model.config, model.action_dim
        latent = shape.width(action)
        self.count, self.n_global = HELD_MEMBERS if hold > 1 else config.members, shape.n_global
        self.data = held_transitions(sampler, hold, config.discount)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(generator.initial_seed() + (3 if hold > 1 else 2))
            self.policies = EnsembleMLP(self.count, latent, shape.policy_dense, shape.norm, action)
            self.critics = EnsembleMLP(self.count * self.n_global, latent + action, shape.critic_dense, shape.norm)
        if shape.critic_bounded:
            nn.init.constant_(self.critics.biases[-1], UNREWARDED)
        self.target = copy.deepcopy(self.critics).requires_grad_(False)
        self.to(sampler.device)
        self.hold, values = hold, [] if hold > 1 else [*model.global_critic.parameters()]
        prefix, self.name = ("held_", "held") if hold > 1 else ("", "members")
        learnt = {
            f"{prefix}member_critics": [*self.critics.parameters()],
            f"{prefix}member_policies": [*self.policies.parameters()],
            f"{prefix}distil": [*self.pupil(model).parameters(), *values],
        }
        self.optimizers = {name: adam(parameters, config.latent_learning_rate) for name, parameters in learnt.items()}
        """By name: of the critics, of the policies, of what they teach."""
        self.deviation: Tensor | None = None
        """float32 [D], of the cache."""
        self.error = critic_error(config.critic_loss, config.critic_floor)

    def update(self, cache: Tensor, policies: bool, generator: torch.Generator) -> Info:
        """One update of the critics, and of the policies where it is their turn. cache [F, D]."""
        critics, acting, _ = self.optimizers.values()
        rows = self.draw(self.count, generator)
        blur = self.blur(cache, rows, generator)
        critics.zero_grad(set_to_none=True)
        loss, info = self.value_loss(cache, rows, blur)
        loss.backward()
        critics.step()
        polyak(list(self.target.parameters()), list(self.critics.parameters()), self.config.target_rate)
        if not policies:
            return info
        acting.zero_grad(set_to_none=True)
        loss, more = self.acting_loss(cache, rows, blur)
        loss.backward(inputs=list(self.policies.parameters()))
        acting.step()
        return {**info, **more}

    def distil(self, model: LatentModel, cache: Tensor, generator: torch.Generator) -> Info:
        """One update of the model's π^g and Q^g, or of its held policy. cache [F, D]."""
        *_, optimizer = self.optimizers.values()
        optimizer.zero_grad(set_to_none=True)
        rows = self.draw(1, generator)[0]
        loss, info = self.lesson(model, cache, rows) if self.hold > 1 else self.distil_loss(model, cache, rows)
        loss.backward()
        optimizer.step()
        return info

    def pupil(self, model: LatentModel) -> nn.Module:
        """The policy that they teach."""
        if self.hold == 1:
            return model.global_policy
        assert model.held_policy is not None, "held_steps asks for held_policy"
        return model.held_policy

    def draw(self, members: int, generator: torch.Generator) -> Tensor:
        """Rows of transitions from all over the data: int64 [members, B]."""
        pool = self.sampler.transitions
        return pool[torch.randint(len(pool), (members, BATCH), generator=generator,
                                  device=pool.device)]

    def blur(self, cache: Tensor, rows: Tensor, generator: torch.Generator) -> Tensor | float:
        """Noise of `member_noise` deviations of each dimension [E, B, D], the same in both states of a transition: what φ
        mistakes about a place it mistakes a step later too. rows int64 [E, B]."""
        if self.config.member_noise == 0:
            return 0.0
        if self.deviation is None:
            self.deviation = cache.std(0)
        noise = torch.randn(*rows.shape, cache.shape[1], generator=generator, device=cache.device)
        return self.config.member_noise * self.deviation * noise

    def act(self, latents: Tensor) -> Tensor:
        """Each member's action: [E, B, D] → [E, B, A] in [-1, 1]."""
        return torch.tanh(self.policies.each(latents))

    def qs(self, critics: EnsembleMLP, latents: Tensor, actions: Tensor) -> Tensor:
        """Each member's critics: [E, B, D], [E, B, A] → [E, n_global, B] [Q-value]."""
        joined = torch.cat([latents, actions], -1).repeat_interleave(self.n_global, 0)
        return self.bound(critics.each(joined).squeeze(-1)).view(self.count, self.n_global, -1)

    def value_loss(self, cache: Tensor, rows: Tensor, blur: Tensor | float = 0.0) -> tuple[Tensor, Info]:
        """Eq. 4 of every member. cache [F, D], rows int64 [E, B], blur [E, B, D]."""
        data, weight = self.data, torch.ones(rows.shape[1], device=rows.device)
        with torch.no_grad():
            then = cache[data.following[rows]] + blur
            next_q = self.qs(self.target, then, self.act(then)).amin(1)
            goal = td_target(data.rewards[rows], data.alive[rows], next_q, self.config.discount)
        loss, info = self.error(self.qs(self.critics, cache[rows] + blur, data.actions[rows]), goal.unsqueeze(1), weight)
        return loss, {f"{self.name}/loss": info["loss"], f"{self.name}/q": info["q"]}

    def acting_loss(self, cache: Tensor, rows: Tensor, blur: Tensor | float = 0.0) -> tuple[Tensor, Info]:
        """Eq. 5 of every member. cache [F, D], rows int64 [E, B], blur [E, B, D]."""
        latents = cache[rows] + blur
        action = self.act(latents)
        q = self.qs(self.critics, latents, action).amin(1)
        weight = torch.ones(rows.shape[1], device=rows.device)
        loss, info = policy_loss(q, action, self.data.actions[rows], self.config.c3, weight,
                                 relative=self.config.policy_relative)
        return loss, {f"{self.name}/policy": info["loss"], f"{self.name}/imitation": info["imitation"]}

    def distil_loss(self, model: LatentModel, cache: Tensor, rows: Tensor) -> tuple[Tensor, Info]:
        """The model's π^g against the members' actions, by distance, not by its square: it learns their median, and one that
        stands alone is not heard. Q^g against the mean of their minima, at the data's and at π^g's own actions.

        cache [F, D], rows int64 [B].
        """
        latents = cache[rows]
        action = model.act_global(latents)
        at = torch.cat([self.sampler.actions[rows], action.detach()])
        with torch.no_grad():
            every = latents.expand(self.count, -1, -1)
            actions = self.act(every)
            value = self.qs(self.critics, every.repeat(1, 2, 1), at.expand(self.count, -1, -1)).amin(1).mean(0)
        acting = (cloning_error(action, actions) + CLOSE).sqrt().mean()
        values, _ = self.error(model.global_qs(latents.repeat(2, 1), at), value, torch.ones_like(value))
        return acting + values, {"distil/policy": acting.detach(), "distil/q": values.detach()}

    def lesson(self, model: LatentModel, cache: Tensor, rows: Tensor) -> tuple[Tensor, Info]:
        """The held policy against the members' actions, their median again. cache [F, D], rows int64 [B]."""
        latents = cache[rows]
        with torch.no_grad():
            actions = self.act(latents.expand(self.count, -1, -1))
        loss = (cloning_error(self.pupil(model)(latents), actions) + CLOSE).sqrt().mean()
        return loss, {"held_distil/policy": loss.detach()}
