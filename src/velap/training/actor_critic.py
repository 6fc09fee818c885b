"""Critics and policies of Eq. 1 under TD3-BC: the terms of Eq. 2 and 5 on given latents, and the target critics.

M latents, T transitions, D latent dimension.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from velap.config import TrainConfig
from velap.data.sampling import Batch
from velap.losses import (
    KL_WEIGHT,
    Info,
    action_model_loss,
    global_critic_loss,
    local_critic_loss,
    policy_loss,
    polyak,
    reparameterise,
)
from velap.models.velap import LatentModel
from velap.training.encoding import evaluated


class ActorCritic:
    """Q^l, Q^g, π^l, π^g and g of a model, and its target critics."""

    def __init__(self, model: LatentModel, config: TrainConfig) -> None:
        self.model, self.config = model, config
        self.local_target = copy.deepcopy(model.local_critics).requires_grad_(False).eval()
        self.global_target = copy.deepcopy(model.global_critic).requires_grad_(False).eval()
        acting = (model.local_policy, model.global_policy, model.action_model)
        self.policy_parameters = [p for part in acting for p in part.parameters()]
        """Of π^l, π^g and g."""
        targets, sources = (self.local_target, self.global_target), (model.local_critics, model.global_critic)
        self._parameters = tuple([p for m in each for p in m.parameters()] for each in (targets, sources))
        self._buffers = tuple([b for m in each for b in m.buffers()] for each in (targets, sources))

    def copy_targets(self) -> None:
        """The targets become the critics."""
        self.local_target.load_state_dict(self.model.local_critics.state_dict())
        self.global_target.load_state_dict(self.model.global_critic.state_dict())

    def follow(self) -> None:
        """The targets take a step towards the critics."""
        target, source = self._parameters
        polyak(target, source, self.config.target_rate)
        for old, new in zip(*self._buffers, strict=True):
            old.copy_(new)

    def critic_losses(self, latents: Tensor, batch: Batch) -> tuple[Tensor, Tensor, Info]:
        """L_Q^l of Eq. 3, averaged over the ensemble, and L_Q^g of Eq. 4. latents [M, D]."""
        model, config, weight = self.model, self.config, batch.weight
        now, then, goal = latents[batch.now_at], latents[batch.now_at + 1], latents[batch.goal_at]
        with torch.no_grad(), evaluated(model.local_policy, model.global_policy):
            action = model.act_local(then, goal)
            next_local = model.bound(self.local_target(torch.cat([then, goal, action], -1))).amin(0)
            next_global = model.bound(self.global_target(torch.cat([then, model.act_global(then)], -1))).amin(0)
        local, local_info = local_critic_loss(
            model.local_q(now, goal, batch.action), batch.goal_reward, batch.goal_proceeds, next_local, weight,
            discount=config.discount, kind=config.critic_loss)
        task, task_info = global_critic_loss(
            model.global_qs(now, batch.action), batch.reward, batch.proceeds, next_global, weight,
            discount=config.discount, kind=config.critic_loss, floor=config.critic_floor)
        return local, task, {"local/loss": local_info["loss"], "local/q": local_info["q"], "global/loss": task_info["loss"],
                             "global/q": task_info["q"]}

    def policy_losses(self, latents: Tensor, batch: Batch, generator: torch.Generator) -> tuple[Tensor, Info]:
        """Eq. 5 for π^l and π^g, and the β-VAE of g; `policy_parameters` alone take its gradient. latents [M, D]."""
        model, config, weight = self.model, self.config, batch.weight
        relative = config.critic_loss == "cross_entropy"
        now, goal = latents[batch.now_at], latents[batch.goal_at]
        local_action, global_action = model.act_local(now, goal), model.act_global(now)
        with evaluated(model.local_critics, model.global_critic):
            local_q = model.local_q(now, goal, local_action).amin(0)
            global_q = model.global_q(now, global_action)
        local, local_info = policy_loss(local_q, local_action, batch.action, config.c2, weight, relative=relative)
        task, task_info = policy_loss(global_q, global_action, batch.action, config.c3, weight, relative=relative)
        mean, log_variance = model.action_model.posterior(now, batch.action)
        noise = torch.randn(mean.shape, generator=generator, device=mean.device)
        decoded = model.propose(now, reparameterise(mean, log_variance, noise))
        proposals, g_info = action_model_loss(decoded, batch.action, mean, log_variance, KL_WEIGHT, weight)
        return local + task + proposals, {
            "local/policy": local_info["loss"], "local/imitation": local_info["imitation"],
            "global/policy": task_info["loss"], "global/imitation": task_info["imitation"],
            "g/reconstruction": g_info["reconstruction"], "g/kl": g_info["kl"]}

    def improve_policies(
        self, optimizer: torch.optim.Optimizer, latents: Tensor, batch: Batch, generator: torch.Generator
    ) -> Info:
        """One update of π^l, π^g and g, the latents [M, D] held fixed."""
        optimizer.zero_grad(set_to_none=True)
        loss, info = self.policy_losses(latents, batch, generator)
        loss.backward(inputs=self.policy_parameters)
        optimizer.step()
        return info
