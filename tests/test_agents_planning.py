"""MPC and IRIS agents on the exact toy world: what they execute, when they plan anew, and what each can solve."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from toy_env import ACTION_SCALE, ToyEnv, ToyModel, draw
from toy_world import DISCOUNT, GOAL, START, geodesic, move, roots, unit
from velap.errors import ConfigError
from velap.methods import mbop, mppi
from velap.methods.iris import MULTISTEP_IRIS, IRISAgent, IRISConfig, choose_subgoal
from velap.methods.mbop import MBOPConfig
from velap.methods.mpc import MPCAgent
from velap.methods.mppi import MPPIConfig
from velap.methods.planning import PlanningAgent
from velap.search.shooting import Shot

MPPI = MPPIConfig(samples=120, horizon=12, elites=16, iterations=4)
MBOP = MBOPConfig(samples=40, horizon=12, elites=8)
SHOOTERS = {"mppi": (MPPI, mppi.shoot), "mbop": (MBOP, mbop.shoot)}
AHEAD = (1.0, -4.0)
"""On the goal's side of the wall."""


def frames_at(*positions: tuple[float, float]) -> np.ndarray:
    """Stacked frames [B, 2, SIDE, SIDE, 3] of blocks at rest."""
    return np.stack([np.stack([draw(np.array(position))] * 2) for position in positions])


def exact_value(z: Tensor) -> Tensor:
    """γ^(shortest way to the goal) [*]: unlike the toy world's own value it knows of the wall."""
    return DISCOUNT ** geodesic(z, z.new_tensor(GOAL).expand_as(z))


def solves(agent: PlanningAgent, start: tuple[float, float], limit: int = 45) -> bool:
    """Whether the agent comes to within 1 of the goal in `limit` steps."""
    env = ToyEnv()
    env.reset(seed=0)
    env.set_agent_position(np.array(start))
    agent.reset(np.ones(1, bool), np.array([3]))
    return any(env.step(agent.act(frames_at(tuple(env.agent_position())))[0])[2] for _ in range(limit))


@pytest.mark.parametrize("method", SHOOTERS)
def test_shooting_solves_what_its_value_sees_and_stops_at_the_wall(method: str) -> None:
    assert solves(MPCAgent(method, ToyModel(), *SHOOTERS[method]), AHEAD)
    assert not solves(MPCAgent(method, ToyModel(), *SHOOTERS[method]), START)


def test_mppi_finds_a_way_that_its_policy_does_not_know() -> None:
    knowing = ToyModel(value=exact_value, q=lambda z, a: DISCOUNT * exact_value(move(z, a)))
    assert solves(MPCAgent("mppi", knowing, MPPI, mppi.shoot), START)


@pytest.mark.parametrize("method", SHOOTERS)
def test_five_actions_are_executed_and_the_next_plan_starts_from_the_shifted_mean(method: str) -> None:
    shots: list[Shot] = []
    previous: list[Tensor] = []
    planner, shoot = SHOOTERS[method]

    def spy(fns: object, latents: Tensor, cfg: object, generators: object, before: Tensor) -> Shot:
        previous.append(before.clone())
        shots.append(shoot(fns, latents, cfg, generators, before))  # type: ignore[operator]
        return shots[-1]

    agent = MPCAgent(method, ToyModel(), planner, spy)
    agent.reset(np.ones(2, bool), np.array([1, 2]))
    actions = np.stack([agent.act(frames_at(AHEAD, START)) for _ in range(10)])
    assert len(shots) == 4, "two rows planned one after the other, twice"
    for row in (0, 1):
        for plan, start in ((shots[row], 0), (shots[2 + row], 5)):
            expected = ACTION_SCALE * plan.actions[0, :5].numpy()
            np.testing.assert_allclose(actions[start : start + 5, row], expected, rtol=1e-6)
        assert not previous[row].any(), "the first plan of an episode starts from zeros"
        assert torch.equal(previous[2 + row][0, :-5], shots[row].mean[0, 5:])
        assert not previous[2 + row][0, -5:].any()
    agent.reset(np.array([True, False]), np.array([7, 7]))
    agent.act(frames_at(AHEAD, START))
    assert not previous[4].any(), "a new episode forgets the mean"
    assert previous[5].any()


def test_actions_beyond_the_plan_are_refused() -> None:
    with pytest.raises(ConfigError, match="as long as what is executed"):
        MPCAgent("mppi", ToyModel(), MPPIConfig(horizon=3, replan_every=4), mppi.shoot)


def test_the_best_candidate_wins_and_a_rollout_counts_by_the_best_that_it_meets() -> None:
    def propose(z: Tensor, noise: Tensor) -> Tensor:
        return z + noise

    def value(z: Tensor) -> Tensor:
        return -(z[..., 0] - 2).abs()

    latents = torch.tensor([[0.0], [10.0]])
    noise = torch.tensor([[[[0.5], [0.0]], [[1.5], [9.0]], [[-1.0], [2.9]]],
                          [[[-1.0], [-6.9]], [[-4.0], [1.0]], [[3.0], [-2.0]]]])
    assert choose_subgoal(propose, value, latents, noise[:, :, :1]).tolist() == [[1.5], [6.0]]
    # Values along the rollouts: 0.5, 0.5 | 1.5, 10.5 | -1, 1.9: the last comes closest to 2; 9, 2.1 | 6, 7 | 13, 11.
    assert choose_subgoal(propose, value, latents, noise).tolist() == [[-1.0], [9.0]]


class ToyManager:
    """Subgoals `horizon` steps away in any direction, walls respected, and a worker that knows the shortest way."""

    method, settings, weights_sha256, noise_dim, horizon = "iris", "{}", "", 2, 5

    def __init__(self) -> None:
        self.act = ToyModel().act_local

    def propose(self, latent: Tensor, noise: Tensor) -> Tensor:
        for _ in range(self.horizon):
            latent = move(latent, unit(noise))
        return latent


def iris(settings: IRISConfig, **changes: object) -> IRISAgent:
    return IRISAgent("iris", ToyModel(**changes), ToyManager(), settings)  # type: ignore[arg-type]


def test_iris_climbs_its_value_and_stops_where_it_misleads() -> None:
    assert solves(iris(IRISConfig(samples=64)), AHEAD)
    assert solves(iris(IRISConfig(samples=64), value=exact_value), START)
    assert not solves(iris(IRISConfig(samples=64)), START)


def test_many_subgoals_ahead_see_around_the_wall() -> None:
    before_the_wall = (-1.0, 2.0)
    assert solves(iris(MULTISTEP_IRIS), before_the_wall, limit=120)
    assert not solves(iris(IRISConfig()), before_the_wall, limit=120)


def test_a_subgoal_is_kept_for_the_managers_horizon() -> None:
    agent = iris(IRISConfig(samples=16))
    agent.reset(np.ones(2, bool), np.array([0, 1]))
    goals = []
    for _ in range(11):
        agent.act(frames_at(START, AHEAD))
        goals.append(torch.stack([agent.subgoal(0), agent.subgoal(1)]))
    changed = [not torch.equal(one, next_) for one, next_ in pairwise(goals)]
    assert changed == [False, False, False, False, True] * 2
    offsets = goals[0] - roots(1)[0].new_tensor([START, AHEAD])
    assert offsets.norm(dim=-1).max() < 5
