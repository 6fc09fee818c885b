"""Networks for shooting: normalisation folded into the weights, hidden layers optionally in half precision.

`*` is any batch prefix, n the members. With thousands of rows a call the arithmetic is the cost, not the module machinery
that `inference.py` avoids. Layer normalisation is the slow part beside the products: its centring and its gain are linear,
so they move into the weights before and after, and one root mean square a row is left. Batch normalisation folds away.

The functions copy the weights: build them anew after a change of weights.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from velap.models.networks import LEAK, MLP, EnsembleMLP

Forward = Callable[..., Tensor]
SMALLEST_GAIN = 1e-6
"""Smallest gain: gains are divisors."""


class Dense(NamedTuple):
    """A dense layer and the normalisation behind it, if any; W inputs, V outputs."""

    weight: Tensor
    """[W, V], or [n, W, V]."""
    bias: Tensor
    """[V], or [n, 1, V]."""
    norm: nn.LayerNorm | nn.BatchNorm1d | tuple[Tensor, Tensor] | None
    """What follows: a layer normalisation (gain, shift), each shaped like the bias."""


class Folded(NamedTuple):
    """A dense layer, followed by division by the row's root mean square and `shift` if that is given."""

    weight: Tensor
    bias: Tensor
    shift: Tensor | None


def folded_mlp(mlp: MLP, dtype: torch.dtype) -> Forward:
    """Inputs side by side `[*, W_1], ... → [*, outputs]` in their dtype: `mlp` in eval mode, hidden layers in `dtype`.

    Without the tanh of a `Policy`.
    """
    layers = fold(dense_layers(mlp))
    last = Folded(*(None if part is None else part.to(dtype) for part in layers[-1]))  # type: ignore[arg-type]
    hidden = _hidden(layers[:-1], dtype, torch.addmm)

    def forward(*parts: Tensor) -> Tensor:
        x = torch.cat(parts, -1) if len(parts) > 1 else parts[0]
        out = torch.addmm(last.bias, hidden(x.reshape(-1, x.shape[-1])), last.weight)
        return out.to(x.dtype).view(*x.shape[:-1], out.shape[-1])

    return forward


def folded_ensemble(ensemble: EnsembleMLP, dtype: torch.dtype) -> Forward:
    """Inputs side by side `[*, W_1], ... → [n, *]` in their dtype: `ensemble` in eval mode, hidden layers in `dtype`."""
    layers = fold(dense_layers(ensemble))
    hidden, last = _hidden(layers[:-1], dtype, torch.baddbmm), layers[-1]

    def forward(*parts: Tensor) -> Tensor:
        x = torch.cat(parts, -1) if len(parts) > 1 else parts[0]
        rows = x.reshape(1, -1, x.shape[-1]).expand(ensemble.n, -1, -1)
        # Values are compared across trajectories: their last product keeps the input's precision.
        return torch.baddbmm(last.bias, hidden(rows).to(x.dtype), last.weight).view(ensemble.n, *x.shape[:-1])

    return forward


def dense_layers(network: MLP | EnsembleMLP) -> list[Dense]:
    """The layers of a network; weights [n, W, V] in an ensemble."""
    if isinstance(network, EnsembleMLP):
        return [Dense(weight.data, bias.data, norm) for weight, bias, norm in
                zip(network.weights, network.biases, [*_member_norms(network), None], strict=True)]
    modules, dense = list(network), []
    for layer, following in zip(modules, [*modules[1:], None], strict=True):
        if isinstance(layer, nn.Linear):
            norm = following if isinstance(following, (nn.LayerNorm, nn.BatchNorm1d)) else None
            dense.append(Dense(layer.weight.t(), layer.bias, norm))
    return dense


def _member_norms(ensemble: EnsembleMLP) -> list[nn.BatchNorm1d | tuple[Tensor, Tensor] | None]:
    """The normalisation behind each hidden layer of an ensemble."""
    if ensemble.norm == "layer":
        return [(gain.data, shift.data) for gain, shift in zip(ensemble.scales, ensemble.shifts, strict=True)]
    if ensemble.norm == "batch":
        return list(ensemble.norms)  # type: ignore[arg-type]
    return [None] * (len(ensemble.weights) - 1)


@torch.no_grad()
def fold(dense: Sequence[Dense]) -> list[Folded]:
    """The same function with normalisation in the weights.

    LeakyReLU(g v) = g LeakyReLU(v) for g > 0: the gain g of a layer normalisation moves behind the activation into the next
    weights, its sign into the weights before.
    """
    folded: list[Folded] = []
    carried: Tensor | None = None
    for weight, bias, norm in dense:
        if carried is not None:
            weight = weight * carried.reshape(*weight.shape[:-1], 1)
        shift = carried = None
        if isinstance(norm, nn.BatchNorm1d):
            weight, bias = _fold_batch_norm(weight, bias, norm)
        elif norm is not None:
            gain, offset = norm if isinstance(norm, tuple) else (norm.weight, norm.bias)
            sign = torch.where(gain < 0, -1.0, 1.0).to(gain)
            weight = (weight - weight.mean(-1, keepdim=True)) * sign
            bias = (bias - bias.mean(-1, keepdim=True)) * sign
            carried = gain.abs().clamp(min=SMALLEST_GAIN)
            shift = offset / carried
        folded.append(Folded(weight.contiguous(), bias.contiguous(), shift))
    return folded


def _fold_batch_norm(weight: Tensor, bias: Tensor, norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Weight and bias with the running statistics in them."""
    assert norm.running_mean is not None
    assert norm.running_var is not None
    scale = (norm.weight / (norm.running_var + norm.eps).sqrt()).view_as(bias)
    return weight * scale, (bias - norm.running_mean.view_as(bias)) * scale + norm.bias.view_as(bias)


EPS = 1e-5
"""PyTorch's, in every layer normalisation of the package."""


def _hidden(layers: Sequence[Folded], dtype: torch.dtype, affine: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Forward:
    """All layers but the last: `[..., W] → [..., V]` in `dtype`; the first one keeps the precision of its input.

    Latents are many one-step distances long: rounding them first would move them by a good part of a step.
    """
    if not layers:
        return lambda x: x.to(dtype)
    first, rest = layers[0], [Folded(*(None if part is None else part.to(dtype) for part in layer))  # type: ignore[arg-type]
                              for layer in layers[1:]]

    def forward(x: Tensor) -> Tensor:
        x = _activate(affine(first.bias, x, first.weight), first.shift).to(dtype)
        for weight, bias, shift in rest:
            x = _activate(affine(bias, x, weight), shift)
        return x

    return forward


def _activate(y: Tensor, shift: Tensor | None) -> Tensor:
    """Normalisation, if `shift` is given, and LeakyReLU of `y` [..., V]."""
    if shift is not None:
        norm = torch.linalg.vector_norm(y, dim=-1, keepdim=True)
        width = y.shape[-1]
        y = torch.addcmul(shift, y, norm.square().add_(width * EPS).rsqrt_().mul_(width**0.5))
    return F.leaky_relu_(y, LEAK)
