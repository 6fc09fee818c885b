"""Joint training of the Eq. 1 bundle: Sec. 4 with App. B.4 and B.5.

Each update optimises L_model (Eq. 2) over encoder, dynamics and critics and then, with the latents held fixed, the policies
(Eq. 5). The action model g learns beside the policies, on fixed latents too: Eq. 2 has no term for it.

Letters: M rows of a batch, W rollouts, k rollout steps, D latent dimension.
"""

from __future__ import annotations

import torch
from torch import Tensor

from velap.config import JointPhase
from velap.config.training import DYNAMICS_HORIZON
from velap.data.sampling import Batch, FirstTransitions, WholeWindows
from velap.losses import Info, infonce_loss, model_loss, rollout_mse_loss
from velap.models.velap import LatentModel
from velap.training.capture import adam
from velap.training.encoder import FrameDecoder
from velap.training.encoding import known_at
from velap.training.phase import PhaseLearner, Run, few_threads

LEARNING_RATE = 3e-4
"""Adam, Table 7."""
TRANSITIONS_A_WINDOW = 4
"""Transitions that train the values, and starts of rollouts, a window at most. ours: beyond a hundred or so a batch, more
frames teach more than more transitions of the same frames."""
RECONSTRUCTION = 0.05
"""Weight of the reconstruction loss beside Eq. 2. ours."""


def rollouts(model: LatentModel, latents: Tensor, batch: Batch, k: int) -> tuple[Tensor, Tensor, Tensor]:
    """k-step predictions of h along the data's actions from `batch.unroll_at`: predicted [k, W, D], positions int64 [k, W]
    of the truth, valid [k, W]. latents [M, D].
    """
    width = batch.valid.shape[1] + 1
    window, step = batch.unroll_at // width, batch.unroll_at % width
    latent = latents[batch.unroll_at]
    predicted, truth, valid = [], [], []
    for i in range(k):
        latent = model.step(latent, batch.actions[window, step + i])
        predicted.append(latent)
        truth.append(batch.unroll_at + i + 1)
        valid.append(batch.valid[window, step + i])
    return torch.stack(predicted), torch.stack(truth), torch.stack(valid)


class JointLearner(PhaseLearner[JointPhase]):
    """The paper's training."""

    def __init__(self, phase: JointPhase, run: Run) -> None:
        super().__init__(phase, run)
        model, side, windows = run.model, phase.reconstruction_side, phase.windows
        self.draw: WholeWindows | FirstTransitions = FirstTransitions(windows, DYNAMICS_HORIZON)
        if phase.window > 1:
            most = TRANSITIONS_A_WINDOW * windows
            self.draw = WholeWindows(windows, phase.window, most, most, DYNAMICS_HORIZON)
        self.decoder = FrameDecoder(model.seen_dim, side, run.sampler, run.weight_seed) if side > 0 else None
        learnt = [model.encoder, *([self.decoder] if self.decoder is not None else []), model.dynamics, model.local_critics,
                  model.global_critic]
        self.modules = {} if self.decoder is None else {"decoder": self.decoder}
        self.optimizers = {
            "model": adam([p for part in learnt for p in part.parameters()], LEARNING_RATE),
            "policy": adam(run.actor_critic.policy_parameters, LEARNING_RATE),
        }

    def update(self, done: int) -> Info:
        """One update of Eq. 2, then one of Eq. 5 and of g."""
        return self.in_turn(self._update)

    def _update(self, policies: bool) -> Info:
        run, model, phase = self.run, self.run.model, self.phase
        batch = run.sampler.sample(self.draw, run.generator, phase.rewarded_share)
        self.optimizers["model"].zero_grad(set_to_none=True)

        # φ. The heads' gradient is gathered in `seen` and goes to the encoder in one piece.
        encoded = model.encoder.encode(run.features[run.sampler.stack_rows(batch.rows)])
        seen = encoded.detach().requires_grad_()
        latents = model.with_known(seen, *known_at(model, run.sampler, batch.rows))
        with few_threads(batch):
            dynamics, info = self.dynamics_loss(latents, batch)  # L_h, Eq. 9
            local, task, more = run.actor_critic.critic_losses(latents, batch)  # Eq. 3 and 4
            loss = model_loss(local, task, dynamics, run.config.c0, phase.c1)  # Eq. 2
            info = {"dynamics/loss": info["loss"], **more}
            if self.decoder is not None:
                frames = run.sampler.frames[batch.rows]
                reconstruction, pixels = self.decoder.loss(seen, frames, run.generator)
                loss = loss + RECONSTRUCTION * reconstruction
                info["reconstruction/loss"] = pixels["loss"]
            loss.backward()
        if encoded.requires_grad:
            encoded.backward(seen.grad)
        with few_threads(batch):
            self.optimizers["model"].step()
            run.actor_critic.follow()
            if policies:  # Eq. 5
                info |= run.actor_critic.improve_policies(self.optimizers["policy"], latents.detach(), batch, run.generator)
        return info

    def dynamics_loss(self, latents: Tensor, batch: Batch) -> tuple[Tensor, Info]:
        """L_h of Eq. 2: the contrastive loss of Eq. 9, or the mean-squared error of App. E.3. latents [M, D]."""
        predicted, truth, valid = rollouts(self.run.model, latents, batch, DYNAMICS_HORIZON)
        if self.phase.dynamics_loss == "mse":
            return rollout_mse_loss(predicted, latents[truth], valid, torch.ones((), device=latents.device))
        candidates = latents[: batch.valid.shape[0] * (batch.valid.shape[1] + 1)]
        known = self.run.model.seen_dim  # what is known beside the frames would tell the candidates apart in place of φ
        return infonce_loss(predicted[..., :known], truth, candidates[:, :known], valid)
