"""Conditional variational autoencoders (Table 4). `*` is any batch prefix, D the latent, A the action, m the noise
dimension."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from velap.config import Norm
from velap.models.networks import MLP

GENERATIVE = (128, 128, 128)
"""Hidden layers of both halves of the action cVAE, Table 4."""
NOISE_DIM = 16
"""m, latent dimension of the action cVAE, Table 4."""


class ConditionalVAE(nn.Module):
    """β-VAE over targets given a condition: `[*, condition], [*, target]`; the action model g of Eq. 1 uses it."""

    def __init__(
        self, condition: int, target: int, noise_dim: int, hidden: Sequence[int], norm: Norm, *, bounded: bool
    ) -> None:
        super().__init__()
        self.noise_dim = noise_dim
        self.bounded = bounded
        self.encoder = MLP(condition + target, hidden, 2 * noise_dim, norm)
        self.decoder = MLP(condition + noise_dim, hidden, target, norm)

    def posterior(self, condition: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log-variance `[*, m]` of q(noise | condition, target)."""
        mean, log_variance = self.encoder(torch.cat([condition, target], -1)).chunk(2, -1)
        return mean, log_variance.clamp(-10, 4)

    def decode(self, condition: Tensor, noise: Tensor) -> Tensor:
        """Target `[*, target]` from noise `[*, m]`; in [-1, 1] when bounded."""
        out = self.decoder(torch.cat([condition, noise], -1))
        return torch.tanh(out) if self.bounded else out
