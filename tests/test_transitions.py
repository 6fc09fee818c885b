"""h alone and values alone on frozen latents: what is drawn, what is weighed, what moves, and that a resume is exact."""

import dataclasses

import pytest
import torch

from test_joint import trainer
from velap.losses import rollout_metric_loss
from velap.training.transitions import TransitionObjective, step_metric


def test_the_metric_makes_one_step_changes_white():
    generator = torch.Generator().manual_seed(0)
    mixing = torch.tensor([[3.0, 0.0, 0.0], [1.0, 0.1, 0.0], [0.0, 0.5, 0.01]])
    changes = torch.randn(4000, 3, generator=generator) @ mixing
    white = changes @ step_metric(changes, ridge=0.0)
    assert torch.allclose(white.T @ white / len(white), torch.eye(3), atol=1e-2)
    damped = changes @ step_metric(changes, ridge=0.1)
    variance = (damped.T @ damped / len(damped)).diagonal().sort().values
    assert variance[-1] == pytest.approx(1, abs=0.1) and variance[0] < 0.01, "what hardly varies is not blown up"


def test_an_unmoving_dataset_has_a_finite_metric():
    assert step_metric(torch.zeros(10, 2), ridge=0.1).isfinite().all()


def test_rollout_metric_loss_by_hand():
    predicted = torch.tensor([[[1.0, 0.0], [0.0, 0.0]], [[0.0, 9.0], [5.0, 5.0]]])
    actual = torch.zeros(2, 2, 2)
    valid = torch.tensor([[True, True], [True, False]])
    loss, rollout, info = rollout_metric_loss(predicted, actual, valid, torch.diag(torch.tensor([2.0, 1.0])), clip=10.0)
    beyond = 2 * (10 * 81) ** 0.5 - 10  # 9² is more than 10, so it counts linearly
    assert loss.item() == pytest.approx((4 + 0 + beyond) / 3)  # (1 · 2)², nothing, 9; the last step is not real
    assert rollout.tolist() == pytest.approx([(4 + beyond) / 2, 0.0])
    assert info["loss"] == loss


def test_an_h_that_errs_everywhere_still_learns():
    predicted = torch.full((3, 4, 2), 50.0, requires_grad=True)
    valid = torch.ones(3, 4, dtype=torch.bool)
    loss, _, _ = rollout_metric_loss(predicted, torch.zeros(3, 4, 2), valid, torch.eye(2), clip=400.0)
    loss.backward()
    assert (predicted.grad > 0).all()


def frozen(tmp_path, **changes):
    run = trainer(tmp_path, **{"latent_steps": 0, "latent_dynamics_steps": 4, "latent_value_steps": 4,
                               "latent_dynamics_batch": 400, "latent_value_batch": 16, **changes})
    run.learner.begin_latent_phase()
    return run, run.learner.transitions


def test_half_of_the_batch_is_drawn_by_the_last_error(tmp_path):
    run, transitions = frozen(tmp_path)
    transitions.priority.fill_(1e-3)
    transitions.priority[5] = 100.0
    drawn = transitions.draw(run.generator)
    share = (drawn[200:] == 5).float().mean()
    weights = transitions.priority.sqrt()
    assert share == pytest.approx(float(weights[5] / weights.sum()), abs=0.1) and share > 0.7
    assert (drawn[:200] == 5).float().mean() < 0.1, "the other half is uniform"
    assert len(set(drawn[:200].tolist())) > 0.8 * len(transitions.priority)


def test_priorities_are_the_errors_of_the_drawn_transitions(tmp_path):
    run, transitions = frozen(tmp_path, latent_dynamics_batch=8, latent_dynamics_horizon=1)
    seen, draw = [], transitions.draw
    transitions.draw = lambda generator: seen.append(draw(generator)) or seen[-1]
    transitions.loss(run.model, run.generator)
    rows = run.sampler.transitions[seen[0]]
    cache = run.learner.cache
    error = (run.model.step(cache[rows], run.sampler.actions[rows]) - cache[rows + 1]) @ transitions.metric
    expected = error.square().sum(-1).clamp(TransitionObjective.LEAST, TransitionObjective.MOST)
    assert torch.allclose(transitions.priority[seen[0]], expected)
    untouched = torch.ones(len(transitions.priority), dtype=torch.bool)
    untouched[seen[0]] = False
    assert (transitions.priority[untouched] == 1).all()


def test_rollouts_stop_at_the_end_of_an_episode(tmp_path):
    run, transitions = frozen(tmp_path, latent_dynamics_horizon=3)
    pool, last = run.sampler.transitions, run.sampler.last
    final = (pool + 1 == last[pool]).nonzero().flatten()[:1]
    transitions.draw = lambda generator: final
    loss, _ = transitions.loss(run.model, run.generator)
    row, cache = pool[final], run.learner.cache
    error = (run.model.step(cache[row], run.sampler.actions[row]) - cache[row + 1]) @ transitions.metric
    assert loss.item() == pytest.approx(error.square().sum().item(), rel=1e-4)


def test_each_phase_moves_its_own_networks(tmp_path):
    run = trainer(tmp_path, latent_steps=0, latent_dynamics_steps=2, latent_value_steps=2)
    while run.phase != "joint" or run.step < 6:
        run.update()
    moved = {}
    for phase in ("dynamics", "values"):
        before = {name: value.clone() for name, value in run.model.state_dict().items()}
        for _ in range(2):
            run.update()
        assert run.phase == phase
        after = run.model.state_dict()
        moved[phase] = {name.split(".")[0] for name, value in before.items() if (value != after[name]).any()}
    assert moved["dynamics"] == {"dynamics"}
    assert moved["values"] == {"local_critics", "global_critic", "local_policy", "global_policy", "action_model"}


def test_priority_lowers_the_largest_errors(tmp_path):
    """On noise, that is learnt by heart, the worst transitions are better known where they are drawn more often."""
    worst = {}
    for priority in (0.0, 1.0):
        run, transitions = frozen(tmp_path / str(priority), latent_dynamics_batch=16, latent_dynamics_horizon=1,
                                  latent_priority=priority)
        run.learner.set_learning_rate(3e-3)
        for update in range(300):
            if update % 50 == 0:
                transitions.draws.zero_()  # cumulates anew, as a long run does every few hundred draws
            run.learner.dynamics_step()
        rows, cache = run.sampler.transitions, run.learner.cache
        error = (run.model.step(cache[rows], run.sampler.actions[rows]) - cache[rows + 1]) @ transitions.metric
        worst[priority] = error.square().sum(-1).topk(5).values.mean().item()
    assert worst[1.0] < worst[0.0]


@pytest.mark.parametrize("stop", [7, 9, 11, 13])
def test_a_resume_in_these_phases_goes_on_to_the_same_bits(tmp_path, stop):
    changes = {"latent_steps": 0, "latent_dynamics_steps": 4, "latent_value_steps": 4, "latent_dynamics_batch": 8}
    whole, cut = trainer(tmp_path / "whole", **changes), trainer(tmp_path / "cut", **changes)
    for _ in range(whole.total):
        whole.update()
    for _ in range(stop):
        cut.update()
    cut.save()
    again = trainer(tmp_path / "cut", **changes)
    again.resume()
    while again.step < again.total:
        again.update()
    for (name, a), b in zip(whole.model.state_dict().items(), again.model.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_phases_have_their_updates_and_add_up(tmp_path):
    run = trainer(tmp_path, encoder_steps=1, joint_steps=2, latent_steps=1, latent_dynamics_steps=2, latent_value_steps=1)
    seen = []
    for _ in range(run.total):
        run.update()
        seen.append(run.phase)
    assert seen == ["encoder", "joint", "joint", "latent", "dynamics", "dynamics", "values"]
    assert run.total == 7 == sum(dataclasses.asdict(run.config.train)[name] for name in (
        "encoder_steps", "joint_steps", "latent_steps", "latent_dynamics_steps", "latent_value_steps", "clone_steps"))
