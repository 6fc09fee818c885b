"""Policies that VELAP alone acts by: held actions, the end of successes, and learning them anew beside a finished model."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from test_joint import SMALL, config, make_store, straight_and_resumed
from toy_env import ToyModel, draw, toy_config
from toy_world import GOAL
from velap.config import Config, override
from velap.errors import CheckpointError, ConfigError
from velap.methods.velap import VelapAgent
from velap.models.velap import load_checkpoint, shared_weights
from velap.training.held import hold
from velap.training.loop import Trainer, train
from velap.training.members import HELD_ACTIONS, HELD_MEMBERS

OWN = dataclasses.replace(SMALL, held_policy=True, success_policy=True)
QUICKLY = {"joint_steps": 1, "latent_steps": 1, "held_steps": 4, "distil_steps": 4, "clone_steps": 3, "clone_reach": 2}


def own(**changes) -> Config:
    return config(OWN, **{**QUICKLY, **changes})


def make(path: Path, settings: Config, seed: int = 0) -> Trainer:
    return Trainer(settings, make_store(), path, seed, torch.device("cpu"))


def until(run: Trainer, phase: str) -> Trainer:
    while run._phase_of(run.step)[0] != phase:
        run.update()
    return run


@pytest.mark.parametrize("steps", [1, 3, 50])
def test_a_held_transition_is_what_its_steps_come_to(tmp_path, steps):
    sampler = make(tmp_path, own()).sampler
    held = hold(sampler, steps, 0.9)
    ended = 0
    for row in sampler.transitions.tolist():
        last = int(sampler.last[row])
        taken = min(steps, last - row)
        actions = sampler.actions[row : row + taken]
        torch.testing.assert_close(held.actions[row], actions.mean(0))
        rewards = sum(0.9**i * float(sampler.rewards[row + i]) for i in range(taken))
        assert float(held.rewards[row]) == pytest.approx(rewards)
        assert int(held.following[row]) == row + taken
        over = bool(sampler.terminated[row : row + taken].any())
        ended += over
        assert float(held.alive[row]) == pytest.approx(0.0 if over else 0.9 ** (taken - 1))
    assert ended == {1: 2, 3: 6, 50: 12}[steps], "two episodes of six steps end the task"
    if steps == 1:
        rows = sampler.transitions
        assert torch.equal(held.actions[rows], sampler.actions[rows])
        assert torch.equal(held.rewards[rows], sampler.rewards[rows])


def test_what_comes_after_the_end_of_the_task_does_not_count(tmp_path):
    store = make_store()
    store.terminated[2], store.rewards[2] = True, 1.0  # in the middle of a recorded episode
    sampler = Trainer(own(), store, tmp_path, 0, torch.device("cpu")).sampler
    held = hold(sampler, 5, 0.9)
    assert float(held.rewards[1]) == pytest.approx(0.9) and float(held.alive[1]) == 0
    torch.testing.assert_close(held.actions[1], sampler.actions[1:3].mean(0))


def test_the_end_of_successes_is_cloned(tmp_path):
    sampler = make(tmp_path, own()).sampler
    assert sampler.rewarded.tolist() == [5, 12]
    assert sampler.successes(2).tolist() == [3, 4, 5, 10, 11, 12]
    assert sampler.successes(50).tolist() == sampler.successes().tolist() == [*range(6), *range(7, 13)]


def test_each_phase_moves_the_policy_that_it_is_for(tmp_path):
    run = until(make(tmp_path, own(distil_steps=200)), "held")
    members = run.learner.held
    assert members.count == HELD_MEMBERS and members.name == "held"
    for phase, moved in (("held", set()), ("held_distil", {"held_policy"}), ("clone", {"success_policy"})):
        before = {name: value.clone() for name, value in run.model.state_dict().items()}
        while run.step < run.total and run._phase_of(run.step)[0] == phase:
            run.update()
        after = run.model.state_dict()
        changed = {name.split(".")[0] for name, value in before.items() if not torch.equal(value, after[name])}
        assert changed == moved, phase
    cache = run.learner.cache
    taught = members.act(cache.expand(HELD_MEMBERS, -1, -1)).detach()
    apart = float((taught[0] - taught[1]).abs().mean())
    assert float((run.model.held_policy(cache).detach() - taught).abs().mean()) < apart, "between them, or near one"


def test_policies_of_held_members_learn_at_every_update(tmp_path):
    run = until(make(tmp_path, own(policy_every=2)), "held")
    for _ in range(3):
        before = [p.clone() for p in run.learner.held.policies.parameters()]
        run.update()
        assert any(not torch.equal(a, b) for a, b in zip(before, run.learner.held.policies.parameters(), strict=True))
    assert not any("held_policy" in name or "pupil" in name for name in run.learner.held.state_dict())


def test_held_members_learn_from_held_transitions(tmp_path):
    run = until(make(tmp_path, own()), "held")
    run.update()
    members, cache = run.learner.held, run.learner.cache
    rows = members.draw(HELD_MEMBERS, run.learner.generator)
    loss = members.value_loss(cache, rows)[0]
    held = hold(run.sampler, HELD_ACTIONS, run.config.train.discount)
    then = cache[held.following[rows]]
    worth = members.qs(members.target, then, members.act(then)).amin(1) * run.config.train.discount
    goal = (held.rewards[rows] + held.alive[rows] * worth).detach()
    q = members.qs(members.critics, cache[rows], held.actions[rows])
    assert loss.item() == pytest.approx((q - goal.unsqueeze(1)).square().mean().item(), rel=1e-4)


@pytest.mark.parametrize("stop", [3, 7, 12])
def test_a_training_of_own_policies_resumes_to_the_same_bits(tmp_path, stop):
    straight_and_resumed(tmp_path, own(member_steps=2, members=2), stop)


def test_own_policies_are_learnt_anew_beside_a_finished_model(tmp_path):
    plain = config(dataclasses.replace(SMALL, half_weights=True), joint_steps=1, latent_steps=1, member_steps=2,
                   distil_steps=4)
    first = train(plain, make_store(), tmp_path / "first", device="cpu")
    settings = override(plain, model={"held_policy": True, "success_policy": True},
                        train={name: QUICKLY[name] for name in ("held_steps", "clone_steps", "clone_reach")})
    assert settings.shared_json() == plain.shared_json() and settings.hash() != plain.hash()
    seen = []
    second = train(settings, make_store(), tmp_path / "second", device="cpu", base=first.checkpoint, on_progress=seen.append)
    assert seen[-1].step == settings.train.steps
    before, _, had = load_checkpoint(first.checkpoint)
    after, made, has = load_checkpoint(second.checkpoint)
    assert made == settings and shared_weights(has) == shared_weights(had)
    kept = after.state_dict()
    differing = [name for name, value in before.state_dict().items() if not torch.equal(value, kept[name])]
    assert set(differing) <= {"bank_latents"}, "measured on the weights that were kept"
    fresh = make(tmp_path / "x", settings).model
    for policy in ("held_policy", "success_policy"):
        assert not torch.allclose(getattr(after, policy)[0].weight, getattr(fresh, policy)[0].weight, atol=1e-3)
    for seed, changed, match in ((1, settings, "another seed"), (0, override(settings, train={"c3": 0.7}), "another config"),
                                 (0, plain, "nothing to learn")):
        with pytest.raises(CheckpointError, match=match):
            train(changed, make_store(), tmp_path / "third", device="cpu", seed=seed, base=first.checkpoint)


def test_the_clone_acts_near_the_goal_and_the_held_policy_before():
    away, up = (lambda z: torch.full_like(z, -0.5)), (lambda z: z.new_tensor([0.0, 0.5]).expand_as(z))
    settings = override(toy_config(n_iter=20), model={"success_policy": True},
                        controller={"stop_exponent": 6.0, "success_exponent": 3.0})
    places = [np.array(GOAL) + offset for offset in ([-2.0, 0.0], [-4.5, 0.0])]
    frames = np.stack([[draw(place)] * 2 for place in places])
    model = ToyModel(act_success=away)
    agent = VelapAgent(model, settings)
    toward = agent.act(frames)
    assert agent.led.tolist() == [True, False]
    np.testing.assert_allclose(toward[0], [-1.0, -1.0], atol=0.03)
    assert toward[1, 0] > 1.5, "π^g leads where there is no held policy"
    model.held_policy = up
    np.testing.assert_allclose(VelapAgent(model, settings).act(frames)[1], [0.0, 1.0], atol=0.03)


def test_revisits_do_not_take_the_lead_from_the_clone_before_they_call_for_a_plan():
    settings = override(toy_config(n_iter=20), model={"success_policy": True},
                        controller={"stop_exponent": 6.0, "success_exponent": 3.0, "revisit_penalty": 1.0})
    agent = VelapAgent(ToyModel(act_success=lambda z: torch.full_like(z, -0.5)), settings)
    frames, led, planned = np.stack([[draw(np.array(GOAL) - [2.0, 0.0])] * 2]), [], []
    for _ in range(12):
        agent.act(frames)
        led.append(bool(agent.led[0]))
        planned.append(not bool(agent.near_goal[0]))
    below = float(agent.last_values[0])
    assert led[0] and led[2] and not led[-1] and planned[-1] and below < 0.96**6
    assert all(a != b for a, b in zip(led, planned, strict=True))


def test_the_held_policy_and_the_global_one_take_turns():
    settings = override(toy_config(n_iter=20), model={"held_policy": True},
                        controller={"stop_exponent": 90.0, "held_turn": 2})
    model = ToyModel()
    model.held_policy = lambda z: z.new_tensor([0.0, -0.5]).expand_as(z)
    agent, frames = VelapAgent(model, settings), np.stack([[draw(np.array(GOAL) - [3.0, 0.0])] * 2] * 2)
    assert agent.global_policy == "held or global policy"
    assert VelapAgent(ToyModel(), toy_config()).global_policy == "global policy"
    down = []
    for step in range(7):
        if step == 3:
            agent.reset(np.array([False, True]))
        down.append((agent.act(frames)[:, 1] < -0.5).tolist())
    assert [row[0] for row in down] == [True, True, False, False, True, True, False]
    assert [row[1] for row in down] == [True, True, False, True, True, False, False], "a new episode begins with its own"


def test_settings_without_their_policy_are_refused():
    for part, fields in (("train", {"held_steps": 4, "distil_steps": 4}), ("controller", {"success_exponent": 3.0}),
                         ("controller", {"held_turn": 3})):
        with pytest.raises(ConfigError, match="is off"):
            override(config(), **{part: fields})
    with pytest.raises(ConfigError, match="stop_exponent"):
        override(config(OWN), controller={"success_exponent": 30.0})
    for fields in ({"held_steps": 4}, {"clone_reach": -1}):
        with pytest.raises(ConfigError, match=r"distil_steps|clone_reach"):
            override(config(OWN), train=fields)
