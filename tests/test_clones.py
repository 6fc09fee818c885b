"""Policies cloned from successes one after the other: when a policy arrives, which one is kept, and what a resume needs."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import tensor

from test_joint import CLONED, config, make_store
from velap.models.arrivals import arrivals
from velap.training.clones import Clones, arrival_rate, fresh
from velap.training.loop import Trainer

GOAL = 0.9


def value(z: torch.Tensor) -> torch.Tensor:
    """The goal is at 1."""
    return (z[..., 0] > 1).float()


def test_arrivals_count_the_steps_of_every_gain_until_the_goal() -> None:
    states = tensor([[-0.95], [0.35], [5.0], [-9.0]])
    found = arrivals(lambda z: torch.full_like(z, 0.2), lambda z, a: z + a, value, states, GOAL, 12, (1.0, 2.0, 50.0))
    # looked at every third step: 1.95 away takes 10 steps of 0.2, 5 of 0.4, 2 of 1
    assert found.steps.tolist() == [[12, 6, 3, torch.inf], [6, 3, 3, torch.inf], [3, 3, 3, 12]]
    torch.testing.assert_close(found.first[:, 0, 0], tensor([0.2, 0.4, 1.0]))


class Line:
    """A model whose latent is a place on a line: the goal lies at 1, and a clone goes one way or the other."""

    discount = 0.9

    def __init__(self, speed: float) -> None:
        self.success_policy = torch.nn.Linear(1, 1)
        torch.nn.init.constant_(self.success_policy.weight, 0.0)
        torch.nn.init.constant_(self.success_policy.bias, speed)

    def step(self, z: torch.Tensor, a: torch.Tensor) -> torch.Tensor:
        return z + 0.015 * a

    def value(self, z: torch.Tensor) -> torch.Tensor:
        return torch.where(z[..., 0] > 1, 1.0, torch.sigmoid(z[..., 0]) / 2)


def test_the_clone_that_arrives_from_more_of_the_far_states_is_kept() -> None:
    cache, rows, generator = torch.linspace(-2, 1, 400).unsqueeze(1), torch.arange(400), torch.Generator().manual_seed(0)
    slow, fast, away = Line(0.3), Line(0.6), Line(-1.0)
    # the farther half lies between -2 and -0.5; 150 steps are 1.69 at 2.5 times 0.3, and 2.25 at most
    assert arrival_rate(away, cache) == 0
    assert 0 < arrival_rate(slow, cache) < arrival_rate(fast, cache) < 1
    clones = Clones(away.success_policy)
    for model in (slow, fast, away):
        clones.judge(model, cache, rows, generator)
    assert torch.equal(clones.best.bias, fast.success_policy.bias)
    assert float(clones.rate) == pytest.approx(arrival_rate(fast, cache), abs=0.05)


def make(tmp_path, name: str, **changes) -> Trainer:
    return Trainer(config(CLONED, clone_steps=9, clone_candidates=3, **changes), make_store(), tmp_path / name, 0,
                   torch.device("cpu"))


def until_clones(run: Trainer) -> Trainer:
    while run.total - run.step > 9:
        run.update()
    return run


def test_every_candidate_begins_anew_and_the_best_one_ends_in_the_model(tmp_path, monkeypatch) -> None:
    rates, kept, begun = iter([0.2, 0.7, 0.5]), [], []
    monkeypatch.setattr("velap.training.clones.arrival_rate", lambda model, states: next(rates))
    run = until_clones(make(tmp_path, "a"))
    for step in range(9):
        info = run.update()
        state = {k: v.clone() for k, v in run.model.success_policy.state_dict().items()}
        if step % 3 == 0:
            begun.append(state["0.weight"])
            assert len(run.learner.cloning.optimizer.state) and run.learner.cloning.optimizer.param_groups[0]["lr"] == 1e-3
            moments = next(iter(run.learner.cloning.optimizer.state.values()))
            assert float(moments["step"]) == 1, "an optimiser of its own"
        assert ("clone/arrival_rate" in info) == (step % 3 == 2)
        if step % 3 == 2:
            kept.append(state)
    assert not torch.allclose(begun[0], begun[1], atol=0.05), "weights of their own"
    final = run.model.success_policy.state_dict()
    assert all(torch.equal(final[k], run.learner.cloning.candidates.best.state_dict()[k]) for k in final)
    # at the last update the model already holds the winner again: the second
    assert all(torch.equal(final[k], kept[1][k]) for k in final)


@pytest.mark.parametrize("left", [8, 4, 2])
def test_a_resume_between_and_within_candidates_goes_on_to_the_same_bits(tmp_path, left: int) -> None:
    straight, broken = until_clones(make(tmp_path, "a")), make(tmp_path, "b")
    while straight.step < straight.total:
        straight.update()
    while broken.total - broken.step > left:
        broken.update()
    broken.save()
    again = make(tmp_path, "b")
    again.resume()
    while again.step < again.total:
        again.update()
    expected = straight.model.state_dict()
    assert all(torch.equal(v, expected[k]) for k, v in again.model.state_dict().items())
    assert torch.equal(again.learner.cloning.candidates.rate, straight.learner.cloning.candidates.rate)


def test_one_candidate_keeps_the_weights_it_has(tmp_path) -> None:
    run = Trainer(config(CLONED, clone_steps=1), make_store(), tmp_path, 0, torch.device("cpu"))
    before = run.model.success_policy[0].weight.clone()
    assert run.learner.cloning.candidates is None
    while run.step < run.total:
        info = run.update()
    assert "clone/arrival_rate" not in info
    assert (run.model.success_policy[0].weight - before).abs().max() < 2e-3


def test_fresh_weights_come_from_the_generator_alone() -> None:
    first, second = torch.nn.Linear(3, 3), torch.nn.Linear(3, 3)
    for policy in (first, second):
        fresh(policy, torch.Generator().manual_seed(4))
    assert torch.equal(first.weight, second.weight)
    state = torch.get_rng_state()
    fresh(first, torch.Generator().manual_seed(5))
    assert torch.equal(torch.get_rng_state(), state)
    assert not torch.equal(first.weight, second.weight)


def test_settings_of_the_clone_do_not_touch_what_methods_share() -> None:
    plain = config(CLONED, clone_steps=9)
    other = dataclasses.replace(plain, train=dataclasses.replace(plain.train, clone_candidates=3))
    assert plain.shared_json() == other.shared_json()
    assert plain.hash() != other.hash()
