"""BC equals a step by hand and learns a known answer; BC(D*) sees successful episodes only."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from latent_data import SMALL, corridor, joint_checkpoint, noise_store
from velap.errors import DatasetError
from velap.methods.bc import PAPER_BC, BCConfig, BCLearner, SuccessBCLearner, cloning_error
from velap.methods.heads import PolicyHead
from velap.models.checkpoint import load_checkpoint
from velap.runs import make_generator
from velap.training.frozen import LatentData, latent_data


def linear_head(weight: list[list[float]], bias: list[float]) -> PolicyHead:
    """π(z) = tanh(W z + b)."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("velap.methods.heads.POLICY", ())
        head = PolicyHead(SMALL, len(bias))
    with torch.no_grad():
        head.policy[0].weight.copy_(torch.tensor(weight))
        head.policy[0].bias.copy_(torch.tensor(bias))
    return head


def test_the_loss_and_its_gradient_are_those_by_hand() -> None:
    data = corridor()
    head = linear_head([[0.5, -1.0]], [0.25])
    learner = BCLearner(head, data, BCConfig(batch=3), make_generator(0))
    rows = torch.tensor([0, 5, 9])
    loss, info = learner.loss(rows)
    loss.backward()
    z, a = data.latents[rows].numpy(), data.actions[rows].numpy()[:, 0]
    out = np.tanh(z @ np.array([0.5, -1.0]) + 0.25)
    assert loss.item() == pytest.approx(((out - a) ** 2).mean(), rel=1e-5)
    assert info["loss"].item() == loss.item()
    slope = 2 / 3 * (out - a) * (1 - out**2)
    np.testing.assert_allclose(head.policy[0].weight.grad.numpy()[0], slope @ z, rtol=1e-4)
    np.testing.assert_allclose(head.policy[0].bias.grad.numpy(), [slope.sum()], rtol=1e-4)


def test_an_update_is_an_adam_step() -> None:
    head = linear_head([[0.5, -1.0]], [0.25])
    learner = BCLearner(head, corridor(), BCConfig(batch=4, learning_rate=1e-3, cosine=False), make_generator(0))
    rows = learner.draw()
    learner.draw = lambda: rows  # type: ignore[method-assign]
    loss, _ = learner.loss(rows)
    (gradient,) = torch.autograd.grad(loss, head.policy[0].weight)
    before = head.policy[0].weight.detach().clone()
    learner.update()
    torch.testing.assert_close(head.policy[0].weight.detach(), before - 1e-3 * gradient / (gradient.abs() + 1e-8))


def test_the_error_is_averaged_over_action_entries() -> None:
    error = cloning_error(torch.tensor([[1.0, 0.0], [0.0, 0.0]]), torch.tensor([[0.0, 0.0], [0.5, -1.0]]))
    torch.testing.assert_close(error, torch.tensor([0.5, 0.625]))


def test_the_learning_rate_falls_along_a_cosine_only_when_asked() -> None:
    for cosine, expected in ((True, [1.0, 0.505, 0.01]), (False, [1.0, 1.0, 1.0])):
        learner = BCLearner(linear_head([[0.0, 0.0]], [0.0]), corridor(), BCConfig(cosine=cosine), make_generator(0))
        rates = []
        for done in (0.0, 0.5, 1.0):
            learner.schedule(done)
            rates.append(learner.optimizers["head"].param_groups[0]["lr"] / 1e-3)
        assert rates == pytest.approx(expected)


def turning_data() -> LatentData:
    """The data of the corridor with actions that are a known function of the state."""
    data = corridor()
    return dataclasses.replace(data, actions=torch.sin(6 * data.latents[:, :1]) * 0.8)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_bc_learns_a_known_policy(norm: str) -> None:
    data = turning_data()
    torch.manual_seed(0)
    head = PolicyHead(dataclasses.replace(SMALL, norm=norm), 1).train()
    learner = BCLearner(head, data, BCConfig(steps=250, batch=64, learning_rate=5e-3, passes=0), make_generator(0))
    before = learner.report()["held_out/loss"]
    for _ in range(250):
        learner.update()
    after = learner.report()["held_out/loss"]
    assert before > 0.1
    assert after < 0.01
    assert head.training, "the report leaves the head in train mode"


def loaded(tmp_path: Path, successes: int) -> LatentData:
    store = noise_store(episodes=40, successes=successes)
    model, config, metadata = load_checkpoint(joint_checkpoint(tmp_path / "model.safetensors", store))
    return latent_data(model, config, metadata, store, tmp_path)


def episodes_of(data: LatentData, rows: Tensor) -> set[int]:
    return set(data.last[rows].tolist())


def test_success_bc_draws_from_successful_episodes_only(tmp_path: Path) -> None:
    data = loaded(tmp_path, successes=12)
    learner = SuccessBCLearner(PolicyHead(SMALL, 3), data, BCConfig(batch=500), make_generator(0))
    successful = {6 + 7 * episode for episode in range(12)}
    kept = episodes_of(data, learner.held_out)
    assert len(kept) == 1, "a tenth of them is held out"
    assert episodes_of(data, learner.draw()) == successful - kept
    assert len(learner.pool) == 11 * 6, "every transition, not the rewarded one alone"
    plain = BCLearner(PolicyHead(SMALL, 3), data, BCConfig(batch=5000), make_generator(0))
    drawn = episodes_of(data, plain.draw())
    assert successful < drawn
    assert len(drawn) == 36, "four unrewarded episodes are held out, as in the joint training"
    assert not drawn & episodes_of(data, plain.held_out)


def test_success_bc_without_any_success_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"test/noise-v0 has no successful episode.*`--method bc`"):
        SuccessBCLearner(PolicyHead(SMALL, 3), loaded(tmp_path, successes=0), BCConfig(), make_generator(0))


def test_few_transitions_are_passed_over_a_hundred_times_at_most() -> None:
    data = corridor()
    n = len(data.training)
    head = PolicyHead(SMALL, 1)

    def total(**changes: int) -> int:
        return BCLearner(head, data, BCConfig(**{"steps": 10_000, "batch": 16, **changes}), make_generator(0)).total

    assert total() == -(-100 * n // 16) < 10_000
    assert total(passes=0) == 10_000
    assert total(steps=60) == 60
    assert total(passes=1, batch=256) == 50


def test_the_paper_preset_is_appendix_d1() -> None:
    assert dataclasses.asdict(PAPER_BC) == {"steps": 300_000, "batch": 128, "learning_rate": 3e-4, "cosine": False,
                                             "passes": 0}
