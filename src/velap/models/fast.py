"""How a model fills `SearchFns`: its networks without the module machinery, by `kernels.c` where it pays.

`*` is any batch prefix, D latent.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from velap.config.planning import NEIGHBOUR_DISTANCE, SNAP_GAP, Precision
from velap.errors import VelapError
from velap.models.functions import SearchFns
from velap.models.inference import joined, nearest_row
from velap.models.velap import NOISE_DIM, LatentModel
from velap.native.folded import dense_layers, fold
from velap.native.kernels import native_rollout


def search_fns(model: LatentModel, hidden: Precision | None = None) -> SearchFns:
    """The callables that the search needs, equal to the methods of the model. Build them anew after loading weights.

    `hidden` runs the hidden layers of h, π^g and Q^g in that precision: faster on thousands of rows (shooting), slower on a
    few (trees). Raises VelapError for a model in train mode.
    """
    if model.training:
        raise VelapError("the model is in train mode; expected eval mode for planning. Call model.eval() first.")
    decoder, local_policy = joined(model.action_model.decoder), joined(model.local_policy)
    local_critics = joined(model.local_critics)
    dtype = None if hidden is None else getattr(torch, hidden)
    dynamics, global_policy = joined(model.dynamics, dtype), joined(model.global_policy, dtype)
    global_critic = joined(model.global_critic, dtype)
    residual, bound = model.config.dynamics_residual, model.bound
    cloned = None if model.success_policy is None else joined(model.success_policy)
    step_distance = float(model.step_distance)

    def step(latent: Tensor, action: Tensor) -> Tensor:
        change = dynamics(latent, action)
        return change.add_(latent) if residual else change

    def act_global(latent: Tensor) -> Tensor:
        return global_policy(latent).tanh_()

    def reach(start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        q = bound(local_critics(start, goal, local_policy(start, goal).tanh_()))
        return q.amin(0), q.std(0, correction=0)

    def global_q(latent: Tensor, action: Tensor) -> Tensor:
        return bound(global_critic(latent, action)).amin(0)

    return SearchFns(
        propose=lambda latent, noise: decoder(latent, noise).tanh_(),
        act_global=act_global,
        step=step,
        reach=reach,
        value=lambda latent: global_q(latent, act_global(latent)),
        q=global_q,
        noise_dim=NOISE_DIM,
        discount=model.discount,
        d_neigh=NEIGHBOUR_DISTANCE * step_distance,
        step_distance=step_distance,
        project=_project(model) if model.config.bank_size else None,
        success_share=float(model.success_share),
        arrival_rates=(float(model.arrival_rates[0]), float(model.arrival_rates[1])),
        snaps=float(model.bank_gap) < SNAP_GAP,
        act_success=None if cloned is None else lambda latent: cloned(latent).tanh_(),
        rollout=_rollout(model),
    )


def _rollout(model: LatentModel) -> Callable[[Tensor, Tensor | None, int], Tensor] | None:
    """Simulations by `kernels.c`; None where it cannot take them."""
    moving, residual = fold(dense_layers(model.dynamics)), model.config.dynamics_residual
    by_noise = native_rollout(fold(dense_layers(model.action_model.decoder)), moving, residual)
    by_policy = native_rollout(fold(dense_layers(model.global_policy)), moving, residual)
    if by_noise is None or by_policy is None:
        return None

    def rollout(latent: Tensor, noise: Tensor | None, steps: int) -> Tensor:
        if noise is not None:
            return by_noise(latent, noise, steps)
        return by_policy(latent, latent.new_empty(len(latent), 1, 0), steps)

    return rollout


def _project(model: LatentModel) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
    """`LatentModel.project` with the bank's norms computed once."""
    bank = model.bank_latents.float()
    nearest = nearest_row(bank)

    def project(latent: Tensor) -> tuple[Tensor, Tensor]:
        found = bank[nearest(latent)]
        return found, (found - latent).norm(dim=-1)

    return project
