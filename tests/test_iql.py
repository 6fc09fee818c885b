"""IQL equals a step by hand, and finds the expectile values and the policy of a corridor whose answer is exact."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from latent_data import SMALL, corridor
from velap.errors import ConfigError
from velap.methods.iql import (
    PAPER_IQL,
    PAPER_SPARSE_IQL,
    SPARSE_IQL,
    IQLConfig,
    IQLHead,
    IQLLearner,
    advantage_weights,
    expectile_loss,
)
from velap.runs import make_generator
from velap.training.frozen import LatentData


@pytest.fixture(autouse=True)
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks that learn little data in few updates."""
    for name, value in {"velap.methods.iql.CRITIC": (32, 32), "velap.methods.heads.POLICY": (32, 32)}.items():
        monkeypatch.setattr(name, value)

ROWS = torch.tensor([0, 1, 2, 3])


def test_expectile_loss_by_hand() -> None:
    value, target = torch.tensor([0.0, 1.0]), torch.tensor([2.0, 0.5])
    assert expectile_loss(value, target, 0.7).item() == pytest.approx((0.7 * 4 + 0.3 * 0.25) / 2)
    assert expectile_loss(value, target, 0.5).item() == pytest.approx((4 + 0.25) / 4)


def test_advantage_weights_by_hand_and_their_clip() -> None:
    value = torch.tensor([0.0, 0.5, 0.0, 0.0], requires_grad=True)
    q = torch.tensor([0.2, 0.2, 5.0, -5.0])
    weights = advantage_weights(q, value, 3.0, 100.0)
    torch.testing.assert_close(weights, torch.tensor([np.exp(0.6), np.exp(-0.9), 100.0, np.exp(-15)]).float())
    assert not weights.requires_grad


def linear_learner(**changes: object) -> tuple[IQLLearner, dict[str, np.ndarray]]:
    """A learner whose networks are linear, and their weights; the target critics differ from the critics."""
    data = small_data()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("velap.methods.heads.POLICY", ())
        patch.setattr("velap.methods.iql.CRITIC", ())
        head = IQLHead(SMALL, 1)
    config = dataclasses.replace(IQLConfig(batch=4, rewarded_share=0.0), **changes)
    learner = IQLLearner(head, data, config, make_generator(0))
    rng = np.random.default_rng(7)
    numbers = {"q": rng.normal(size=(2, 3, 1)), "target": rng.normal(size=(2, 3, 1)), "v": rng.normal(size=(1, 2)),
               "pi": rng.normal(size=(1, 2))}
    with torch.no_grad():
        for bias in (head.critics.biases[0], learner.target.biases[0], head.value_net[0].bias, head.policy[0].bias):
            bias.zero_()
        head.critics.weights[0].copy_(torch.from_numpy(numbers["q"]))
        learner.target.weights[0].copy_(torch.from_numpy(numbers["target"]))
        head.value_net[0].weight.copy_(torch.from_numpy(numbers["v"]))
        head.policy[0].weight.copy_(torch.from_numpy(numbers["pi"]))
    return learner, numbers


def small_data() -> LatentData:
    """Five rows of one episode; the transition from row 3 is rewarded and ends it."""
    rng = np.random.default_rng(1)
    rows = torch.arange(4)
    return dataclasses.replace(
        corridor(copies=1), latents=torch.from_numpy(rng.normal(size=(5, 2))).float(),
        actions=torch.from_numpy(rng.uniform(-1, 1, (5, 1))).float(), rewards=torch.tensor([0.0, 0, 0, 1, 0]),
        terminated=torch.tensor([False, False, False, True, False]), last=torch.full((5,), 4), training=rows, held_out=rows,
        rewarded=rows[3:], discount=0.9)


@pytest.mark.parametrize("changes", [
    {}, {"expectile": 0.9, "inverse_temperature": 10.0, "reward_shift": -1.0}, {"weight_clip": 1.5}])
def test_the_losses_are_those_by_hand(changes: dict[str, float]) -> None:
    learner, numbers = linear_learner(**changes)
    config, data = learner.config, learner.data
    z, a = data.latents.numpy().astype(float), data.actions.numpy().astype(float)[:4]
    za = np.concatenate([z[:4], a], 1)
    v = z @ numbers["v"][0]
    estimate = np.minimum(za @ numbers["target"][0, :, 0], za @ numbers["target"][1, :, 0])
    reward, proceeds = np.array([0, 0, 0, 1.0]) + config.reward_shift, np.array([1, 1, 1, 0.0])
    goal = reward + 0.9 * proceeds * v[1:5]
    error = estimate - v[:4]
    value = np.where(error > 0, config.expectile, 1 - config.expectile) * error**2
    critics = sum((za @ numbers["q"][i, :, 0] - goal) ** 2 for i in range(2))
    weight = np.minimum(np.exp(config.inverse_temperature * error), config.weight_clip)
    policy = np.tanh(z[:4] @ numbers["pi"][0])
    assert (error > 0).sum() == 2, "both branches of the expectile"
    assert (weight == config.weight_clip).sum() == (0 if changes == {} else 2), "the clip is at work"
    loss, info = learner.loss(ROWS)
    assert info["value"].item() == pytest.approx(value.mean(), rel=1e-4)
    assert info["critics"].item() == pytest.approx(critics.mean(), rel=1e-4)
    assert info["policy"].item() == pytest.approx((weight * (policy - a[:, 0]) ** 2).mean(), rel=1e-4)
    assert info["clipped"].item() == pytest.approx((weight >= config.weight_clip).mean())
    loss.backward()
    slope = -2 * np.where(error > 0, config.expectile, 1 - config.expectile) * error / 4
    np.testing.assert_allclose(learner.model.value_net[0].weight.grad.numpy()[0], slope @ z[:4], rtol=1e-3)
    slope = 2 * weight * (policy - a[:, 0]) * (1 - policy**2) / 4
    np.testing.assert_allclose(learner.model.policy[0].weight.grad.numpy()[0], slope @ z[:4], rtol=1e-3)
    slopes = [2 * (za @ numbers["q"][i, :, 0] - goal) @ za / 4 for i in range(2)]
    np.testing.assert_allclose(learner.model.critics.weights[0].grad.numpy()[:, :, 0], slopes, rtol=1e-3)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_target_critics_follow_slowly(norm: str) -> None:
    head = IQLHead(dataclasses.replace(SMALL, norm=norm), 1).train()
    learner = IQLLearner(head, corridor(), IQLConfig(target_rate=0.25), make_generator(0))
    for parameter in head.critics.parameters():
        parameter.data.add_(0.3)
    old = [p.clone() for p in learner.target.parameters()]
    learner.update()
    for before, after, online in zip(old, learner.target.parameters(), head.critics.parameters(), strict=True):
        torch.testing.assert_close(after, 0.75 * before + 0.25 * online)
        assert not after.requires_grad
    assert not learner.target.training
    for mine, online in zip(learner.target.buffers(), head.critics.buffers(), strict=True):
        torch.testing.assert_close(mine, online)


def test_a_share_of_the_batch_is_rewarded() -> None:
    data = corridor()
    for share, expected in ((0.25, 64), (0.0, 0)):
        learner = IQLLearner(IQLHead(SMALL, 1), data, IQLConfig(rewarded_share=share), make_generator(0))
        assert (data.rewards[learner.draw()[:64]] > 0).sum() >= expected
    unrewarded = dataclasses.replace(data, rewarded=data.rewarded[:0])
    learner = IQLLearner(IQLHead(SMALL, 1), unrewarded, IQLConfig(rewarded_share=0.25), make_generator(0))
    assert len(learner.draw()) == 256


def exact_values(length: int, expectile: float, discount: float, shift: float) -> tuple[np.ndarray, np.ndarray]:
    """V [length - 1] and Q [length - 1, 2] (left, right) of a corridor under a coin's actions, by iteration.

    The expectile of two equally likely values is τ · the higher + (1 - τ) · the lower.
    """
    v = np.zeros(length - 1)
    q = np.zeros((length - 1, 2))
    for _ in range(2000):
        for p in range(length - 1):
            q[p, 0] = shift + discount * v[max(p - 1, 0)]
            q[p, 1] = shift + (1.0 if p == length - 2 else discount * v[p + 1])
        v = expectile * q.max(1) + (1 - expectile) * q.min(1)
    return v, q


def test_iql_finds_the_values_and_the_policy_of_a_corridor() -> None:
    data, expectile, shift = corridor(length=6, copies=200), 0.9, -1.0
    torch.manual_seed(0)
    head = IQLHead(SMALL, 1).train()
    config = IQLConfig(steps=400, batch=64, learning_rate=1e-2, target_rate=0.2, cosine=True, expectile=expectile,
                       reward_shift=shift, inverse_temperature=1.0, rewarded_share=0.0)
    learner = IQLLearner(head, data, config, make_generator(0))
    for _ in range(config.steps):
        learner.update()
    v, q = exact_values(6, expectile, data.discount, shift)
    latents = torch.tensor([[p / 6, 1.0] for p in range(5)])
    assert v[0] < -4, "five steps away"
    with torch.no_grad():
        np.testing.assert_allclose(head.value(latents).numpy(), v, atol=0.2)
        for action, exact in ((-1.0, q[:, 0]), (1.0, q[:, 1])):
            found = head.qs(latents, torch.full((5, 1), action)).numpy()
            np.testing.assert_allclose(found, np.broadcast_to(exact, (2, 5)), atol=0.25)
        # weights of a coin's two actions: Σ w a / Σ w = tanh(β (Q_right - Q_left) / 2)
        np.testing.assert_allclose(head.act(latents).numpy()[:, 0], np.tanh((q[:, 1] - q[:, 0]) / 2), atol=0.2)


def test_the_presets_are_appendix_d3_and_the_authors() -> None:
    assert (PAPER_IQL.steps, PAPER_IQL.batch, PAPER_IQL.learning_rate) == (300_000, 256, 3e-4)
    assert (PAPER_IQL.expectile, PAPER_IQL.inverse_temperature, PAPER_IQL.rewarded_share) == (0.7, 3.0, 0.0)
    for config in (SPARSE_IQL, PAPER_SPARSE_IQL):
        assert (config.expectile, config.inverse_temperature, config.weight_clip) == (0.9, 10.0, 100.0)
        assert config.reward_shift == -1.0
    assert (PAPER_IQL.target_rate, PAPER_SPARSE_IQL.target_rate, PAPER_SPARSE_IQL.steps) == (0.005, 0.005, 300_000)


@pytest.mark.parametrize(("name", "value"), [
    ("expectile", 1.0), ("inverse_temperature", -1.0), ("weight_clip", 0.0), ("target_rate", 0.0), ("rewarded_share", 2.0),
    ("steps", 0), ("batch", 1), ("learning_rate", 0.0)])
def test_fields_out_of_range_are_named(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=f"IQLConfig field `{name}` is {value}; expected"):
        IQLConfig(**{name: value})  # type: ignore[arg-type]
