"""The Eq. 1 bundle. `*` is any batch prefix, N frames a state, D latent, A action, m noise, n ensemble, P bank size."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import Config, ModelConfig
from velap.config.planning import Precision
from velap.models.action_model import GENERATIVE, NOISE_DIM, ConditionalVAE
from velap.models.encoders.base import encoder_class, latent_width
from velap.models.functions import SearchFns
from velap.models.inference import nearest_row
from velap.models.networks import CRITIC, DYNAMICS, MLP, POLICY, EnsembleMLP, Policy

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
    """What the data look like: frame size [px], action bounds, and the state beside the frames."""

    height: int
    width: int
    action_low: tuple[float, ...]
    action_high: tuple[float, ...]
    state_mean: tuple[float, ...] = ()
    """[S]; empty where there is no state."""
    state_scale: tuple[float, ...] = ()
    """[S] one by the deviation, 0 for entries that never vary."""

    @property
    def state_dim(self) -> int:
        """S, entries of the state beside the frames; 0 without one."""
        return len(self.state_mean)


class Origin(NamedTuple):
    """Where a pretrained model comes from."""

    config: Config
    """Of the whole training."""
    metadata: Mapping[str, str]
    """Of its checkpoint: seed, dataset, command, hashes."""


class LatentModel(nn.Module):
    """φ, h, g, π^l, Q^l × n, π^g, Q^g of Eq. 1; on demand a policy cloned from successes (ours).

    Actions are in [-1, 1] inside; `to_env` and `to_unit` convert.
    """

    def __init__(self, config: ModelConfig, spaces: Spaces, discount: float, *, clones: bool = False) -> None:
        super().__init__()
        self.config, self.spaces, self.discount = config, spaces, discount
        self.origin: Origin | None = None
        """Set by `from_pretrained`."""
        action, norm = len(spaces.action_low), config.norm
        latent = latent_width(config, action, spaces.state_dim)
        self.encoder = encoder_class(config)(config, (spaces.height, spaces.width))
        self.dynamics = MLP(latent + action, DYNAMICS, latent, norm)
        self.action_model = ConditionalVAE(latent, action, NOISE_DIM, GENERATIVE, norm, bounded=True)
        self.local_policy = Policy(2 * latent, POLICY, action, norm)
        self.global_policy = Policy(latent, POLICY, action, norm)
        self.local_critics = EnsembleMLP(N_ENS, 2 * latent + action, CRITIC, norm)
        self.global_critic = EnsembleMLP(config.n_global, latent + action, CRITIC, norm)
        self.success_policy = Policy(latent, POLICY, action, norm) if clones else None
        if config.critic_bounded:
            for critic in (self.local_critics, self.global_critic):
                nn.init.constant_(critic.biases[-1], UNREWARDED)
        if config.command_dims > 0:
            self.register_buffer("command_weight", torch.tensor(COMMAND_SCALE))
        if spaces.state_dim > 0:
            self.register_buffer("state_mean", torch.tensor(spaces.state_mean))
            self.register_buffer("state_scale", torch.tensor(spaces.state_scale))
        self.register_buffer("action_low", torch.tensor(spaces.action_low))
        self.register_buffer("action_high", torch.tensor(spaces.action_high))
        self.register_buffer("step_distance", torch.tensor(0.0))
        self.register_buffer("bank_gap", torch.tensor(torch.inf))
        self.register_buffer("success_share", torch.tensor(1.0))
        self.register_buffer("arrival_rates", torch.zeros(2))
        # Half precision is a thousandth of a one-step distance and keeps a released checkpoint below 3 MB.
        self.register_buffer("bank_latents", torch.zeros(config.bank_size, latent, dtype=torch.float16))
        self.register_buffer("bank_rows", torch.full((config.bank_size,), -1, dtype=torch.int32))
        self.command_weight: Tensor
        """float32 [], `COMMAND_SCALE`."""
        self.state_mean: Tensor
        self.state_scale: Tensor
        self.action_low: Tensor
        self.action_high: Tensor
        self.step_distance: Tensor
        """float32 [], upper 5-percentile of one-step distances in the data [latent distance]."""
        self.bank_gap: Tensor
        """float32 [], how far most held-out latents are from the bank [`step_distance`]."""
        self.success_share: Tensor
        """float32 [], share of the data's episodes that succeed."""
        self.arrival_rates: Tensor
        """float32 [2], share of the states far from the goal from where π^g and the cloned policy get there by h; zeros
        where there is no clone."""
        self.bank_latents: Tensor
        self.bank_rows: Tensor

    def encode(self, frames: Tensor, commands: Tensor | None = None, state: Tensor | None = None) -> Tensor:
        """φ, and behind it what is known beside the frames: uint8 `[*, N, H, W, 3] → [*, D]`."""
        return self.with_known(self.encoder(frames), commands, state)

    def with_known(self, seen: Tensor, commands: Tensor | None = None, state: Tensor | None = None) -> Tensor:
        """Output of φ `[*, d_Z]`, and behind it the remembered commands (`command_dims`) and the standardised state (of data
        that have one) → latents `[*, D]`.

        Args:
            seen: output of φ.
            commands: `[*, A]` leaky mean of the past actions in [-1, 1], `velap.data.commands`; None stands for zeros, as at
                the start of an episode.
            state: `[*, S]` as the data hold it; None stands for its mean.
        """
        known = []
        if self.config.command_dims > 0:
            if commands is None:
                commands = seen.new_zeros(*seen.shape[:-1], self.action_dim)
            known.append(self.command_weight * commands[..., : self.config.command_dims])
        if self.spaces.state_dim > 0:
            held = self.state_mean if state is None else state
            known.append(((held - self.state_mean) * self.state_scale).expand(*seen.shape[:-1], -1))
        return torch.cat([seen, *known], -1) if known else seen

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
            new = LatentModel(self.config, self.spaces, self.discount, clones=self.success_policy is not None)
        new.encoder.load_state_dict(self.encoder.state_dict())
        self.load_state_dict(new.state_dict())

    @property
    def action_dim(self) -> int:
        """A."""
        return len(self.spaces.action_low)

    @property
    def seen_dim(self) -> int:
        """Dimensions of the latent that φ gives; what is known stands behind them."""
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

    def search_fns(self, hidden: Precision | None = None) -> SearchFns:
        """What the search calls: equal to the methods above, without the module machinery. See `velap.models.fast`."""
        from velap.models.fast import search_fns

        return search_fns(self, hidden)

    @classmethod
    def from_pretrained(cls, place: Path | str, device: torch.device | str = "cpu") -> LatentModel:
        """The model of a checkpoint in eval mode: a file, a folder with `model.safetensors`, or the id of a repository on
        the Hugging Face hub (`user/name`; needs the package huggingface-hub). `origin` keeps its config and provenance."""
        from velap.models.checkpoint import load_checkpoint

        model, config, metadata = load_checkpoint(place, device)
        model.origin = Origin(config, metadata)
        return model

    def save_pretrained(self, folder: Path | str, config: Config | None = None) -> Path:
        """Write `model.safetensors` and `config.json`, which `from_pretrained` reads; returns the former's path.

        `config`: of the whole training; None takes that of `origin`, and raises ConfigError where there is none.
        """
        from velap.models.checkpoint import save_folder

        return save_folder(self, Path(folder), config)
