"""Losses, one function an equation, in the paper's order; each returns `(loss, info)`.

Letters: T transitions, n ensemble members, k rollout steps, W rollouts, C candidates, D latent, A action dimension, m noise
dimension, M frames. `weight` [T] is 1 for real transitions and 0 for padding.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from velap.config.training import CriticLoss
from velap.models.horizon import Q_FLOOR

Info = dict[str, Tensor]
KL_WEIGHT = 0.01
"""β of the action cVAE, Table 4."""
TEMPERATURE = 1.0
"""T of the similarity in Eq. 9, Table 7."""


def weighted_mean(value: Tensor, weight: Tensor) -> Tensor:
    """Mean of `value` [*, T] over real transitions; leading dimensions are averaged."""
    total = (value * weight).flatten(0, -2).sum(-1).mean() if value.dim() > 1 else (value * weight).sum()
    return total / weight.sum().clamp(min=1)


def model_loss(local: Tensor, task: Tensor, dynamics: Tensor, c0: float, c1: float) -> Tensor:
    """L_model = 1/n_ens Σ_k L_Q^l_k + c0 · L_Q^g + c1 · L_h, Eq. 2; `local` is the mean over the members already."""
    return c1 * dynamics + (local + c0 * task)


def local_critic_loss(
    q: Tensor, reward: Tensor, proceeds: Tensor, next_q: Tensor, weight: Tensor, *, discount: float, kind: CriticLoss = "mse"
) -> tuple[Tensor, Info]:
    """L_Q^l = E_D'[(Q_k^l(z_t, z_*, a_t) - (r_t + γ Q_min^{t+1,*}))²], Eq. 3, mean over members k.

    q [n, T]; reward, proceeds, next_q [T] of the relabelled transitions; next_q is the targets' minimum [Q-value].
    """
    return critic_loss(q, td_target(reward, proceeds, next_q, discount), weight, kind=kind)


def global_critic_loss(
    q: Tensor, reward: Tensor, proceeds: Tensor, next_q: Tensor, weight: Tensor, *, discount: float,
    kind: CriticLoss = "mse", floor: float = 0.0
) -> tuple[Tensor, Info]:
    """L_Q^g = E_D[(Q^g(z_t, a_t) - (r_t + γ Q^g(z_{t+1}, π^g(z_{t+1}))))²], Eq. 4, mean over members.

    q [n, T]; reward, proceeds, next_q [T] of the task [Q-value]; `floor` is that of `cross_entropy_critic_loss`.
    """
    return critic_loss(q, td_target(reward, proceeds, next_q, discount), weight, kind=kind, floor=floor)


def td_target(reward: Tensor, proceeds: Tensor, next_q: Tensor, discount: float) -> Tensor:
    """r + γ · proceeds · Q(s', π(s')), Eq. 3 and 4; no gradient. All [T]; `proceeds` is 0 at terminals."""
    return (reward + discount * proceeds * next_q).detach()


def critic_loss(
    q: Tensor, target: Tensor, weight: Tensor, *, kind: CriticLoss = "mse", floor: float = 0.0
) -> tuple[Tensor, Info]:
    """Squared TD error of Eq. 3 and 4, or the cross entropy of bounded critics (ours). q [n, T] or [T], target [T]."""
    if kind == "cross_entropy":
        return cross_entropy_critic_loss(q, target, weight, floor)
    loss = weighted_mean((q - target).square(), weight)
    return loss, {"loss": loss.detach(), "q": weighted_mean(q.detach(), weight)}


def cross_entropy_critic_loss(q: Tensor, target: Tensor, weight: Tensor, floor: float = 0.0) -> tuple[Tensor, Info]:
    """Cross entropy of bounded critics, less the target's entropy (ours): errors of small values count too.

    q [n, T] or [T] and target [T], both in [0, 1] [Q-value]. The gradient of the squared error at the output before the
    sigmoid is (q - target) · q · (1 - q), which vanishes far from the goal; here it is q - target.

    The loss of a relative error still grows with the target: an error of one step counts twenty times more near the goal
    than 75 steps from it. With a `floor` above 0 each transition counts by 1 / (target + floor), relative to their mean;
    then steps count alike down to targets of about the floor.
    """
    target = target.expand_as(q)
    entropy = nn.functional.binary_cross_entropy(target, target, reduction="none")
    errors = nn.functional.binary_cross_entropy(q, target, reduction="none") - entropy
    if floor > 0:
        share = weight / (target + floor)
        errors = errors * share * (weight.sum() / share.sum(-1, keepdim=True).clamp(min=1e-9))
    loss = weighted_mean(errors, weight)
    return loss, {"loss": loss.detach(), "q": weighted_mean(q.detach(), weight)}


def policy_loss(
    q: Tensor, action: Tensor, data_action: Tensor, imitation: float, weight: Tensor, *, relative: bool = False
) -> tuple[Tensor, Info]:
    """L_π = E[-Q] + c · E[(π - a_t)²], Eq. 5. q [T], actions [T, A] in [-1, 1]; the square is averaged over A, as TD3-BC
    does.

    With `relative` (ours) Q counts relative to its own size, so that steps count alike far from the goal and near it.
    """
    cloning = weighted_mean(cloning_error(action, data_action), weight)
    loss = imitation * cloning - weighted_mean(q / q.detach().clamp(min=Q_FLOOR) if relative else q, weight)
    return loss, {"loss": loss.detach(), "imitation": cloning.detach()}


def cloning_error(action: Tensor, data_action: Tensor) -> Tensor:
    """Squared error [*] of actions [*, A], averaged over A as TD3-BC does."""
    return (action - data_action).square().mean(-1)


def infonce_loss(
    predicted: Tensor, positive: Tensor, candidates: Tensor, valid: Tensor, temperature: float = TEMPERATURE
) -> tuple[Tensor, Info]:
    """L_h = -1/k Σ_k E_D[log f(z̃, z⁺) / Σ_j f(z̃, z_j)], f = exp(-‖·‖/T), Eq. 9.

    predicted [k, W, D]; positive int64 [k, W], the row of `candidates` [C, D] that is the true latent; valid bool [k, W].
    The sum runs over all candidates, the positive one included.
    """
    logits = -latent_distances(predicted, candidates) / temperature
    log_share = logits.log_softmax(-1).gather(-1, positive.unsqueeze(-1)).squeeze(-1)
    counted = valid.float()
    a_step = -(log_share * counted).sum(1) / counted.sum(1).clamp(min=1)
    loss = a_step.mean()
    return loss, {"loss": loss.detach()}


def latent_distances(a: Tensor, b: Tensor) -> Tensor:
    """Euclidean distances `[*, W, D], [*, C, D] → [*, W, C]`, with a finite gradient at zero."""
    squares = a.square().sum(-1, keepdim=True) + b.square().sum(-1).unsqueeze(-2) - 2 * a @ b.transpose(-1, -2)
    return squares.clamp(min=1e-6).sqrt()


def rollout_mse_loss(predicted: Tensor, actual: Tensor, valid: Tensor, scale: Tensor) -> tuple[Tensor, Info]:
    """Mean-squared rollout error over real steps, App. E.3, in units of `scale`² (mean square one-step change; [] or 1).

    predicted, actual [k, W, D]; valid bool [k, W]. No gradient flows into `actual`.
    """
    squares = (predicted - actual.detach()).square().sum(-1) / scale
    counted = valid.float()
    loss = (squares * counted).sum() / counted.sum().clamp(min=1)
    return loss, {"loss": loss.detach()}


def action_model_loss(
    decoded: Tensor, action: Tensor, mean: Tensor, log_variance: Tensor, kl_weight: float, weight: Tensor
) -> tuple[Tensor, Info]:
    """‖a - â‖² + β · KL(q(noise | z, a) ‖ N(0, 1)), β-VAE of Table 4. decoded, action [T, A]; mean, log_variance [T, m]."""
    reconstruction = weighted_mean((decoded - action).square().sum(-1), weight)
    divergence = weighted_mean(0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1), weight)
    loss = reconstruction + kl_weight * divergence
    return loss, {"loss": loss.detach(), "reconstruction": reconstruction.detach(), "kl": divergence.detach()}


def reparameterise(mean: Tensor, log_variance: Tensor, noise: Tensor) -> Tensor:
    """Posterior sample [T, m] from standard noise [T, m]."""
    return mean + (0.5 * log_variance).exp() * noise


@torch.no_grad()
def polyak(targets: Sequence[Tensor], sources: Sequence[Tensor], rate: float) -> None:
    """targets ← (1 - rate) · targets + rate · sources, in place."""
    torch._foreach_lerp_(list(targets), list(sources), rate)


def displacement_loss(predicted: Tensor, actions: Tensor) -> tuple[Tensor, Info]:
    """Smooth L1 error of the summed actions between two states [P, A], ours after multi-step inverse models (AC-State).

    A sum says where the agent went, the first action alone little; where it was held up the sum is wrong by a lot, hence no
    square.
    """
    loss = torch.nn.functional.smooth_l1_loss(predicted, actions)
    return loss, {"error": (predicted - actions).detach().abs().mean()}


def reconstruction_loss(decoded: Tensor, frames: Tensor, mean: Tensor, deviation: Tensor) -> tuple[Tensor, Info]:
    """Mean-squared error of the decoded frames in deviations of the data, ours: 1 is what the mean frame would have.

    decoded [M, C]; frames [M, C] shrunk frames in [0, 1]; mean [C]; deviation [], root mean square over frames and places.
    """
    loss = (decoded - (frames - mean) / deviation).square().mean()
    return loss, {"loss": loss.detach()}
