"""IRIS: the targets of manager and worker, its loss by hand, and a line whose subgoals and actions are known."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from latent_data import SMALL, corridor
from velap.errors import ConfigError
from velap.methods.iris import (
    MULTISTEP_SUBGOALS,
    PAPER_SUBGOALS,
    SubgoalConfig,
    SubgoalHead,
    SubgoalLearner,
    future_rows,
)
from velap.runs import make_generator
from velap.training.frozen import LatentData


@pytest.fixture(autouse=True)
def small_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks that learn little data in few updates."""
    for name, value in {"GENERATIVE": (32, 32), "POLICY": (32, 32), "NOISE_DIM": 2}.items():
        monkeypatch.setattr(f"velap.methods.iris.{name}", value)


def walks(length: int = 12, copies: int = 60) -> LatentData:
    """Straight walks along a line: half of them to the right (action 0.5), half to the left (-0.5), z = (place, 0)."""
    place, action, last = [], [], []
    for copy in range(copies):
        direction = 1 if copy % 2 else -1
        start = len(place)
        for step in range(length + 1):
            place.append(direction * step / 4)
            action.append(0.5 * direction if step < length else 0.0)
            last.append(start + length)
    rows = torch.tensor([i for i, end in enumerate(last) if i < end])
    return dataclasses.replace(
        corridor(copies=1), latents=torch.stack([torch.tensor(place), torch.zeros(len(place))], 1),
        actions=torch.tensor(action)[:, None], rewards=torch.zeros(len(place)),
        terminated=torch.zeros(len(place), dtype=torch.bool), last=torch.tensor(last), training=rows, held_out=rows[:50],
        rewarded=rows[:0])


def test_the_future_ends_with_the_episode() -> None:
    rows, last = torch.tensor([0, 3, 6]), torch.tensor([4, 4, 9])
    assert future_rows(rows, last, 3).tolist() == [3, 4, 9]
    assert future_rows(rows, last, torch.tensor([1, 1, 2])).tolist() == [1, 4, 8]


def test_horizon_and_scale_are_kept_with_the_head() -> None:
    data, head = walks(length=4, copies=2), SubgoalHead(SMALL, 1)
    SubgoalLearner(head, data, SubgoalConfig(horizon=3), make_generator(0))
    assert head.horizon == 3
    # changes of a walk: 3, 3, 2, 1 steps of a quarter, in one of two dimensions
    expected = ((9 + 9 + 4 + 1) / 4 / 16 / 2) ** 0.5
    assert float(head.change_scale) == pytest.approx(expected)
    noise, latent = torch.randn(5, 2), torch.randn(5, 2)
    torch.testing.assert_close(head.propose(latent, noise), latent + expected * head.manager.decode(latent, noise))


def test_the_loss_is_that_by_hand() -> None:
    data, head = walks(), SubgoalHead(SMALL, 1)
    learner = SubgoalLearner(head, data, SubgoalConfig(horizon=5, kl_weight=0.2), make_generator(4))
    rows = torch.tensor([0, 3, 10, 11])
    loss, info = learner.loss(rows)
    generator = make_generator(4)
    noise, ahead = torch.randn(4, 2, generator=generator), 1 + torch.randint(5, (4,), generator=generator)
    z = data.latents[rows]
    change = (data.latents[torch.tensor([5, 8, 12, 12])] - z) / head.change_scale
    mean, log_variance = head.manager.posterior(z, change)
    decoded = head.manager.decode(z, mean + (log_variance / 2).exp() * noise)
    reconstruction = (decoded - change).square().sum(-1).mean()
    kl = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).sum(-1).mean()
    goal = data.latents[torch.minimum(rows + ahead, torch.tensor(12))]
    worker = (head.worker(torch.cat([z, goal], -1)) - data.actions[rows]).square().mean()
    torch.testing.assert_close(loss, reconstruction + 0.2 * kl + worker)
    torch.testing.assert_close(info["worker"], worker.detach())


def test_the_worker_aims_at_most_the_horizon_ahead() -> None:
    data, head = walks(), SubgoalHead(SMALL, 1)
    learner = SubgoalLearner(head, data, SubgoalConfig(horizon=3), make_generator(0))
    seen = []
    act = head.act
    head.act = lambda latent, goal: (seen.append(goal - latent), act(latent, goal))[1]  # type: ignore[method-assign]
    learner.loss(torch.zeros(500, dtype=torch.int64))
    steps = (seen[0][:, 0].abs() * 4).round().long()
    assert set(steps.tolist()) == {1, 2, 3}


def test_iris_learns_both_ways_out_and_how_to_go_there() -> None:
    data = walks()
    torch.manual_seed(0)
    head = SubgoalHead(SMALL, 1).train()
    config = SubgoalConfig(steps=400, batch=64, learning_rate=5e-3, horizon=4, kl_weight=0.03)
    learner = SubgoalLearner(head, data, config, make_generator(0))
    for _ in range(config.steps):
        learner.update()
    with torch.no_grad():
        goals = head.propose(torch.zeros(500, 2), torch.randn(500, 2, generator=make_generator(1)))
        share_right = (goals[:, 0] > 0).float().mean().item()
        assert 0.3 < share_right < 0.7, "half of the data goes right"
        assert ((goals[:, 0].abs() - 1).abs() < 0.25).float().mean() > 0.6, "four steps of a quarter away"
        assert goals[:, 1].abs().max() < 0.2
        places = torch.linspace(-2, 2, 9)
        for direction in (-1.0, 1.0):
            here = torch.stack([places, torch.zeros(9)], 1)[(places * direction >= 0)]
            actions = head.act(here, here + torch.tensor([direction * 0.75, 0.0]))
            torch.testing.assert_close(actions, torch.full_like(actions, 0.5 * direction), atol=0.1, rtol=0)


def test_the_multistep_variant_is_appendix_d7() -> None:
    assert MULTISTEP_SUBGOALS.horizon == 5
    assert (PAPER_SUBGOALS.steps, PAPER_SUBGOALS.batch, PAPER_SUBGOALS.learning_rate) == (300_000, 128, 3e-4)
    with pytest.raises(ConfigError, match="SubgoalConfig field `horizon` is 0; expected at least 1 step"):
        SubgoalConfig(horizon=0)
