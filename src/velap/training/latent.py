"""Learning on frozen latents (ours): dynamics and values together, then values alone.

Every latent of the dataset is at hand, so that a batch costs its heads only, and h is trained by its mean-squared error over
long rollouts: Eq. 9 shapes a representation, and there is none to shape.
"""

from __future__ import annotations

from velap.config import LatentPhase, ValuePhase
from velap.config.training import DYNAMICS_HORIZON
from velap.data.sampling import FirstTransitions
from velap.losses import Info, model_loss, rollout_mse_loss
from velap.training.joint import rollouts
from velap.training.phase import FROZEN_RATE, Frozen, PhaseLearner, Run, few_threads
from velap.training.steps import cosine

LATENT_BATCH = 256
"""Windows a batch of the latent phase. ours."""
VALUE_BATCH = 512
"""Transitions a batch of the value phase. ours."""


class LatentLearner(PhaseLearner[LatentPhase]):
    """h by its rollout error, critics by Eq. 3 and 4, policies by Eq. 5, and g."""

    def __init__(self, phase: LatentPhase, run: Run, frozen: Frozen) -> None:
        super().__init__(phase, run)
        self.frozen, self.optimizers = frozen, frozen.optimizers

    def update(self, done: int) -> Info:
        """One update of h and the critics, then one of the policies and g."""
        self.set_rate(FROZEN_RATE * cosine(done / self.phase.steps))
        return self.in_turn(self._update)

    def _update(self, policies: bool) -> Info:
        run, horizon = self.run, self.phase.horizon
        batch = run.sampler.sample(FirstTransitions(LATENT_BATCH, horizon), run.generator, self.phase.rewarded_share)
        latents = self.frozen.latents[batch.rows]
        self.optimizers["model"].zero_grad(set_to_none=True)
        with few_threads(batch):
            predicted, truth, valid = rollouts(run.model, latents, batch, horizon)
            dynamics, info = rollout_mse_loss(predicted, latents[truth], valid, self.frozen.step_square)
            local, task, more = run.actor_critic.critic_losses(latents, batch)
            model_loss(local, task, dynamics, run.config.c0, 1.0).backward()
            self.optimizers["model"].step()
            run.actor_critic.follow()
            info = {"dynamics/loss": info["loss"], **more}
            if policies:
                info |= run.actor_critic.improve_policies(self.optimizers["policy"], latents, batch, run.generator)
        return info


class ValueLearner(PhaseLearner[ValuePhase]):
    """Critics by Eq. 3 and 4, policies by Eq. 5, and g."""

    def __init__(self, phase: ValuePhase, run: Run, frozen: Frozen) -> None:
        super().__init__(phase, run)
        self.frozen, self.optimizers = frozen, frozen.optimizers

    def update(self, done: int) -> Info:
        """One update of the critics, then one of the policies and g."""
        self.set_rate(FROZEN_RATE * cosine(done / self.phase.steps))
        return self.in_turn(self._update)

    def _update(self, policies: bool) -> Info:
        run = self.run
        draw = FirstTransitions(VALUE_BATCH, DYNAMICS_HORIZON)
        batch = run.sampler.sample(draw, run.generator, self.phase.rewarded_share)
        latents = self.frozen.latents[batch.rows]
        self.optimizers["model"].zero_grad(set_to_none=True)
        with few_threads(batch):
            local, task, info = run.actor_critic.critic_losses(latents, batch)
            (local + run.config.c0 * task).backward()
            self.optimizers["model"].step()
            run.actor_critic.follow()
            if policies:
                info |= run.actor_critic.improve_policies(self.optimizers["policy"], latents, batch, run.generator)
        return info
