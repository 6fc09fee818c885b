"""kernels.c against the modules whose weights it copies."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch

from velap.models.inference import joined
from velap.models.networks import MLP, EnsembleMLP
from velap.native import kernels as native
from velap.native.folded import dense_layers, fold

needs_compiler = pytest.mark.skipif(native.library() is None, reason="no C compiler here")
SIZES = [(1, (5,), 1), (7, (128, 128), 32), (3, (40, 33, 64), 2)]


def refuse(*parts: torch.Tensor) -> torch.Tensor:
    raise AssertionError("kernels.c should have run")


def stirred(network: torch.nn.Module) -> torch.nn.Module:
    """Away from initialisation: gains of both signs, running statistics that are not 0 and 1."""
    generator = torch.Generator().manual_seed(3)
    for tensor in [*network.parameters(), *network.buffers()]:
        if tensor.is_floating_point():
            tensor.data.add_(torch.randn(tensor.shape, generator=generator).mul_(0.3).abs_() + 0.01)
    for parameter in list(network.parameters())[2:4]:
        parameter.data.mul_(torch.where(torch.rand(parameter.shape, generator=generator) < 0.2, -1.0, 1.0))
    return network.eval()


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize(("inputs", "hidden", "outputs"), SIZES)
@pytest.mark.parametrize("rows", [1, 8, 9, 61])
def test_a_network_equals_its_module(norm, inputs, hidden, outputs, rows):
    network = stirred(MLP(inputs, hidden, outputs, norm))
    x = torch.randn(rows, inputs)
    found = native.native_network(fold(dense_layers(network)), refuse)(x)
    torch.testing.assert_close(found, network(x), rtol=2e-5, atol=2e-5)


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_inputs_lie_side_by_side_and_members_come_first(norm):
    network = stirred(EnsembleMLP(3, 9, (48, 31), norm))
    z, goal, action = torch.randn(4, 5, 4), torch.randn(5, 4, 3).transpose(0, 1), torch.randn(4, 5, 2)
    run = native.native_network(fold(dense_layers(network)), refuse)
    expected = network(torch.cat([z, goal, action], -1))
    assert run(z, goal, action).shape == (3, 4, 5, 1)
    torch.testing.assert_close(run(z, goal, action).squeeze(-1), expected, rtol=2e-5, atol=2e-5)
    torch.testing.assert_close(joined(network)(z, goal, action), expected, rtol=2e-5, atol=2e-5)


@needs_compiler
@torch.no_grad()
def test_a_row_does_not_depend_on_the_rows_beside_it():
    network = stirred(MLP(12, (64, 64), 5, "layer"))
    run, x = native.native_network(fold(dense_layers(network)), refuse), torch.randn(37, 12)
    alone = torch.cat([run(row[None]) for row in x])
    assert torch.equal(run(x), alone)
    assert torch.equal(run(x[5:30]), alone[5:30])


@needs_compiler
@torch.no_grad()
@pytest.mark.parametrize(("draws", "residual"), [(1, True), (6, True), (3, False)])
def test_a_rollout_is_its_steps(draws, residual):
    acting, moving = stirred(MLP(7, (40,), 2, "layer")), stirred(MLP(6, (33, 64), 4, "layer"))
    z, noise = torch.randn(21, 4), torch.randn(21, draws, 3)
    run = native.native_rollout(fold(dense_layers(acting)), fold(dense_layers(moving)), residual)
    expected = z
    for step in range(6):
        action = acting(torch.cat([expected, noise[:, min(step, draws - 1)]], -1)).tanh()
        expected = moving(torch.cat([expected, action], -1)) + residual * expected
    torch.testing.assert_close(run(z, noise, 6), expected, rtol=1e-4, atol=1e-4)
    assert torch.equal(run(z, noise, 6)[5:9], run(z[5:9], noise[5:9], 6))
    assert torch.equal(run(z, noise, 0), z)


@torch.no_grad()
def test_what_native_code_cannot_take_goes_to_torch():
    network = stirred(MLP(6, (16,), 3, "layer"))
    run = joined(network)
    many = torch.randn(native.MOST_ROWS + 1, 6)
    torch.testing.assert_close(run(many), network(many))
    wide = network.double()
    assert joined(wide)(many.double()).dtype == torch.float64
    assert native.native_network(fold(dense_layers(wide)), refuse) is refuse


@pytest.mark.parametrize(("setting", "warned"), [
    ("VELAP_NATIVE=0", None), ("PATH=/nowhere", "there is no C compiler here"),
    ("CC=/bin/false", "/bin/false could not build"),
    ("CC=no-such-compiler", "there is no C compiler here (no-such-compiler)"),
])
def test_without_native_code_the_same_comes_out_and_one_warning_says_so(setting, warned, tmp_path):
    code = """if True:
        import torch
        from velap.native import kernels as native
        from velap.models.inference import joined
        from velap.models.networks import MLP
        torch.manual_seed(0)
        network = MLP(6, (16, 16), 3, "layer").eval()
        x = torch.randn(5, 6)
        print(native.library() is None, bool(torch.allclose(joined(network)(x), network(x), atol=1e-6)))
    """
    done = subprocess.run(["/usr/bin/env", f"XDG_CACHE_HOME={tmp_path}", setting, sys.executable, "-c", code],
                          capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "True"]
    if warned is None:
        assert done.stderr == ""
    else:
        assert done.stderr.count("UserWarning") == 1
        assert warned in done.stderr and "apt-get install gcc" in done.stderr and "VELAP_NATIVE=0" in done.stderr


@needs_compiler
def test_the_library_is_built_once_and_kept(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native.library.cache_clear()
    try:
        assert native.library() is not None
        (built,) = (tmp_path / "velap").iterdir()
        before = built.stat().st_mtime_ns
        native.library.cache_clear()
        assert native.library() is not None
        assert [path.stat().st_mtime_ns for path in (tmp_path / "velap").iterdir()] == [before]
    finally:
        native.library.cache_clear()
