"""Folded networks: the same function as the modules, whatever the normalisation; half precision stays close."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from velap.config import Norm
from velap.models.networks import MLP, EnsembleMLP
from velap.native.folded import folded_ensemble, folded_mlp

NORMS: tuple[Norm, ...] = ("batch", "layer")


def unlike_the_start(network: nn.Module) -> nn.Module:
    """Gains of both signs, one of them 0, shifts and running statistics as after training; eval mode."""
    torch.manual_seed(0)
    for name, parameter in network.named_parameters():
        if parameter.dim() == 1 or "scales" in name or "shifts" in name:
            parameter.data.normal_(0.3, 1.0)
    for name, parameter in network.named_parameters():
        if "scales" in name or (name.endswith("weight") and parameter.dim() == 1):
            parameter.data.flatten()[3] = 0.0
    for name, buffer in network.named_buffers():
        if "running" in name:
            buffer.uniform_(0.2, 2.0)
    return network.double().eval().requires_grad_(False)


@pytest.mark.parametrize("norm", NORMS)
def test_an_mlp_folds_to_the_same_function(norm: Norm) -> None:
    torch.manual_seed(1)
    mlp = unlike_the_start(MLP(5, (16, 12, 16), 3, norm))
    assert isinstance(mlp, MLP)
    x = torch.randn(4, 7, 5, dtype=torch.float64)
    torch.testing.assert_close(folded_mlp(mlp, torch.float64)(x), mlp(x), rtol=1e-4, atol=1e-5)
    half = folded_mlp(mlp.float(), torch.bfloat16)(x.float())
    assert half.dtype == torch.float32
    assert (half - mlp(x.float())).norm() < 0.03 * mlp(x.float()).norm()


@pytest.mark.parametrize("norm", NORMS)
@pytest.mark.parametrize("members", [1, 3])
def test_an_ensemble_folds_to_the_same_function(norm: Norm, members: int) -> None:
    torch.manual_seed(1)
    ensemble = unlike_the_start(EnsembleMLP(members, 5, (16, 12, 16), norm))
    assert isinstance(ensemble, EnsembleMLP)
    x = torch.randn(4, 7, 5, dtype=torch.float64)
    torch.testing.assert_close(folded_ensemble(ensemble, torch.float64)(x), ensemble(x), rtol=1e-4, atol=1e-5)
    half = folded_ensemble(ensemble.float(), torch.bfloat16)(x.float())
    assert half.shape == (members, 4, 7)
    assert (half - ensemble(x.float())).norm() < 0.03 * ensemble(x.float()).norm()
