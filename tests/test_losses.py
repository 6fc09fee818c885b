"""Losses against hand-computed numbers (Eq. 2-5, 9, Table 4)."""

import math

import pytest
import torch
from torch import tensor

from velap.losses import (
    action_model_loss,
    critic_loss,
    cross_entropy_critic_loss,
    displacement_loss,
    infonce_loss,
    policy_loss,
    polyak,
    reconstruction_loss,
    reparameterise,
    rollout_mse_loss,
    td_target,
    weighted_mean,
)

ONES = torch.ones(2)


def test_weighted_mean_ignores_padding_and_averages_members():
    weight = tensor([1.0, 1.0, 0.0])
    assert weighted_mean(tensor([1.0, 3.0, 99.0]), weight).item() == 2.0
    assert weighted_mean(tensor([[1.0, 3.0, 99.0], [2.0, 4.0, 99.0]]), weight).item() == 2.5


def test_weighted_mean_of_padding_alone_is_zero():
    assert weighted_mean(tensor([5.0]), tensor([0.0])).item() == 0.0


def test_td_target_bootstraps_before_terminals_only():
    target = td_target(tensor([0.0, 1.0]), tensor([1.0, 0.0]), tensor([0.5, 0.9]), 0.96)
    torch.testing.assert_close(target, tensor([0.48, 1.0]))


def test_td_target_carries_no_gradient():
    q = tensor([0.5], requires_grad=True)
    assert not td_target(tensor([0.0]), tensor([1.0]), q, 0.96).requires_grad


def test_critic_loss_is_mean_over_members_of_squared_error():
    loss, info = critic_loss(tensor([[0.5, 1.0], [0.0, 0.0]]), tensor([0.0, 1.0]), ONES)
    # member 1: (0.25 + 0) / 2, member 2: (0 + 1) / 2
    assert loss.item() == pytest.approx((0.125 + 0.5) / 2)
    assert info["q"].item() == pytest.approx(0.375)


def test_cross_entropy_is_zero_at_the_target_and_pulls_far_values_as_hard_as_near_ones():
    target = tensor([0.01, 0.6])
    loss, info = cross_entropy_critic_loss(tensor([[0.01, 0.6], [0.02, 0.6]]), target, ONES)
    divergence = 0.01 * math.log(0.5) + 0.99 * math.log(0.99 / 0.98)
    assert loss.item() == pytest.approx(divergence / 4, abs=1e-7)
    assert info["q"].item() == pytest.approx((0.01 + 0.6 + 0.02 + 0.6) / 4)
    raw = torch.tensor([-6.0, 0.0], requires_grad=True)
    cross_entropy_critic_loss(torch.sigmoid(raw), target, ONES)[0].backward()
    torch.testing.assert_close(raw.grad, (torch.sigmoid(raw) - target).detach() / 2)
    assert cross_entropy_critic_loss(tensor([1.0, 0.0]), tensor([1.0, 0.0]), ONES)[0].item() == 0


def test_with_a_floor_a_step_too_many_counts_alike_far_from_the_goal_and_near_it():
    target = tensor([0.5, 0.05, 0.002])
    q = (0.96 * target).requires_grad_()
    gradient = {}
    for floor in (0.0, 1e-6, 0.002):
        loss, _ = cross_entropy_critic_loss(q, target, torch.ones(3), floor)
        (grad,) = torch.autograd.grad(loss, q)
        gradient[floor] = -(grad * target)  # by the logarithm of q, which is steps
    assert gradient[0.0][0] > 5 * gradient[0.0][1] > 50 * gradient[0.0][2]
    # q (1 - q) is what is left of the sigmoid: half of it at 0.5
    torch.testing.assert_close(gradient[1e-6] * (1 - q.detach()), gradient[1e-6][2].expand(3), rtol=0.03, atol=0)
    assert gradient[0.002][2] == pytest.approx(gradient[0.002][1].item() / 2, rel=0.1)


def test_the_floor_weighs_real_transitions_only_and_keeps_the_size_of_the_loss():
    q, target = tensor([[0.4, 0.02, 0.9], [0.5, 0.01, 0.1]]), tensor([0.5, 0.01, 0.001])
    real = tensor([1.0, 1.0, 0.0])
    loss, _ = cross_entropy_critic_loss(q, target, real, 0.005)
    alone, _ = cross_entropy_critic_loss(q[:, :2], target[:2], torch.ones(2), 0.005)
    assert loss.item() == pytest.approx(alone.item())
    same = tensor([0.3, 0.3])
    plain = cross_entropy_critic_loss(tensor([0.2, 0.4]), same, ONES)[0]
    assert cross_entropy_critic_loss(tensor([0.2, 0.4]), same, ONES, 0.005)[0].item() == pytest.approx(plain.item())
    members = cross_entropy_critic_loss(q[:, :2].expand(3, 2, 2), target[:2].expand(3, 1, 2), torch.ones(2), 0.005)[0]
    assert members.item() == pytest.approx(alone.item())


def test_a_relative_policy_loss_counts_values_in_their_own_size():
    action, data = torch.zeros(2, 2), tensor([[0.0, 0.0], [0.0, 2.0]])
    q = tensor([0.001, 0.5], requires_grad=True)
    loss, _ = policy_loss(q, action, data, 0.5, ONES, relative=True)
    assert loss.item() == pytest.approx(-1 + 0.5 * 1.0)
    loss.backward()
    torch.testing.assert_close(q.grad, -1 / (2 * q.detach()))


def test_policy_loss_adds_value_and_weighted_imitation():
    action = tensor([[1.0, 0.0], [0.0, 0.0]])
    data = tensor([[0.0, 0.0], [0.0, 2.0]])
    loss, info = policy_loss(tensor([0.3, 0.5]), action, data, 0.5, ONES)
    assert info["imitation"].item() == pytest.approx((0.5 + 2.0) / 2)
    assert loss.item() == pytest.approx(-0.4 + 0.5 * 1.25)


def test_infonce_by_hand():
    # one rollout of one step: the truth at distance 1, one negative at distance 2
    predicted = tensor([[[0.0, 0.0]]])
    candidates = tensor([[1.0, 0.0], [0.0, 2.0]])
    loss, _ = infonce_loss(predicted, tensor([[0]]), candidates, tensor([[True]]), temperature=1.0)
    assert loss.item() == pytest.approx(-math.log(math.exp(-1) / (math.exp(-1) + math.exp(-2))), rel=1e-5)
    cold, _ = infonce_loss(predicted, tensor([[0]]), candidates, tensor([[True]]), temperature=0.5)
    assert cold.item() == pytest.approx(-math.log(math.exp(-2) / (math.exp(-2) + math.exp(-4))), rel=1e-5)


def test_infonce_averages_each_step_over_its_valid_rollouts():
    predicted = torch.zeros(2, 2, 1)
    candidates = tensor([[0.0], [1.0]])
    positive = tensor([[0, 1], [1, 0]])
    valid = tensor([[True, False], [True, True]])
    near = math.log(1 + math.exp(-1))
    far = 1 + near
    loss, _ = infonce_loss(predicted, positive, candidates, valid, 1.0)
    assert loss.item() == pytest.approx((near + (far + near) / 2) / 2, abs=2e-3)  # distances are floored at 1e-3


def test_infonce_has_a_finite_gradient_on_a_perfect_prediction():
    predicted = torch.zeros(1, 1, 3, requires_grad=True)
    loss, _ = infonce_loss(predicted, tensor([[0]]), torch.zeros(2, 3), tensor([[True]]), 1.0)
    loss.backward()
    assert torch.isfinite(predicted.grad).all()


def test_rollout_mse_is_in_units_of_scale_over_valid_steps():
    predicted = tensor([[[1.0, 1.0]], [[5.0, 5.0]]])
    actual = torch.zeros(2, 1, 2, requires_grad=True)
    loss, _ = rollout_mse_loss(predicted, actual, tensor([[True], [False]]), tensor(4.0))
    assert loss.item() == pytest.approx(0.5)
    assert not loss.requires_grad


def test_action_model_loss_by_hand():
    decoded, action = tensor([[0.5, 0.0]]), tensor([[0.0, 1.0]])
    mean, log_variance = tensor([[1.0]]), tensor([[math.log(2.0)]])
    loss, info = action_model_loss(decoded, action, mean, log_variance, 0.01, torch.ones(1))
    kl = 0.5 * (1 + 2 - 1 - math.log(2))
    assert info["reconstruction"].item() == pytest.approx(1.25)
    assert info["kl"].item() == pytest.approx(kl)
    assert loss.item() == pytest.approx(1.25 + 0.01 * kl)


def test_reparameterise_scales_by_the_standard_deviation():
    assert reparameterise(tensor([1.0]), tensor([math.log(4.0)]), tensor([0.5])).item() == pytest.approx(2.0)


def test_polyak_moves_by_its_rate():
    target = [tensor([0.0])]
    polyak(target, [tensor([2.0])], 0.25)
    assert target[0].item() == 0.5


def test_displacement_is_square_when_small_and_linear_when_large():
    loss, info = displacement_loss(torch.tensor([[0.5, 3.0]]), torch.zeros(1, 2))
    assert loss.item() == pytest.approx((0.5 * 0.5**2 + (3.0 - 0.5)) / 2)
    assert info["error"].item() == pytest.approx(1.75)


def test_reconstruction_is_one_for_the_mean_frame():
    frames = torch.tensor([[0.2, 0.8], [0.6, 0.4]])
    mean, deviation = torch.tensor([0.4, 0.6]), torch.tensor(0.2)
    loss, info = reconstruction_loss(torch.zeros(2, 2), frames, mean, deviation)
    assert loss.item() == pytest.approx(1.0) and info["loss"].item() == pytest.approx(1.0)
    exact = torch.tensor([[-1.0, 1.0], [1.0, -1.0]])
    assert reconstruction_loss(exact, frames, mean, deviation)[0].item() == pytest.approx(0.0, abs=1e-12)
    assert reconstruction_loss(exact + 2, frames, mean, deviation)[0].item() == pytest.approx(4.0)
