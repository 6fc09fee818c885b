"""Several π^g with critics of their own, what each learns from, what the model takes over."""

from __future__ import annotations

import pytest
import torch

from tiny_training import SMALL, config, make, moved, straight_and_resumed, touched, until, weights
from velap.config import Config
from velap.errors import ConfigError
from velap.losses import cross_entropy_critic_loss
from velap.models.networks import EnsembleMLP
from velap.training.ensemble import BATCH

MANY = {"steps": 4, "members": 3}


@pytest.fixture(autouse=True)
def short_distillation(monkeypatch):
    monkeypatch.setattr("velap.config.training.DISTIL_STEPS", 4)


def several(**changes) -> Config:
    """Every kind of phase on frozen latents."""
    return config(SMALL, **{"joint": {"steps": 1}, "latent": {"steps": 1}, "ensemble": MANY, **changes})


@pytest.mark.parametrize("outputs", [1, 3])
@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_members_see_inputs_of_their_own(outputs, norm):
    net = EnsembleMLP(2, 4, (8, 8), norm, outputs).eval()
    x = torch.randn(2, 5, 4)
    both = net.each(x)
    assert both.shape == (2, 5, outputs)
    for other in range(2):
        changed = x.clone()
        changed[other] += 1
        differ = (net.each(changed) - both).abs().amax((1, 2)) > 0
        assert differ.tolist() == [other == 0, other == 1]
    if outputs == 1:  # each on the same inputs is what all do together
        torch.testing.assert_close(net(x[0]), net.each(x[:1].expand(2, -1, -1)).squeeze(-1))


def test_members_begin_apart_and_leave_the_model_alone(tmp_path):
    run = make(tmp_path, several())
    run.update()
    run.update()
    before, learner = weights(run.model), until(run, "ensemble")
    first, target = weights(learner.policies), weights(learner.target)
    for _ in range(3):
        run.update()
    assert run.phase == "ensemble" and not moved(before, run.model)
    assert moved(first, learner.policies) and moved(target, learner.target)
    actions = learner.act(run.frozen.latents[:7].expand(3, -1, -1))
    assert (actions[0] - actions[1]).abs().amax() > 1e-3 and (actions[1] - actions[2]).abs().amax() > 1e-3


def test_each_member_learns_from_its_own_critics(tmp_path):
    run = make(tmp_path, several())
    members = until(run, "ensemble")
    latents, rows = run.frozen.latents, members.draw(3)
    for module in members.modules.values():
        module.zero_grad()
    members.value_loss(rows)[0].backward()
    assert touched(members.critics) and not touched(members.policies) and not touched(members.target)
    q = members.qs(members.critics, latents[rows], run.sampler.actions[rows])
    assert q.shape == (3, run.model.config.n_global, BATCH) and float(q.detach().amin()) >= 0
    one = torch.zeros_like(q)
    for e in range(3):  # member e's critics are numbers e · n_global and after
        x = torch.cat([latents[rows[e]], run.sampler.actions[rows[e]]], -1)
        one[e] = run.model.bound(members.critics(x))[e * q.shape[1] : (e + 1) * q.shape[1]]
    torch.testing.assert_close(q, one)


def test_noise_moves_what_members_see_and_a_floor_weighs_it(tmp_path):
    run = make(tmp_path, several(ensemble={**MANY, "noise": 0.5}, critic_loss="cross_entropy", critic_floor=0.01))
    members = until(run, "ensemble")
    latents, rows = run.frozen.latents, members.draw(3)
    noise = members.noise(rows)
    spread = members.noise(members.draw(3_000)).flatten(0, 1).std(0)
    torch.testing.assert_close(spread, 0.5 * latents.std(0), rtol=0.05, atol=0)
    losses = [members.value_loss(rows, each)[0].item() for each in (0.0, noise)]
    assert losses[0] != losses[1]
    q = members.qs(members.critics, latents[rows] + noise, run.sampler.actions[rows])
    beyond = latents[rows + 1] + noise
    worth = members.qs(members.target, beyond, members.act(beyond)).amin(1) * run.config.train.discount
    goal = run.sampler.rewards[rows] + (~run.sampler.terminated[rows]).float() * worth
    expected, _ = cross_entropy_critic_loss(q, goal.detach().unsqueeze(1), torch.ones(BATCH), 0.01)
    assert losses[1] == pytest.approx(expected.item())


def test_the_model_is_taught_the_members_median(tmp_path, monkeypatch):
    monkeypatch.setattr("velap.config.training.DISTIL_STEPS", 200)
    run = make(tmp_path, several())
    members, model = until(run, "ensemble"), run.model
    while run.done < 4:
        run.update()
    with torch.no_grad():  # two of the three agree; the third is far off, and a mean would follow it
        for name, value in members.policies.named_parameters():
            value[1] = value[0]
            if name == "biases.3":
                value[2] += 3.0
    latents = run.frozen.latents
    every = latents.expand(3, -1, -1)
    agreed, alone = members.act(every)[0].detach(), members.act(every)[2].detach()
    assert float((agreed - alone).abs().mean()) > 0.3
    before, policies = weights(model), weights(members.policies)
    while run.step < run.total:
        run.update()
    assert moved(before, model) == {"global_policy", "global_critic"} and not moved(policies, members.policies)
    action = model.act_global(latents).detach()
    assert float((action - agreed).abs().mean()) < 0.1 * float((agreed - alone).abs().mean())
    value = members.qs(members.critics, every, action.expand(3, -1, -1)).amin(1).mean(0)
    torch.testing.assert_close(model.global_qs(latents, action), value.expand(model.config.n_global, -1), atol=0.05, rtol=0)


@pytest.mark.parametrize("stop", [1, 4, 8])
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_a_training_with_members_resumes_to_the_same_bits(tmp_path, stop, noise):
    straight_and_resumed(tmp_path, several(ensemble={**MANY, "noise": noise}), stop)


@pytest.mark.parametrize("stop", [9, 11])
def test_a_training_with_a_clone_after_the_members_resumes_to_the_same_bits(tmp_path, stop):
    straight_and_resumed(tmp_path, several(clone={"steps": 3}), stop)


def test_settings_out_of_range_are_refused():
    for fields in ({"members": 0}, {"noise": -1.0}):
        with pytest.raises(ConfigError, match=next(iter(fields))):
            several(ensemble={**MANY, **fields})
