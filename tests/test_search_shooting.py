"""MPPI on the toy world: it reaches what lies ahead, its elites improve, its rows are independent."""

from __future__ import annotations

import pytest
import torch

from toy_world import DISCOUNT, GOAL, SPEED, misleading_value, move, roots, row_generators, toy_fns
from velap.errors import ConfigError
from velap.search.shooting import MPPIConfig, score, shift_mean, shoot

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


def test_rows_do_not_depend_on_each_other() -> None:
    z_root = roots(3, spread=3.0)
    together = shoot(toy_fns(), z_root, SMALL, row_generators(3))
    for row in range(3):
        alone = shoot(toy_fns(), z_root[row : row + 1], SMALL, row_generators(3)[row : row + 1])
        torch.testing.assert_close(alone.actions[0], together.actions[row])
        torch.testing.assert_close(alone.mean[0], together.mean[row])


def test_the_previous_mean_is_taken_up_and_shifts() -> None:
    mean = torch.arange(6.0).view(1, 3, 2)
    assert shift_mean(mean, 1).tolist() == [[[2, 3], [4, 5], [0, 0]]]
    assert shift_mean(mean, 5).tolist() == [[[0, 0]] * 3]
    cfg = MPPIConfig(samples=20, horizon=12, elites=5, iterations=1, policy_share=0.0, std_max=0.05)
    z_root = torch.tensor([[9.0, -9.0]], dtype=torch.float64)
    good = shoot(toy_fns(), z_root, SMALL, row_generators(1)).mean
    warm, cold = (shoot(toy_fns(), z_root, cfg, row_generators(1), previous) for previous in (good, None))
    assert warm.score > cold.score + 0.5


@pytest.mark.parametrize("changes", [{"elites": 0}, {"elites": 2000}, {"horizon": 0}, {"momentum": 1.0}, {"std_min": 3.0}])
def test_values_out_of_range_are_named(changes: dict[str, float]) -> None:
    with pytest.raises(ConfigError, match=f"MPPI field `{next(iter(changes))}`"):
        MPPIConfig(**changes)
