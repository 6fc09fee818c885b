"""Networks for planning: the same weights without the module machinery, which costs more than the arithmetic on a few rows.

`*` is any batch prefix, n the members. The functions read the weights where they are: after a change of weights in place
they follow, after a load that replaces tensors they must be built anew.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from velap.models.networks import LEAK, MLP, EnsembleMLP
from velap.native.folded import dense_layers, fold, folded_ensemble, folded_mlp
from velap.native.kernels import native_network

Forward = Callable[[Tensor], Tensor]


def fast_mlp(mlp: MLP) -> Forward:
    """`[*, inputs] → [*, outputs]`, equal to `mlp` in eval mode, without gradients (and without tanh of a `Policy`)."""
    layers = list(mlp)
    if any(isinstance(layer, nn.BatchNorm1d) for layer in layers):
        return lambda x: MLP.forward(mlp, x)
    hidden: list[tuple[Tensor, Tensor, tuple[Tensor, Tensor] | None]] = []
    for layer, following in zip(layers, [*layers[1:], None], strict=True):
        if isinstance(layer, nn.Linear):
            norm = (following.weight, following.bias) if isinstance(following, nn.LayerNorm) else None
            hidden.append((layer.weight.t(), layer.bias, norm))
    last_weight, last_bias, _ = hidden.pop()

    def forward(x: Tensor) -> Tensor:
        prefix = x.shape[:-1]
        if x.dim() != 2:
            x = x.reshape(-1, x.shape[-1])
        for weight, bias, norm in hidden:
            x = torch.addmm(bias, x, weight)
            if norm is not None:
                x = torch.layer_norm(x, (x.shape[-1],), *norm)
            x = F.leaky_relu_(x, LEAK)
        x = torch.addmm(last_bias, x, last_weight)
        return x if len(prefix) == 1 else x.view(*prefix, x.shape[-1])

    return forward


def fast_ensemble(ensemble: EnsembleMLP) -> Forward:
    """`[*, inputs] → [n, *]`, equal to `ensemble` in eval mode, without gradients."""
    if ensemble.norm == "batch":
        return ensemble
    weights, biases = list(ensemble.weights), list(ensemble.biases)
    pairs = list(zip(ensemble.shifts, ensemble.scales, strict=True))
    norms: list[tuple[Tensor, Tensor] | None] = [*pairs] if pairs else [None] * (len(weights) - 1)
    hidden = list(zip(weights[:-1], biases[:-1], norms, strict=True))

    def forward(x: Tensor) -> Tensor:
        prefix = x.shape[:-1]
        x = x.reshape(1, -1, x.shape[-1]).expand(ensemble.n, -1, -1)
        for weight, bias, norm in hidden:
            x = torch.baddbmm(bias, x, weight)
            if norm is not None:
                x = torch.addcmul(norm[0], torch.layer_norm(x, (x.shape[-1],)), norm[1])
            x = F.leaky_relu_(x, LEAK)
        return torch.baddbmm(biases[-1], x, weights[-1]).view(ensemble.n, *prefix)

    return forward


def joined(network: MLP | EnsembleMLP, hidden: torch.dtype | None = None) -> Callable[..., Tensor]:
    """The network on inputs side by side, `[*, W_1], [*, W_2], ...`, by `kernels.c` where it pays. Copies the weights.

    Gives `[*, outputs]` of an MLP and `[n, *]` of an ensemble, equal in eval mode, without gradients (and without tanh).
    `hidden` runs the layers behind the first in that type, in PyTorch where it is not float32.
    """
    fast = _by_torch(network, hidden)

    def by_torch(*parts: Tensor) -> Tensor:
        out = fast(torch.cat(parts, -1) if len(parts) > 1 else parts[0])
        return out.unsqueeze(-1) if isinstance(network, EnsembleMLP) else out

    half = hidden not in (None, torch.float32)
    run = by_torch if half else native_network(fold(dense_layers(network)), by_torch)
    return (lambda *parts: run(*parts).squeeze(-1)) if isinstance(network, EnsembleMLP) else run


def _by_torch(network: MLP | EnsembleMLP, hidden: torch.dtype | None) -> Forward:
    """The network without kernels.c."""
    if isinstance(network, EnsembleMLP):
        return fast_ensemble(network) if hidden is None else folded_ensemble(network, hidden)
    return fast_mlp(network) if hidden is None else folded_mlp(network, hidden)


def nearest_row(bank: Tensor) -> Callable[[Tensor], Tensor]:
    """`[*, D] → [*]` index of the nearest row of the bank [P, D]; what does not depend on the query is computed once."""
    rows, half_squares = bank.t().contiguous(), -0.5 * bank.square().sum(-1)

    def forward(z: Tensor) -> Tensor:
        return torch.addmm(half_squares, z.reshape(-1, z.shape[-1]), rows).argmax(-1).view(z.shape[:-1])

    return forward
