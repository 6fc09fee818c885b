"""Updates as CUDA graphs: what they do on other devices, and that a replay is the update itself."""

from __future__ import annotations

import pytest
import torch

from test_joint import CLONED, config, make_store
from velap.training.capture import adam, set_rate
from velap.training.joint import JointLearner
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


def test_on_a_cpu_nothing_is_captured(tmp_path) -> None:
    run = Trainer(config(CLONED), make_store(), tmp_path, 0, torch.device("cpu"))
    while run.step < run.total:
        run.update()
    assert run.learner._captured == {}


@needs_cuda
def test_replays_learn_what_plain_updates_do(tmp_path, monkeypatch) -> None:
    def trained(name: str) -> dict[str, torch.Tensor]:
        settings = config(CLONED, encoder_steps=20, joint_steps=20, latent_steps=20, latent_value_steps=20, clone_steps=20,
                          policy_every=2, precision="float32")
        run = Trainer(settings, make_store(), tmp_path / name, 0, torch.device("cuda"))
        while run.step < run.total:
            info = run.update()
            assert all(torch.isfinite(value).all() for value in info.values())
        return {name: value.cpu() for name, value in run.model.state_dict().items()}

    replayed = trained("replayed")
    monkeypatch.setattr(JointLearner, "_run", lambda self, name, update, capture=True: update())
    plain = trained("plain")
    start = Trainer(config(CLONED), make_store(), tmp_path / "start", 0, torch.device("cuda")).model.state_dict()
    for name in ("encoder.dense.0.weight", "dynamics.0.weight", "global_policy.0.weight", "success_policy.0.weight"):
        moved = (plain[name] - start[name].cpu()).norm()
        assert moved > 0
        assert (plain[name] - replayed[name]).norm() < 0.1 * moved, name
