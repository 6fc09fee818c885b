"""Networks of App. B.1 (Tables 3, 5, 6). `*` is any batch prefix, D the latent and A the action dimension, n the
members."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from velap.config import Norm

DYNAMICS = (128, 128, 128, 128)
"""Hidden layers of h, Table 3."""
POLICY = (128, 128, 128)
"""Hidden layers of a policy, Table 5."""
CRITIC = (128, 128, 128)
"""Hidden layers of a critic, Table 6."""
LEAK = 0.01
"""Negative slope of the activations (PyTorch's default; the tables say LeakyReLU only)."""


def _norm_layer(norm: Norm, width: int) -> nn.Module:
    return nn.BatchNorm1d(width) if norm == "batch" else nn.LayerNorm(width)


class MLP(nn.Sequential):
    """Dense layers with LeakyReLU; `[*, inputs] → [*, outputs]`, linear at the end."""

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, norm: Norm) -> None:
        layers: list[nn.Module] = []
        for width in hidden:
            layers += [nn.Linear(inputs, width), _norm_layer(norm, width), nn.LeakyReLU(LEAK, inplace=True)]
            inputs = width
        super().__init__(*layers, nn.Linear(inputs, outputs))
        self._flat = norm == "batch"

    def forward(self, x: Tensor) -> Tensor:
        if self._flat and x.dim() != 2:
            out = super().forward(x.reshape(-1, x.shape[-1]))
            return out.reshape(*x.shape[:-1], out.shape[-1])
        return super().forward(x)


class EnsembleMLP(nn.Module):
    """n independent MLPs evaluated as one batched product; `[*, inputs] → [n, *]`, one scalar a member, or by `each`."""

    def __init__(self, n: int, inputs: int, hidden: Sequence[int], norm: Norm, outputs: int = 1) -> None:
        super().__init__()
        self.n = n
        self.norm = norm
        sizes = [inputs, *hidden, outputs]
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        self.scales = nn.ParameterList()
        self.shifts = nn.ParameterList()
        self.norms = nn.ModuleList()
        for fan_in, fan_out in pairwise(sizes):
            bound = fan_in**-0.5
            self.weights.append(nn.Parameter(torch.empty(n, fan_in, fan_out).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(n, 1, fan_out).uniform_(-bound, bound)))
        for width in hidden:
            if norm == "layer":
                self.scales.append(nn.Parameter(torch.ones(n, 1, width)))
                self.shifts.append(nn.Parameter(torch.zeros(n, 1, width)))
            else:
                self.norms.append(nn.BatchNorm1d(n * width))

    def forward(self, x: Tensor) -> Tensor:
        prefix = x.shape[:-1]
        return self.each(x.reshape(1, -1, x.shape[-1]).expand(self.n, -1, -1)).reshape(self.n, *prefix)

    def each(self, h: Tensor) -> Tensor:
        """Every member on inputs of its own: [n, M, inputs] → [n, M, outputs]."""
        for i in range(len(self.weights) - 1):
            h = self._normalise(i, torch.baddbmm(self.biases[i], h, self.weights[i]))
            h = F.leaky_relu(h, LEAK, inplace=True)
        if self.weights[-1].shape[-1] > 1:
            return torch.baddbmm(self.biases[-1], h, self.weights[-1])
        # A matrix product with one column is slow: 116 against 27 µs forward, 198 against 35 µs backward.
        return (h * self.weights[-1].transpose(1, 2)).sum(-1, keepdim=True) + self.biases[-1]

    def _normalise(self, i: int, h: Tensor) -> Tensor:
        if self.norm == "layer":
            return torch.addcmul(self.shifts[i], F.layer_norm(h, h.shape[-1:]), self.scales[i])
        n, m, width = h.shape
        return self.norms[i](h.permute(1, 0, 2).reshape(m, n * width)).reshape(m, n, width).permute(1, 0, 2)


class Policy(MLP):
    """π, Table 5, tanh at the end: `[*, inputs] → [*, A]` in [-1, 1]."""

    def forward(self, x: Tensor) -> Tensor:
        return torch.tanh(super().forward(x))
