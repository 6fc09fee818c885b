"""Updates as CUDA graphs: what they do on other devices, and that a replay is the update itself."""

from __future__ import annotations

import pytest
import torch

from tiny_training import config, make, make_store, to_end
from velap.training.capture import adam, set_rate
from velap.training.loop import Trainer

needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")


def devices() -> list[object]:
    return ["cpu", pytest.param("cuda", marks=needs_cuda)]


@pytest.mark.parametrize("device", devices())
def test_a_new_rate_counts_at_the_next_step(device: str) -> None:
    weight = torch.nn.Parameter(torch.zeros(3, device=device))
    optimizer = adam([weight], 1.0)
    set_rate(optimizer, 0.125)
    weight.grad = torch.ones(3, device=device)
    optimizer.step()  # Adam's first step is as long as its rate
    torch.testing.assert_close(weight.detach().cpu(), torch.full((3,), -0.125))


def test_on_a_cpu_nothing_is_captured(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("velap.training.phase.Captured", None)
    to_end(make(tmp_path, config(clone={"steps": 2})))


@needs_cuda
def test_replays_learn_what_plain_updates_do(tmp_path) -> None:
    phases = {label: {"steps": 20} for label in ("encoder", "joint", "latent", "values", "clone")}

    def trained(name: str, graphs: bool) -> dict[str, torch.Tensor]:
        run = Trainer(config(policy_every=2, **phases), make_store(), tmp_path / name, 0, torch.device("cuda"))
        run.run.graphs = graphs
        while run.step < run.total:
            info = run.update()
            assert all(torch.isfinite(value).all() for value in info.values())
        return {name: value.cpu() for name, value in run.model.state_dict().items()}

    replayed, plain = trained("replayed", True), trained("plain", False)
    start = Trainer(config(**phases), make_store(), tmp_path / "start", 0, torch.device("cuda")).model.state_dict()
    for name in ("encoder.dense.0.weight", "dynamics.0.weight", "global_policy.0.weight", "success_policy.0.weight"):
        moved = (plain[name] - start[name].cpu()).norm()
        assert moved > 0
        assert (plain[name] - replayed[name]).norm() < 0.1 * moved, name
