"""Joint training of the Eq. 1 bundle (Eq. 2-5, 9; App. B.4, B.5), and the latent phase that follows it (ours).

Letters: M rows of a batch, T transitions, B windows, L steps a window, k rollout steps, W rollouts, D latent dimension.

Each update alternates the model (encoder, dynamics, critics) and the policies with the latents held fixed. The action
model g learns beside the policies, on fixed latents too: Eq. 2 has no term for it.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial

import torch
from torch import Tensor, nn

from velap.config.training import TrainConfig
from velap.data.sampling import Batch, WindowSampler
from velap.losses import (
    Info,
    action_model_loss,
    critic_error,
    infonce_loss,
    policy_loss,
    polyak,
    reparameterise,
    rollout_mse_loss,
    td_target,
)
from velap.models.encoders.moments import MomentEncoder
from velap.models.velap import LatentModel
from velap.threads import TRANSITIONS_A_THREAD, one_thread
from velap.training.capture import Captured, adam, set_rate
from velap.training.clones import Cloning
from velap.training.latents import commands_before, encode_all, evaluated
from velap.training.members import HELD_ACTIONS, Members
from velap.training.pairs import FrameDecoder, PairObjective
from velap.training.slow import MomentObjective
from velap.training.steps import cosine

LATENT_BATCH = 256
"""Windows a batch of the latent phase. ours."""
VALUE_BATCH = 512
"""Transitions a batch of the value phase. ours."""


def rollouts(model: LatentModel, latents: Tensor, batch: Batch, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """k-step predictions of h along the data's actions from `batch.unrolled`: predicted [k, W, D], positions int64 [k, W] of
    the truth, valid [k, W]. latents [M, D].
    """
    width = batch.valid.shape[1] + 1
    window, step = batch.unrolled // width, batch.unrolled % width
    latent = latents[batch.unrolled]
    predicted, truth, valid = [], [], []
    for i in range(k):
        latent = model.step(latent, batch.actions[window, step + i])
        predicted.append(latent)
        truth.append(batch.unrolled + i + 1)
        valid.append(batch.valid[window, step + i])
    return torch.stack(predicted), torch.stack(truth), torch.stack(valid)


class JointLearner:
    """Owns the model, its target critics and the optimisers; `encoder_step`, `joint_step`, `latent_step`,
    `value_step`, `member_step`, `distil_step` and `clone_step` are single updates."""

    def __init__(self, model: LatentModel, config: TrainConfig, sampler: WindowSampler, generator: torch.Generator) -> None:
        self.model, self.config, self.sampler, self.generator = model, config, sampler, generator
        if config.heads_afresh and model.config.command_memory > 0:
            model.command_weight.zero_()
        self.local_target = copy.deepcopy(model.local_critics).requires_grad_(False).eval()
        self.global_target = copy.deepcopy(model.global_critic).requires_grad_(False).eval()
        self.decoder = None
        if config.reconstruction > 0:
            self.decoder = FrameDecoder(model, config.reconstruction_side, sampler, generator)
        self.pairs: PairObjective | MomentObjective | None = None
        if config.encoder_steps > 0:
            objective = MomentObjective if isinstance(model.encoder, MomentEncoder) else PairObjective
            self.pairs = objective(model, config, sampler, generator)
        self.members: Members | None = None
        if config.member_steps > 0:
            self.members = Members(model, config, sampler, generator)
        self.held: Members | None = None
        if config.held_steps > 0:
            self.held = Members(model, config, sampler, generator, hold=HELD_ACTIONS)
        self.cloning: Cloning | None = None
        if config.clone_steps > 0:
            assert model.success_policy is not None, "clone_steps asks for success_policy"
            self.cloning = Cloning(model.success_policy, config, sampler)
        self.cache: Tensor | None = None
        self.updates = 0
        self.graphs = sampler.device.type == "cuda"
        """Updates are captured as CUDA graphs."""
        self._captured: dict[str, Captured] = {}
        self._optimise(config.learning_rate, encoder=True)
        self.pair_optimizer: torch.optim.Optimizer | None = None
        if self.pairs is not None:
            learnt = [*model.encoder.parameters(), *self.pairs.parameters()]
            self.pair_optimizer = adam(learnt, config.encoder_learning_rate)
        targets = (self.local_target, self.global_target)
        sources = (model.local_critics, model.global_critic)
        self._target_pairs = (
            [p for m in targets for p in m.parameters()],
            [p for m in sources for p in m.parameters()],
            [b for m in targets for b in m.buffers()],
            [b for m in sources for b in m.buffers()],
        )

    @property
    def companions(self) -> dict[str, nn.Module]:
        """Target critics by name, and what is thrown away in the end."""
        clones = None if self.cloning is None else self.cloning.candidates
        extra = {"decoder": self.decoder, "pairs": self.pairs, "clones": clones,
                 "members": self.members, "held": self.held}
        kept = {name: module for name, module in extra.items() if module is not None}
        return {"local": self.local_target, "global": self.global_target, **kept}

    @property
    def optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers by name."""
        extra = {"pairs": self.pair_optimizer, "clone": None if self.cloning is None else self.cloning.optimizer}
        kept = {name: optimizer for name, optimizer in extra.items() if optimizer is not None}
        own = [item for each in (self.members, self.held) if each is not None for item in each.optimizers.items()]
        return {"model": self.model_optimizer, "policy": self.policy_optimizer, **kept, **dict(own)}

    def _optimise(self, learning_rate: float, encoder: bool) -> None:
        """Fresh optimisers; the encoder is left out in the latent phase."""
        model = self.model
        parts: list[nn.Module] = [model.encoder] if encoder else []
        parts += [self.decoder] if encoder and self.decoder is not None else []
        parts += [model.dynamics, model.local_critics, model.global_critic]
        self.model_parameters = [p for part in parts for p in part.parameters()]
        acting: list[nn.Module] = [model.local_policy, model.global_policy, model.action_model]
        self.policy_parameters = [p for part in acting for p in part.parameters()]
        self.model_optimizer = adam(self.model_parameters, learning_rate)
        self.policy_optimizer = adam(self.policy_parameters, learning_rate)
        self._captured.clear()  # they step the old ones

    def encoder_step(self) -> Info:
        """One update of the encoder alone, on pairs of states (ours)."""
        if isinstance(self.pairs, MomentObjective):
            self.pairs.prepare(self.model)
        return self._run("encoder", self._update_encoder)

    def _update_encoder(self) -> Info:
        assert self.pairs is not None and self.pair_optimizer is not None, "encoder_steps is 0"
        self.pair_optimizer.zero_grad(set_to_none=True)
        loss, info = self.pairs.loss(self.model, self.generator)
        loss.backward()
        self.pair_optimizer.step()
        return info

    def joint_step(self) -> Info:
        """One update of Eq. 2, then one of Eq. 5 and of g."""
        return self._run_in_turn("joint", self._update_jointly)

    def _update_jointly(self, policies: bool) -> Info:
        config = self.config
        batch = self.sampler.sample(config.batch_windows, config.window, config.whole_windows, self.generator)
        self.model_optimizer.zero_grad(set_to_none=True)
        stacks = self.sampler.stacks(batch.rows)
        encoded = self.model.encoder(stacks)
        seen = encoded.detach().requires_grad_()  # the heads' gradient is gathered here and goes to the encoder in one piece
        latents = self.model.with_commands(seen, commands_before(self.model, self.sampler, batch.rows))
        with self._threads(batch):
            predicted, truth, valid = rollouts(self.model, latents, batch, config.dynamics_horizon)
            if config.dynamics_loss == "infonce":
                candidates = latents[: batch.valid.shape[0] * (batch.valid.shape[1] + 1)]
                told = self.model.config.latent_dim  # commands are known: they would tell the candidates apart, not φ
                dynamics, info = infonce_loss(predicted[..., :told], truth, candidates[:, :told], valid, config.temperature)
            else:
                dynamics, info = rollout_mse_loss(predicted, latents[truth], valid, torch.ones((), device=latents.device))
            values, more = self.value_loss(latents, batch)
            loss = config.c1 * dynamics + values
            if self.decoder is not None:
                reconstruction, pixels = self.decoder.loss(seen, stacks, self.generator)
                loss, more = loss + config.reconstruction * reconstruction, {**more, "reconstruction/loss": pixels["loss"]}
            loss.backward()
        encoded.backward(seen.grad)
        with self._threads(batch):
            return {"dynamics/loss": info["loss"], **more, **self._step(latents.detach(), batch, policies)}

    def latent_step(self) -> Info:
        """One update on cached latents: the dynamics by rollout error, the other heads as before."""
        return self._run_in_turn("latent", self._update_on_latents)

    def _update_on_latents(self, policies: bool) -> Info:
        assert self.cache is not None, "begin_latent_phase comes first"
        config = self.config
        share = config.latent_rewarded_share
        batch = self.sampler.sample(LATENT_BATCH, config.latent_horizon, False, self.generator, rewarded_share=share)
        latents = self.cache[batch.rows]
        self.model_optimizer.zero_grad(set_to_none=True)
        with self._threads(batch):
            predicted, truth, valid = rollouts(self.model, latents, batch, config.latent_horizon)
            dynamics, info = rollout_mse_loss(predicted, latents[truth], valid, self.step_square)
            values, more = self.value_loss(latents, batch)
            (dynamics + values).backward()
            return {"dynamics/loss": info["loss"], **more, **self._step(latents, batch, policies)}

    def value_step(self) -> Info:
        """One update of critics, policies and g alone, on cached latents (ours)."""
        return self._run_in_turn("values", self._update_values)

    def _update_values(self, policies: bool) -> Info:
        assert self.cache is not None, "begin_latent_phase comes first"
        config = self.config
        batch = self.sampler.sample(VALUE_BATCH, config.dynamics_horizon, False, self.generator,
                                    rewarded_share=config.latent_rewarded_share)
        latents = self.cache[batch.rows]
        self.model_optimizer.zero_grad(set_to_none=True)
        with self._threads(batch):
            loss, info = self.value_loss(latents, batch)
            loss.backward()
            return {**info, **self._step(latents, batch, policies)}

    def member_step(self, held: bool = False) -> Info:
        """One update of the members, or of those of the held policy, on cached latents (ours)."""
        members, cache = self.held if held else self.members, self.cache
        assert members is not None and cache is not None, "there are no members, or begin_latent_phase is still to come"
        if held:  # without TD3's delay
            return self._run(members.name, lambda: members.update(cache, True, self.generator))
        return self._run_in_turn(members.name, lambda policies: members.update(cache, policies, self.generator))

    def distil_step(self, held: bool = False) -> Info:
        """One update of π^g and Q^g, or of the held policy, towards their members, on cached latents (ours)."""
        members, cache = self.held if held else self.members, self.cache
        assert members is not None and cache is not None, "there are no members, or begin_latent_phase is still to come"
        return self._run(f"{members.name} distil", lambda: members.distil(self.model, cache, self.generator))

    def clone_step(self, done: int, steps: int) -> Info:
        """Update `done` of the `steps` that clone policies from successes, on cached latents (ours)."""
        cloning, cache = self.cloning, self.cache
        assert cloning is not None and cache is not None, "clone_steps is 0, or begin_latent_phase is still to come"
        if cloning.begin(done, steps, self.generator):
            self._captured.pop("clone", None)
        self.set_learning_rate(self.config.latent_learning_rate * cosine(cloning.progress(done, steps)))
        info = self._run("clone", lambda: cloning.update(cache, self.generator))
        return {**info, **cloning.finish(self.model, cache, done, steps, self.generator)}

    def frozen_step(self, phase: str, done: int, steps: int) -> Info:
        """Update `done` of the `steps` of a phase that works on a frozen encoder, by its name in `TrainConfig.phases`."""
        if phase == "clone":
            return self.clone_step(done, steps)
        self.set_learning_rate(self.config.latent_learning_rate * cosine(done / steps))
        steps_of: dict[str, Callable[[], Info]] = {
            "latent": self.latent_step, "values": self.value_step,
            "members": self.member_step, "distil": self.distil_step,
            "held": partial(self.member_step, held=True), "held_distil": partial(self.distil_step, held=True),
        }
        return steps_of[phase]()

    def _run_in_turn(self, name: str, update: Callable[[bool], Info]) -> Info:
        """`update(policies)`, where the policies learn in every `policy_every`-th update."""
        self.updates += 1
        policies = self.updates % self.config.policy_every == 0
        return self._run(f"{name}/{policies}", partial(update, policies))

    def _run(self, name: str, update: Callable[[], Info]) -> Info:
        """`update()`; with `graphs` as one that is captured once for each name."""
        if not self.graphs:
            return update()
        if name not in self._captured:
            self._captured[name] = Captured(update, self.generator)
        return self._captured[name]()

    def _threads(self, batch: Batch) -> AbstractContextManager[None]:
        """One thread for the heads while a batch is small."""
        return one_thread(batch.start.device, len(batch.start) <= TRANSITIONS_A_THREAD)

    def start_heads_afresh(self) -> None:
        """New weights for all but the encoder, targets included, before the latent phase (`heads_afresh`)."""
        drawn = torch.randint(2**31, (1,), generator=self.generator, device=self.generator.device)
        self.model.start_heads_afresh(int(drawn))
        self.local_target.load_state_dict(self.model.local_critics.state_dict())
        self.global_target.load_state_dict(self.model.global_critic.state_dict())

    def begin_latent_phase(self) -> None:
        """Freeze the encoder, cache every latent of the dataset [F, D], start fresh optimisers."""
        self.model.encoder.requires_grad_(False).eval()
        self.cache = encode_all(self.model, self.sampler)
        rows = self.sampler.transitions
        self.step_square = (self.cache[rows + 1] - self.cache[rows]).square().sum(-1).mean()
        self._optimise(self.config.latent_learning_rate, encoder=False)

    def set_learning_rate(self, learning_rate: float) -> None:
        """For the schedule of a phase."""
        for optimizer in self.optimizers.values():
            set_rate(optimizer, learning_rate)

    def _step(self, latents: Tensor, batch: Batch, policies: bool) -> Info:
        """Apply the gradients, let the targets follow, and update the policies when it is their turn. latents [M, D]."""
        self.model_optimizer.step()
        target, source, target_buffers, source_buffers = self._target_pairs
        polyak(target, source, self.config.target_rate)
        for old, new in zip(target_buffers, source_buffers, strict=True):
            old.copy_(new)
        return self._update_policies(latents, batch) if policies else {}

    def value_loss(self, latents: Tensor, batch: Batch) -> tuple[Tensor, Info]:
        """1/n Σ L_Q^l + c0 · L_Q^g of Eq. 2, with the targets of Eq. 3 and 4 from the target critics."""
        model, config, weight = self.model, self.config, batch.weight
        now, goal = latents[batch.start], latents[batch.goals.position]
        with torch.no_grad(), evaluated(model.local_policy, model.global_policy):
            then, there = latents[batch.start + 1], goal.detach()
            action = model.act_local(then, there)
            next_local = model.bound(self.local_target(torch.cat([then, there, action], -1))).amin(0)
            local_goal = td_target(batch.goals.reward, batch.goals.proceeds, next_local, config.discount)
            next_global = model.bound(self.global_target(torch.cat([then, model.act_global(then)], -1))).amin(0)
            global_goal = td_target(batch.reward, batch.proceeds, next_global, config.discount)
        local, local_info = critic_error(config.critic_loss)(model.local_q(now, goal, batch.action), local_goal, weight)
        error = critic_error(config.critic_loss, config.critic_floor)
        task, task_info = error(model.global_qs(now, batch.action), global_goal, weight)
        info = {
            "local/loss": local_info["loss"],
            "local/q": local_info["q"],
            "global/loss": task_info["loss"],
            "global/q": task_info["q"],
        }
        return local + config.c0 * task, info

    def acting_loss(self, latents: Tensor, batch: Batch) -> tuple[Tensor, Info]:
        """Eq. 5 for both policies, and the β-VAE of g. Only their own parameters are to take its gradient."""
        model, config, weight = self.model, self.config, batch.weight
        now, goal = latents[batch.start], latents[batch.goals.position]
        local_action, global_action = model.act_local(now, goal), model.act_global(now)
        with evaluated(model.local_critics, model.global_critic):
            local_q = model.local_q(now, goal, local_action).amin(0)
            global_q = model.global_q(now, global_action)
        relative = config.policy_relative
        local, local_info = policy_loss(local_q, local_action, batch.action, config.c2, weight, relative=relative)
        task, task_info = policy_loss(global_q, global_action, batch.action, config.c3, weight, relative=relative)
        mean, log_variance = model.action_model.posterior(now, batch.action)
        noise = torch.randn(mean.shape, generator=self.generator, device=mean.device)
        decoded = model.propose(now, reparameterise(mean, log_variance, noise))
        proposals, g_info = action_model_loss(decoded, batch.action, mean, log_variance, config.kl_weight, weight)
        info = {
            "local/policy": local_info["loss"],
            "local/imitation": local_info["imitation"],
            "global/policy": task_info["loss"],
            "global/imitation": task_info["imitation"],
            "g/reconstruction": g_info["reconstruction"],
            "g/kl": g_info["kl"],
        }
        return local + task + proposals, info

    def _update_policies(self, latents: Tensor, batch: Batch) -> Info:
        self.policy_optimizer.zero_grad(set_to_none=True)
        loss, info = self.acting_loss(latents, batch)
        loss.backward(inputs=self.policy_parameters)
        self.policy_optimizer.step()
        return info
