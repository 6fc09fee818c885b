"""MPPI and MBOP: their updates against numbers by hand; on the toy world they reach what lies ahead and nothing else."""

from __future__ import annotations

import math

import pytest
import torch

from toy_world import DISCOUNT, GOAL, SPEED, START, misleading_value, move, roots, row_generators, toy_fns
from velap.errors import ConfigError
from velap.methods import mbop
from velap.methods.mbop import MBOPConfig, mixed_rollouts
from velap.methods.mppi import MPPIConfig, shoot
from velap.search.shooting import choose_elites, score, shift_mean
from velap.search.types import SearchFns

SMALL = MPPIConfig(samples=200, horizon=12, elites=20, iterations=4, policy_share=0.0)


def execute(z: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    for step in range(actions.shape[1]):
        z = move(z, actions[:, step])
    return z


def test_defaults_are_those_of_the_paper() -> None:
    cfg = MPPIConfig()
    assert (cfg.samples, cfg.horizon, cfg.elites, cfg.iterations) == (1000, 50, 64, 5)


def test_reaches_a_goal_without_a_wall_between() -> None:
    z_root = torch.tensor([[1.0, -4.0], [3.0, 7.0], [9.0, 2.0]], dtype=torch.float64)
    shot = shoot(toy_fns(), z_root, SMALL, row_generators(3))
    assert shot.actions.shape == (3, 12, 2)
    assert shot.actions.abs().max() <= 1
    for actions in (shot.actions, shot.mean):
        assert (execute(z_root, actions) - z_root.new_tensor(GOAL)).norm(dim=-1).max() < 1.5
    assert (shot.score > score(toy_fns(), z_root[:, None], torch.zeros(3, 1, 12, 2).double())[:, 0] + 1).all()


def test_is_stuck_behind_the_wall_where_the_tree_is_not() -> None:
    cfg = MPPIConfig(samples=200, horizon=20, elites=20, iterations=4)
    shot = shoot(toy_fns(), roots(2), cfg, row_generators(2))
    assert (execute(roots(2), shot.actions)[:, 0] < 0).all()


def test_score_is_the_sum_of_q_along_the_way() -> None:
    z = torch.tensor([[[2.0, 0.0]]], dtype=torch.float64)
    actions = torch.tensor([[[[1.0, 0.0], [1.0, 0.0]], [[0.0, 0.0], [-1.0, 0.0]]]], dtype=torch.float64)
    first = DISCOUNT ** (4 + 1 - SPEED)
    expected = [[first + DISCOUNT ** (5 - 2 * SPEED), DISCOUNT**5 + DISCOUNT ** (5 + SPEED)]]
    torch.testing.assert_close(score(toy_fns(), z, actions), torch.tensor(expected, dtype=torch.float64))


def test_a_goal_that_ends_keeps_the_highest_value_met() -> None:
    z = torch.tensor([[[2.0]]], dtype=torch.float64)
    actions = torch.tensor([[[[1.0], [-2.0], [0.5]], [[-1.0], [0.0], [3.0]]]], dtype=torch.float64)
    assert score(line(), z, actions).tolist() == [[3.0 + 1.0 + 1.5, 1.0 + 1.0 + 4.0]]
    assert score(line(), z, actions, goal_ends=True).tolist() == [[3.0 + 3.0 + 3.0, 1.0 + 1.0 + 4.0]]
    below = torch.tensor([[[-5.0]]], dtype=torch.float64)
    assert score(line(), below, actions, goal_ends=True).tolist() == [[-4.0 - 4.0 - 4.0, -6.0 - 6.0 - 3.0]]


def test_more_iterations_give_better_scores() -> None:
    z_root = torch.tensor([[9.0, -9.0]], dtype=torch.float64)
    first, last = (shoot(toy_fns(), z_root, MPPIConfig(samples=100, horizon=15, elites=10, iterations=n, policy_share=0.0),
                         row_generators(1)).score for n in (1, 6))
    assert last > first + 0.1


def test_policy_trajectories_are_among_the_samples() -> None:
    seen: list[int] = []

    def counted(z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        seen.append(action.shape[1])
        return misleading_value(z)

    cfg = MPPIConfig(samples=40, horizon=3, elites=4, iterations=2, policy_share=0.25)
    shoot(toy_fns(q=counted), roots(1), cfg, row_generators(1))
    assert seen == [40] * 6
    all_policy = MPPIConfig(samples=40, horizon=8, elites=4, iterations=1, policy_share=1.0, policy_std=0.0)
    ahead = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    shot = shoot(toy_fns(), ahead, all_policy, row_generators(1))
    torch.testing.assert_close(execute(ahead, shot.actions), ahead.new_tensor([GOAL]), atol=1e-4, rtol=0)


def test_the_previous_mean_is_taken_up_and_shifts() -> None:
    mean = torch.arange(6.0).view(1, 3, 2)
    assert shift_mean(mean, 1).tolist() == [[[2, 3], [4, 5], [0, 0]]]
    assert shift_mean(mean, 5).tolist() == [[[0, 0]] * 3]
    cfg = MPPIConfig(samples=20, horizon=12, elites=5, iterations=1, policy_share=0.0, std_max=0.05)
    z_root = torch.tensor([[9.0, -9.0]], dtype=torch.float64)
    good = shoot(toy_fns(), z_root, SMALL, row_generators(1)).mean
    warm, cold = (shoot(toy_fns(), z_root, cfg, row_generators(1), previous) for previous in (good, None))
    assert warm.score > cold.score + 0.5


def line(**changes: object) -> SearchFns:
    """A world of one dimension: h adds the action, Q^g(z, a) = z + a, π^g(z) = 0.5 + z."""
    return toy_fns(step=lambda z, action: z + action, q=lambda z, action: (z + action)[..., 0],
                   act_global=lambda z: 0.5 + z, **changes)


def test_elites_weights_and_moments_by_hand() -> None:
    actions = torch.tensor([0.1, 0.5, -0.3, 0.9], dtype=torch.float64).view(1, 4, 1, 1)
    scores = torch.tensor([[1.0, 3.0, 2.0, 0.0]], dtype=torch.float64)
    elites = choose_elites(actions, scores, MPPIConfig(samples=4, elites=2, temperature=0.5))
    assert elites.actions.flatten().tolist() == [0.5, -0.3]
    assert elites.scores.tolist() == [[3.0, 2.0]]
    first = math.exp(1.5) / (math.exp(1.5) + math.exp(1.0))
    assert first == pytest.approx(0.622459331)
    assert elites.weights.tolist() == [pytest.approx([first, 1 - first])]
    assert elites.mean().item() == pytest.approx(0.622459331 * 0.5 - 0.377540669 * 0.3)
    assert elites.std().item() == pytest.approx(0.8 * math.sqrt(0.622459331 * 0.377540669))


def test_an_iteration_of_mppi_is_that_of_td_mpc() -> None:
    """Two iterations on numbers that the generator gives, everything else in plain Python."""
    cfg = MPPIConfig(samples=3, horizon=2, elites=2, iterations=2, temperature=1.5, momentum=0.25, policy_share=0.0,
                     std_max=0.5, std_min=0.1)
    numbers = torch.randn(2, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).tolist()
    mean, std = [0.2, -0.1], [0.5, 0.5]
    best: list[tuple[float, list[float]]] = []
    for draws in numbers:
        samples = [[min(max(mean[t] + std[t] * draw[t], -1.0), 1.0) for t in (0, 1)] for draw in draws]
        best = sorted(((2 * a[0] + a[1], a) for a in samples), reverse=True)[:2]  # Q(0, a_0) + Q(a_0, a_1)
        powers = [math.exp(1.5 * (total - best[0][0])) for total, _ in best]
        weighted = [(power / sum(powers), a) for power, (_, a) in zip(powers, best, strict=True)]
        centre = [sum(w * a[t] for w, a in weighted) for t in (0, 1)]
        spread = [math.sqrt(sum(w * (a[t] - centre[t]) ** 2 for w, a in weighted)) for t in (0, 1)]
        std = [min(max(value, 0.1), 0.5) for value in spread]
        mean = [0.25 * mean[t] + 0.75 * centre[t] for t in (0, 1)]
    before = torch.tensor([[[0.2], [-0.1]]], dtype=torch.float64)
    root = torch.zeros(1, 1, dtype=torch.float64)
    shot = shoot(line(), root, cfg, torch.Generator().manual_seed(0), before)
    assert shot.mean.flatten().tolist() == pytest.approx(mean)
    assert shot.score.item() == pytest.approx(best[0][0])
    assert any(shot.actions.flatten().tolist() == pytest.approx(a) for _, a in best)


def test_the_mixture_of_mbop_by_hand() -> None:
    plan = torch.tensor([[[0.2], [-0.4]]], dtype=torch.float64)
    noise = torch.tensor([[[[0.1], [0.0]], [[-0.1], [0.3]]]], dtype=torch.float64)
    actions, scores = mixed_rollouts(line(), torch.zeros(1, 1, 1, dtype=torch.float64), plan, noise, MBOPConfig())
    # 0.3 (0.5 + 0.1) + 0.7 · 0.2 = 0.32; then π^g(0.32) = 0.82: 0.3 · 0.82 - 0.28 = -0.034; Q: 0.32 + 0.286
    # 0.3 (0.5 - 0.1) + 0.7 · 0.2 = 0.26; then π^g(0.26) = 0.76: 0.3 · 1.06 - 0.28 = 0.038; Q: 0.26 + 0.298
    assert actions.flatten().tolist() == pytest.approx([0.32, -0.034, 0.26, 0.038])
    assert scores.flatten().tolist() == pytest.approx([0.606, 0.558])
    again = score(line(), torch.zeros(1, 1, 1, dtype=torch.float64), actions)
    torch.testing.assert_close(scores, again)
    _, kept = mixed_rollouts(line(), torch.zeros(1, 1, 1, dtype=torch.float64), plan, noise, MBOPConfig(goal_ends=True))
    assert kept.flatten().tolist() == pytest.approx([0.32 + 0.32, 0.26 + 0.298])
    elites = choose_elites(actions, scores, MBOPConfig(samples=2, elites=2, temperature=2.0))
    first = 1 / (1 + math.exp(-2.0 * 0.048))
    assert elites.mean().flatten().tolist() == pytest.approx(
        [first * 0.32 + (1 - first) * 0.26, first * -0.034 + (1 - first) * 0.038])


def test_each_iteration_of_mbop_mixes_with_the_plan_before() -> None:
    always = line()._replace(act_global=lambda z: torch.ones_like(z))
    cfg = MBOPConfig(samples=4, horizon=3, elites=2, iterations=5, beta=0.7, noise_std=0.0)
    root = torch.zeros(1, 1, dtype=torch.float64)
    shot = mbop.shoot(always, root, cfg, row_generators(1))
    assert shot.actions.flatten().tolist() == pytest.approx([1 - 0.7**5] * 3)
    warm = mbop.shoot(always, root, cfg, row_generators(1), torch.full((1, 3, 1), 0.5, dtype=torch.float64))
    assert warm.actions.flatten().tolist() == pytest.approx([1 - 0.5 * 0.7**5] * 3)


def test_mbop_follows_its_policy_to_the_goal_or_into_the_wall() -> None:
    cfg = MBOPConfig(samples=50, horizon=14, elites=8, iterations=5)
    z_root = torch.tensor([[1.0, -4.0], [3.0, 7.0], [9.0, 2.0], START], dtype=torch.float64)
    shot = mbop.shoot(toy_fns(), z_root, cfg, row_generators(4))
    assert shot.actions.shape == (4, 14, 2)
    assert shot.actions.abs().max() <= 1
    ends = execute(z_root, shot.actions)
    assert (ends[:3] - z_root.new_tensor(GOAL)).norm(dim=-1).max() < 1.0
    assert ends[3, 0] < 0


@pytest.mark.parametrize("shooter", [shoot, mbop.shoot])
def test_rows_of_both_are_independent(shooter) -> None:
    cfg = SMALL if shooter is shoot else MBOPConfig(samples=20, horizon=4, elites=4, iterations=2)
    z_root = roots(3, spread=3.0)
    together = shooter(toy_fns(), z_root, cfg, row_generators(3))
    for row in range(3):
        alone = shooter(toy_fns(), z_root[row : row + 1], cfg, row_generators(3)[row : row + 1])
        torch.testing.assert_close(alone.actions[0], together.actions[row])
        torch.testing.assert_close(alone.mean[0], together.mean[row])


@pytest.mark.parametrize("changes", [{"beta": 1.0}, {"noise_std": -0.1}, {"elites": 1001}, {"replan_every": 0},
                                     {"arithmetic": "float16"}])
def test_mbop_values_out_of_range_are_named(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"MBOP field `{next(iter(changes))}`"):
        MBOPConfig(**changes)


@pytest.mark.parametrize("changes", [{"elites": 0}, {"elites": 2000}, {"horizon": 0}, {"momentum": 1.0}, {"std_min": 3.0}])
def test_values_out_of_range_are_named(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"MPPI field `{next(iter(changes))}`"):
        MPPIConfig(**changes)
