"""Policies cloned from successes one after the other: when a policy arrives, which one is kept, and what a resume needs."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import tensor

from tiny_training import SMALL, config, make, make_store, moved, straight_and_resumed, to_end, weights
from velap.config import Config
from velap.errors import DatasetError
from velap.models.arrivals import arrivals
from velap.models.checkpoint import load_checkpoint
from velap.training.clone import Best, arrival_rate, fresh, measure_arrivals
from velap.training.loop import Trainer

GOAL = 0.9


@pytest.fixture(autouse=True)
def few_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clones are judged from fewer states than data have."""
    monkeypatch.setattr("velap.training.clone.STATES", 60)


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
    states = torch.linspace(-2, 1, 400).unsqueeze(1)
    slow, fast, away = Line(0.3), Line(0.6), Line(-1.0)
    # the farther half lies between -2 and -0.5; 150 steps are 1.69 at 2.5 times 0.3, and 2.25 at most
    rates = [arrival_rate(model, model.success_policy, states) for model in (slow, fast, away)]
    assert rates[2] == 0 < rates[0] < rates[1] < 1
    best = Best(away.success_policy)
    for model, rate in zip((slow, fast, away), rates, strict=True):
        best.keep(model.success_policy, rate)
    assert torch.equal(best.policy.bias, fast.success_policy.bias) and float(best.rate) == pytest.approx(rates[1])


def cloning(steps: int = 9, candidates: int = 3) -> Config:
    return config(SMALL, clone={"steps": steps, "candidates": candidates})


def test_every_candidate_begins_anew_and_the_best_one_ends_in_the_model(tmp_path, monkeypatch) -> None:
    rates, kept, begun = iter([0.2, 0.7, 0.5]), [], []
    monkeypatch.setattr("velap.training.clone.arrival_rate", lambda model, policy, states: next(rates))
    run = make(tmp_path, cloning())
    while run.total - run.step > 9:
        run.update()
    for step in range(9):
        info = run.update()
        state = weights(run.model.success_policy)
        if step % 3 == 0:
            begun.append(state["0.weight"])
            optimizer = run.learner.optimizers["clone"]
            assert optimizer.param_groups[0]["lr"] == 1e-3
            assert float(next(iter(optimizer.state.values()))["step"]) == 1, "an optimiser of its own"
        assert ("clone/arrival_rate" in info) == (step % 3 == 2)
        if step % 3 == 2:
            kept.append(state)
    assert not torch.allclose(begun[0], begun[1], atol=0.02), "weights of their own"
    final = run.model.success_policy.state_dict()
    # at the last update the model already holds the winner again: the second
    assert all(torch.equal(final[k], kept[1][k]) for k in final)


@pytest.mark.parametrize("done", [1, 5, 7])
def test_a_resume_between_and_within_candidates_goes_on_to_the_same_bits(tmp_path, monkeypatch, done: int) -> None:
    monkeypatch.setattr("velap.training.clone.HORIZON", 12)
    straight_and_resumed(tmp_path, cloning(), 12 + done)


def test_the_clone_phase_moves_the_policy_of_successes_alone_towards_their_actions(tmp_path) -> None:
    run = make(tmp_path, cloning(200, 1))
    while run.total - run.step > 200:
        run.update()
    before = weights(run.model)
    first, learner = float(run.update()["clone/loss"]), run.learner
    while run.step < run.total:
        last = float(run.update()["clone/loss"])
    assert moved(before, run.model) == {"success_policy"}
    # two successful episodes of six steps in the store, none held out
    assert run.sampler.episodes[run.sampler.rank_of_row[learner.rows]].unique().tolist() == [0, 1]
    assert len(learner.rows) == 12 and last < 0.7 * first, "noise, learnt by heart"
    loaded, _, _ = load_checkpoint(run.finish("x").checkpoint)
    assert loaded.search_fns().act_success(torch.zeros(2, SMALL.latent_dim)).shape == (2, 3)


def test_a_finished_training_knows_whether_the_clone_or_the_policy_gets_to_the_goal_more_often(tmp_path) -> None:
    run = to_end(make(tmp_path, cloning(3, 1)))
    run.model.global_policy.requires_grad_(False)
    with torch.no_grad():
        for policy, way in ((run.model.global_policy, -1.0), (run.model.success_policy, 1.0)):
            last = list(policy)[-1]
            last.weight.zero_()
            last.bias.fill_(20 * way)
    run.model.step = lambda z, a: z + 0.1 * a.mean(-1, keepdim=True)  # type: ignore[method-assign]
    run.model.value = lambda z: torch.sigmoid(z.mean(-1))  # type: ignore[method-assign]
    measure_arrivals(run.model, run.sampler, torch.Generator().manual_seed(0))
    assert run.model.arrival_rates.tolist() == [0.0, 1.0]
    loaded, _, _ = load_checkpoint(run.finish("x").checkpoint)
    assert loaded.search_fns().arrival_rates == tuple(run.model.arrival_rates.tolist()) == (0.0, 1.0)


def test_whole_successful_episodes_are_cloned(tmp_path) -> None:
    sampler = make(tmp_path, config()).sampler
    assert sampler.rewarded.tolist() == [5, 12]
    assert sampler.successes().tolist() == [*range(6), *range(7, 13)]


def test_nothing_to_clone_is_an_error_before_the_first_update(tmp_path) -> None:
    store = make_store()
    store = dataclasses.replace(store, rewards=store.rewards * 0)
    with pytest.raises(DatasetError, match="no successful episode"):
        Trainer(cloning(), store, tmp_path, 0, torch.device("cpu"))


def test_one_candidate_keeps_the_weights_it_has(tmp_path) -> None:
    run = make(tmp_path, cloning(1, 1))
    before = run.model.success_policy[0].weight.clone()
    to_end(run)
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
