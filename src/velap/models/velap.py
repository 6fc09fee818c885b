"""The Eq. 1 bundle. `*` is any batch prefix, N frames a state, D latent, A action, m noise, n ensemble, P bank size."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import ModelConfig
from velap.config.planning import NEIGHBOUR_DISTANCE, Precision
from velap.errors import VelapError
from velap.models.action_model import GENERATIVE, NOISE_DIM, ConditionalVAE
from velap.models.encoders.base import encoder_class, latent_width
from velap.models.inference import joined, nearest_row
from velap.models.networks import CRITIC, DYNAMICS, MLP, POLICY, EnsembleMLP, Policy
from velap.native.folded import dense_layers, fold
from velap.native.kernels import native_rollout

UNREWARDED = -4.0
"""Initial logit of bounded critics: sparse returns start near 0; from a half they would take thousands of updates to
decay."""

N_ENS = 3
"""Members of the local ensemble, Table 7."""
COMMAND_MEMORY = 0.7
"""Share that the leaky mean of past commands keeps at a step. ours."""
COMMAND_SCALE = 2.0
"""What the mean of past commands in a latent is multiplied by [latent distance]. ours."""


@dataclass(frozen=True)
class Spaces:
    """What the data look like: frame size [px] and action bounds."""

    height: int
    width: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]


class LatentModel(nn.Module):
    """φ, h, g, π^l, Q^l × n, π^g, Q^g of Eq. 1; on demand a policy cloned from successes and one of held actions (ours).

    Actions are in [-1, 1] inside; `to_env` and `to_unit` convert.
    """

    def __init__(self, config: ModelConfig, spaces: Spaces, discount: float, *, clones: bool = False,
                 holds: bool = False) -> None:
        super().__init__()
        self.config, self.spaces, self.discount = config, spaces, discount
        action, norm = len(spaces.action_low), config.norm
        latent = latent_width(config, action)
        self.encoder = encoder_class(config)(config, (spaces.height, spaces.width))
        self.dynamics = MLP(latent + action, DYNAMICS, latent, norm)
        self.action_model = ConditionalVAE(latent, action, NOISE_DIM, GENERATIVE, norm, bounded=True)
        self.local_policy = Policy(2 * latent, POLICY, action, norm)
        self.global_policy = Policy(latent, POLICY, action, norm)
        self.local_critics = EnsembleMLP(N_ENS, 2 * latent + action, CRITIC, norm)
        self.global_critic = EnsembleMLP(config.n_global, latent + action, CRITIC, norm)
        self.success_policy = Policy(latent, POLICY, action, norm) if clones else None
        self.held_policy = Policy(latent, POLICY, action, norm) if holds else None
        if config.critic_bounded:
            for critic in (self.local_critics, self.global_critic):
                nn.init.constant_(critic.biases[-1], UNREWARDED)
        if config.command_dims > 0:
            self.register_buffer("command_weight", torch.tensor(COMMAND_SCALE))
        self.register_buffer("action_low", torch.tensor(spaces.action_low))
        self.register_buffer("action_high", torch.tensor(spaces.action_high))
        self.register_buffer("step_distance", torch.tensor(0.0))
        # Half precision is a thousandth of a one-step distance and keeps a released checkpoint below 3 MB.
        self.register_buffer("bank_latents", torch.zeros(config.bank_size, latent, dtype=torch.float16))
        self.register_buffer("bank_rows", torch.full((config.bank_size,), -1, dtype=torch.int32))
        self.command_weight: Tensor
        """float32 [], `COMMAND_SCALE`."""
        self.action_low: Tensor
        self.action_high: Tensor
        self.step_distance: Tensor
        """float32 [], upper 5-percentile of one-step distances in the data [latent distance]."""
        self.bank_latents: Tensor
        self.bank_rows: Tensor

    def encode(self, frames: Tensor, commands: Tensor | None = None) -> Tensor:
        """φ, and behind it the remembered commands (`command_dims`): uint8 `[*, N, H, W, 3] → [*, D]`.

        commands `[*, A]`: leaky mean of the past actions in [-1, 1], `velap.data.commands`; None stands for zeros, as at the
        start of an episode.
        """
        return self.with_commands(self.encoder(frames), commands)

    def with_commands(self, seen: Tensor, commands: Tensor | None = None) -> Tensor:
        """Output of φ `[*, d_Z]` and commands `[*, A]` → latents `[*, D]`."""
        if self.config.command_dims == 0:
            return seen
        if commands is None:
            commands = seen.new_zeros(*seen.shape[:-1], self.action_dim)
        return torch.cat([seen, self.command_weight * commands[..., : self.config.command_dims]], -1)

    def step(self, latent: Tensor, action: Tensor) -> Tensor:
        """h: `[*, D], [*, A] → [*, D]`."""
        change = self.dynamics(torch.cat([latent, action], -1))
        return latent + change if self.config.dynamics_residual else change

    def propose(self, latent: Tensor, noise: Tensor) -> Tensor:
        """g: `[*, D], [*, m] → [*, A]` in [-1, 1]."""
        return self.action_model.decode(latent, noise)

    def act_local(self, latent: Tensor, goal: Tensor) -> Tensor:
        """π^l: `[*, D], [*, D] → [*, A]` in [-1, 1]."""
        return self.local_policy(torch.cat([latent, goal], -1))

    def act_global(self, latent: Tensor) -> Tensor:
        """π^g: `[*, D] → [*, A]` in [-1, 1]."""
        return self.global_policy(latent)

    def local_q(self, latent: Tensor, goal: Tensor, action: Tensor) -> Tensor:
        """Q^l of every member: `[*, D], [*, D], [*, A] → [n, *]` [Q-value]."""
        return self.bound(self.local_critics(torch.cat([latent, goal, action], -1)))

    def global_qs(self, latent: Tensor, action: Tensor) -> Tensor:
        """Q^g of every member: `[*, D], [*, A] → [members, *]` [Q-value]."""
        return self.bound(self.global_critic(torch.cat([latent, action], -1)))

    def global_q(self, latent: Tensor, action: Tensor) -> Tensor:
        """Q^g, the minimum over its members: `[*, D], [*, A] → [*]` [Q-value]."""
        return self.global_qs(latent, action).amin(0)

    def reach(self, start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
        """Q_min and Q_std of §4 under π^l: `[*, D], [*, D] → [*], [*]` [Q-value]; population deviation over the members."""
        q = self.local_q(start, goal, self.act_local(start, goal))
        return q.amin(0), q.std(0, correction=0)

    def value(self, latent: Tensor) -> Tensor:
        """Q^g(z, π^g(z)): `[*, D] → [*]` [Q-value]."""
        return self.global_q(latent, self.act_global(latent))

    def project(self, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Nearest latent of the dataset bank and its distance: `[*, D] → [*, D], [*]`."""
        found = self.bank_latents[self.nearest_bank(latent)].float()
        return found, (found - latent).norm(dim=-1)

    def nearest_bank(self, latent: Tensor) -> Tensor:
        """Index of the nearest bank latent: `[*, D] → [*]`."""
        return nearest_row(self.bank_latents.float())(latent)

    def bound(self, raw: Tensor) -> Tensor:
        """Critic output as a Q-value: a sigmoid when the config bounds it to [0, 1]."""
        return torch.sigmoid(raw) if self.config.critic_bounded else raw

    @torch.no_grad()
    def start_heads_afresh(self, seed: int) -> None:
        """New weights for everything but φ; the parameters stay in their memory."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            new = LatentModel(self.config, self.spaces, self.discount, clones=self.success_policy is not None,
                              holds=self.held_policy is not None)
        new.encoder.load_state_dict(self.encoder.state_dict())
        self.load_state_dict(new.state_dict())

    @property
    def action_dim(self) -> int:
        """A."""
        return len(self.spaces.action_low)

    @property
    def seen_dim(self) -> int:
        """Dimensions of the latent that φ gives; commands stand behind them."""
        return self.encoder.width(self.config)

    @property
    def memory(self) -> float:
        """Share that the leaky mean of past commands keeps at a step; 0 where the latent holds none."""
        return COMMAND_MEMORY if self.config.command_dims else 0.0

    def to_env(self, action: Tensor) -> np.ndarray:
        """Actions `[*, A]` in [-1, 1] to float32 in the environment's bounds."""
        scaled = self.action_low + (action.clamp(-1, 1) + 1) / 2 * (self.action_high - self.action_low)
        return scaled.cpu().numpy().astype(np.float32)

    def to_unit(self, action: Tensor) -> Tensor:
        """Environment actions `[*, A]` to [-1, 1]."""
        return ((action - self.action_low) / (self.action_high - self.action_low) * 2 - 1).clamp(-1, 1)

    def search_fns(self, hidden: Precision | None = None) -> dict[str, Any]:
        """The callables that the search needs (fields of `velap.search.types.SearchFns`), equal to the methods above but
        without the module machinery; refuses a model in train mode. Build them anew after loading weights.

        `hidden` folds normalisation into the weights of h, π^g and Q^g and runs their hidden layers in that precision:
        faster on thousands of rows (shooting), slower on a few (trees).
        """
        if self.training:
            raise VelapError("the model is in train mode; expected eval mode for planning. Call model.eval() first.")
        step_distance = float(self.step_distance)
        return {
            **self._fast_functions(hidden),
            "project": self._fast_project() if self.config.bank_size else None,
            "rollout": self._fast_rollout(),
            "noise_dim": NOISE_DIM,
            "discount": self.discount,
            "d_neigh": NEIGHBOUR_DISTANCE * step_distance,
            "step_distance": step_distance,
        }

    def _fast_functions(self, hidden: Precision | None) -> dict[str, Callable[..., Any] | None]:
        """h, g, π^g, Q^l and Q^g as the search calls them."""
        decoder, local_policy = joined(self.action_model.decoder), joined(self.local_policy)
        local_critics = joined(self.local_critics)
        dtype = None if hidden is None else getattr(torch, hidden)
        dynamics, global_policy = joined(self.dynamics, dtype), joined(self.global_policy, dtype)
        global_critic = joined(self.global_critic, dtype)
        residual, bound = self.config.dynamics_residual, self.bound
        cloned = None if self.success_policy is None else joined(self.success_policy)

        def step(latent: Tensor, action: Tensor) -> Tensor:
            change = dynamics(latent, action)
            return change.add_(latent) if residual else change

        def act_global(latent: Tensor) -> Tensor:
            return global_policy(latent).tanh_()

        def act_local(start: Tensor, goal: Tensor) -> Tensor:
            return local_policy(start, goal).tanh_()

        def reach(start: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
            q = bound(local_critics(start, goal, act_local(start, goal)))
            return q.amin(0), q.std(0, correction=0)

        def global_q(latent: Tensor, action: Tensor) -> Tensor:
            return bound(global_critic(latent, action)).amin(0)

        return {
            "propose": lambda latent, noise: decoder(latent, noise).tanh_(),
            "act_global": act_global,
            "act_success": None if cloned is None else lambda latent: cloned(latent).tanh_(),
            "step": step,
            "reach": reach,
            "q": global_q,
            "value": lambda latent: global_q(latent, act_global(latent)),
        }

    def _fast_rollout(self) -> Callable[[Tensor, Tensor | None, int], Tensor] | None:
        """Simulations by `kernels.c`, `SearchFns.rollout`; None where it cannot take them."""
        moving, residual = fold(dense_layers(self.dynamics)), self.config.dynamics_residual
        by_noise = native_rollout(fold(dense_layers(self.action_model.decoder)), moving, residual)
        by_policy = native_rollout(fold(dense_layers(self.global_policy)), moving, residual)
        if by_noise is None or by_policy is None:
            return None

        def rollout(latent: Tensor, noise: Tensor | None, steps: int) -> Tensor:
            return by_noise(latent, noise, steps) if noise is not None else by_policy(
                latent, latent.new_empty(len(latent), 1, 0), steps)

        return rollout

    def _fast_project(self) -> Callable[[Tensor], tuple[Tensor, Tensor]]:
        """`project` with the bank's norms computed once."""
        bank = self.bank_latents.float()
        nearest = nearest_row(bank)

        def project(latent: Tensor) -> tuple[Tensor, Tensor]:
            found = bank[nearest(latent)]
            return found, (found - latent).norm(dim=-1)

        return project


