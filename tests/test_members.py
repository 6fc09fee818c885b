"""Several π^g with critics of their own: what each learns from, whose weights move, what the model takes over."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from test_joint import SMALL, config, make_store, straight_and_resumed, touched
from velap.config.training import TrainConfig
from velap.errors import ConfigError
from velap.losses import cross_entropy_critic_loss
from velap.models.networks import EnsembleMLP
from velap.training.loop import Trainer
from velap.training.members import BATCH

MANY = {"member_steps": 4, "members": 3, "distil_steps": 4}


def trained(path: Path, updates: int, **changes) -> Trainer:
    run = Trainer(config(SMALL, joint_steps=1, latent_steps=1, **{**MANY, **changes}), make_store(), path, 0,
                  torch.device("cpu"))
    for _ in range(updates):
        run.update()
    return run


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("norm", ["layer", "none"])
def test_members_see_inputs_of_their_own(outputs, norm):
    net = EnsembleMLP(2, 4, (8, 8), norm, outputs)
    x = torch.randn(2, 5, 4)
    both = net.each(x)
    assert both.shape == (2, 5, outputs)
    for other in range(2):
        changed = x.clone()
        changed[other] += 1
        moved = (net.each(changed) - both).abs().amax((1, 2)) > 0
        assert moved.tolist() == [other == 0, other == 1]
    if outputs == 1:  # each on the same inputs is what all do together
        torch.testing.assert_close(net(x[0]), net.each(x[:1].expand(2, -1, -1)).squeeze(-1))


def test_members_begin_apart_and_leave_the_model_alone(tmp_path):
    run = trained(tmp_path, 2)
    before = {name: value.clone() for name, value in run.model.state_dict().items()}
    members = run.learner.members
    assert members is not None
    first = [p.clone() for p in members.policies.parameters()]
    target = [p.clone() for p in members.target.parameters()]
    for _ in range(4):
        assert run._phase_of(run.step)[0] == "members"
        run.update()
    assert all(torch.equal(value, before[name]) for name, value in run.model.state_dict().items())
    assert any(not torch.equal(a, b) for a, b in zip(first, members.policies.parameters(), strict=True))
    assert any(not torch.equal(a, b) for a, b in zip(target, members.target.parameters(), strict=True))
    actions = members.act(run.learner.cache[:7].expand(3, -1, -1))
    assert (actions[0] - actions[1]).abs().amax() > 1e-3 and (actions[1] - actions[2]).abs().amax() > 1e-3


def test_each_member_learns_from_its_own_critics(tmp_path):
    members = (run := trained(tmp_path, 3)).learner.members
    cache, rows = run.learner.cache, members.draw(3, run.learner.generator)
    members.zero_grad()
    members.value_loss(cache, rows)[0].backward()
    assert touched(members.critics) and not touched(members.policies) and not touched(members.target)
    q = members.qs(members.critics, cache[rows], run.sampler.actions[rows])
    assert q.shape == (3, run.model.config.n_global, BATCH) and float(q.detach().amin()) >= 0
    one = torch.zeros_like(q)
    for e in range(3):  # member e's critics are numbers e · n_global and after
        x = torch.cat([cache[rows[e]], run.sampler.actions[rows[e]]], -1)
        one[e] = members.bound(members.critics(x))[e * q.shape[1] : (e + 1) * q.shape[1]]
    torch.testing.assert_close(q, one)


def test_noise_blurs_what_members_see_and_a_floor_weighs_it(tmp_path):
    run = trained(tmp_path, 3, member_noise=0.5, critic_loss="cross_entropy", critic_floor=0.01)
    members = run.learner.members
    cache, generator = run.learner.cache, run.learner.generator
    rows = members.draw(3, generator)
    blur = members.blur(cache, rows, generator)
    wide = members.draw(3_000, generator)
    spread = members.blur(cache, wide, generator).flatten(0, 1).std(0)
    torch.testing.assert_close(spread, 0.5 * cache.std(0), rtol=0.05, atol=0)
    losses = [members.value_loss(cache, rows, noise)[0].item() for noise in (0.0, blur)]
    assert losses[0] != losses[1]
    q = members.qs(members.critics, cache[rows] + blur, run.sampler.actions[rows])
    beyond = cache[rows + 1] + blur
    worth = members.qs(members.target, beyond, members.act(beyond)).amin(1) * run.config.train.discount
    goal = run.sampler.rewards[rows] + (~run.sampler.terminated[rows]).float() * worth
    expected, _ = cross_entropy_critic_loss(q, goal.detach().unsqueeze(1), torch.ones(BATCH), 0.01)
    assert losses[1] == pytest.approx(expected.item())


def test_the_model_is_taught_the_members_median(tmp_path):
    run = trained(tmp_path, 6, distil_steps=300)
    members, model, cache = run.learner.members, run.model, run.learner.cache
    with torch.no_grad():  # two of the three agree; the third is far off, and a mean would follow it
        for name, value in members.policies.named_parameters():
            value[1] = value[0]
            if name == "biases.1":
                value[2] += 3.0
    every = cache.expand(3, -1, -1)
    agreed, alone = members.act(every)[0].detach(), members.act(every)[2].detach()
    assert float((agreed - alone).abs().mean()) > 0.3
    local = [p.clone() for p in model.local_policy.parameters()]
    policies = [p.clone() for p in members.policies.parameters()]
    for _ in range(300):
        run.update()
    action = model.act_global(cache).detach()
    assert float((action - agreed).abs().mean()) < 0.1 * float((agreed - alone).abs().mean())
    value = members.qs(members.critics, every, action.expand(3, -1, -1)).amin(1).mean(0)
    torch.testing.assert_close(model.global_qs(cache, action), value.expand(model.config.n_global, -1), atol=0.05, rtol=0)
    for was, module in ((local, model.local_policy), (policies, members.policies)):
        assert all(torch.equal(a, b) for a, b in zip(was, module.parameters(), strict=True))


@pytest.mark.parametrize("stop", [1, 4, 8])
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_training_with_members_resumes_to_the_same_bits(tmp_path, stop, noise):
    straight_and_resumed(tmp_path, config(SMALL, joint_steps=1, latent_steps=1, member_noise=noise, **MANY), stop)


@pytest.mark.parametrize("fields", [{"member_steps": 5}, {"distil_steps": 5}, {**MANY, "members": 0}])
def test_members_without_their_counterpart_are_refused(fields):
    with pytest.raises(ConfigError, match=r"distil_steps|members"):
        TrainConfig(**fields)
