"""Reactive agents, and Algorithm 2 step by step on the exact toy world; what agents share is in test_agents_conformance."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch

from toy_env import ACTION_SCALE, SIDE, ToyEnv, ToyModel, draw, toy_config
from toy_world import START
from velap.config import override
from velap.errors import ConfigError
from velap.methods.base import make_agent
from velap.methods.velap import VelapAgent


def frames_at(*positions: tuple[float, float]) -> np.ndarray:
    """Stacked frames [B, 2, SIDE, SIDE, 3] of blocks at rest."""
    return np.stack([np.stack([draw(np.array(position))] * 2) for position in positions])


def test_random_actions_fill_the_box() -> None:
    agent = make_agent("random", None, toy_config(), ToyEnv().action_space)
    agent.reset(np.ones(1, bool), np.array([0]))
    actions = np.concatenate([agent.act(frames_at(START)) for _ in range(500)])
    assert np.abs(actions.mean(0)).max() < 0.2
    assert actions.max() > 0.95 * ACTION_SCALE
    assert actions.min() < -0.95 * ACTION_SCALE


def test_uniform_actions_without_bounds_are_refused() -> None:
    space = gym.spaces.Box(np.array([-1.0, -np.inf], np.float32), np.array([1.0, np.inf], np.float32))
    with pytest.raises(ConfigError, match="uniform actions need bounds"):
        make_agent("random", None, toy_config(), space)


def test_td3bc_follows_the_global_policy_in_env_units() -> None:
    agent = make_agent("td3bc", ToyModel(), toy_config(), ToyEnv().action_space)
    np.testing.assert_allclose(agent.act(frames_at(START)), [[ACTION_SCALE, 0.0]], atol=0.02)


def planned(agent: VelapAgent, *positions: tuple[float, float]) -> list[int]:
    """Rows that plan when the blocks are at `positions`."""
    agent.act(frames_at(*positions))
    rows = agent.planned_rows.tolist()
    assert np.flatnonzero(np.isfinite(agent.last_plan_ms)).tolist() == rows
    return rows


def test_rows_replan_at_their_own_times() -> None:
    agent = VelapAgent(ToyModel(), toy_config(n_iter=20))
    agent.reset(np.ones(2, bool), np.array([0, 1]))
    assert planned(agent, START, START) == [0, 1]
    for _ in range(3):
        assert planned(agent, START, START) == []
    agent.reset(np.array([False, True]), np.array([0, 3]))
    assert len(agent.plans.ahead(1)) == 0
    assert planned(agent, START, START) == [1]
    for _ in range(5):
        assert planned(agent, START, START) == []
    assert planned(agent, START, START) == [0]
    for _ in range(3):
        assert planned(agent, START, START) == []
    assert planned(agent, START, START) == [1]


def test_near_the_goal_the_global_policy_acts_and_nothing_is_planned() -> None:
    agent = VelapAgent(ToyModel(), toy_config())
    stop = 5.0
    near, far = (6.0 - stop + 0.2, 0.0), (6.0 - stop - 0.3, 0.0)
    agent.reset(np.ones(2, bool), np.array([0, 1]))
    assert planned(agent, near, far) == [1]
    np.testing.assert_allclose(agent.act(frames_at(near, far))[0], [ACTION_SCALE, 0.0], atol=0.03)
    assert len(agent.plans.ahead(0)) == 0
    assert planned(agent, far, far) == [0], "a row that leaves the goal's surroundings without a plan plans at once"


def set_plan(agent: VelapAgent, waypoints: list[tuple[float, float]]) -> None:
    """Give row 0 this plan, its root first."""
    agent.plans.store(torch.tensor([0]), torch.tensor([waypoints], dtype=torch.float64), torch.tensor([len(waypoints)]))


def test_waypoints_are_passed_when_reached_several_at_once() -> None:
    agent = VelapAgent(ToyModel(), toy_config(n_iter=20))
    agent.reset(np.ones(1, bool), np.array([0]))
    agent.act(frames_at(START))
    with torch.inference_mode():
        set_plan(agent, [START, (-5.0, 0.0), (-4.0, 0.0), (-4.0, 5.0), (-4.0, 9.0)])
    assert agent.plans.ahead(0)[0].tolist() == [-5.0, 0.0]

    action = agent.act(frames_at(START))
    # (-5, 0) is 1 step away and (-4, 0) is 2, both within 3 steps; (-4, 5) is 5.4
    assert agent.plans.ahead(0).tolist() == [[-4.0, 5.0], [-4.0, 9.0]]
    towards = np.array([2.0, 5.0]) / np.linalg.norm([2.0, 5.0])
    np.testing.assert_allclose(action[0], ACTION_SCALE * towards, atol=0.03)

    agent.act(frames_at((-4.0, 1.7)))
    assert len(agent.plans.ahead(0)) == 2, "3.3 steps away: not yet"
    agent.act(frames_at((-4.0, 2.3)))
    assert len(agent.plans.ahead(0)) == 1
    agent.act(frames_at((-4.0, 9.0)))
    assert agent.plans.ahead(0).tolist() == [[-4.0, 9.0]], "the last waypoint stays"


def snapping(**changes: object) -> ToyModel:
    """A model whose search snaps, to where its candidates are."""
    return ToyModel(snaps=True, project=lambda z: (z, z.new_zeros(z.shape[:-1])), **changes)


@pytest.mark.parametrize(("anchor", "gets_there"), [("none", False), ("auto", True)])
def test_lookahead_leaves_a_wall_that_the_local_policy_pushes_into(anchor: str, gets_there: bool) -> None:
    model = snapping()
    model.act_local = lambda latent, goal: (goal - latent) / (goal - latent).norm(dim=-1, keepdim=True)  # blind to the wall
    agent = VelapAgent(model, override(toy_config(n_iter=1, anchor=anchor), controller={"n_replan": 100}))
    env = ToyEnv()
    env.reset(seed=0)
    env.set_agent_position(np.array([-0.5, 3.0]))
    # no rounding to pixels beside the wall
    model.encode = lambda frames, commands=None, state=None: torch.from_numpy(env.agent_position())[None]
    agent.act(frames_at((-0.5, 3.0)))
    with torch.inference_mode():
        set_plan(agent, [(-0.5, 3.0), (3.0, 9.0)])
    for _ in range(20):
        env.step(agent.act(frames_at(tuple(env.agent_position())))[0])
    assert (env.agent_position()[0] > 0) == gets_there


@pytest.mark.parametrize(("anchor", "snaps", "strength"), [
    ("none", True, 0.3), ("auto", False, 0.3), ("auto", True, 0.6), ("snap", False, 0.6)])
def test_where_the_search_snaps_a_stronger_action_wins_that_comes_nearer(anchor: str, snaps: bool, strength: float) -> None:
    model = snapping(propose=lambda z, noise: torch.zeros_like(z))
    model._fns = model._fns._replace(snaps=snaps)
    model.act_local = lambda latent, goal: 0.3 * (goal - latent) / (goal - latent).norm(dim=-1, keepdim=True)
    agent = VelapAgent(model, override(toy_config(n_iter=1, anchor=anchor), controller={"n_replan": 100}))
    agent.act(frames_at(START))
    with torch.inference_mode():
        set_plan(agent, [START, (START[0], START[1] + 9.0)])
    np.testing.assert_allclose(agent.act(frames_at(START))[0], [0.0, ACTION_SCALE * strength], atol=0.03)


def test_plan_of_the_root_alone_leaves_it_to_the_global_policy() -> None:
    nowhere = ToyModel(step=lambda z, a: z)
    agent = VelapAgent(nowhere, toy_config(n_iter=20))
    action = agent.act(frames_at(START))
    assert agent.last_plan is not None
    assert agent.last_plan.length.tolist() == [1]
    np.testing.assert_allclose(action[0], [ACTION_SCALE, 0.0], atol=0.03)


def test_a_row_does_not_depend_on_the_batch_it_is_in() -> None:
    alone, together = VelapAgent(ToyModel(), toy_config()), VelapAgent(ToyModel(), toy_config())
    alone.reset(np.ones(1, bool), np.array([4]))
    together.reset(np.ones(3, bool), np.array([11, 4, 12]))
    single = alone.act(frames_at(START))
    several = together.act(frames_at((-3.0, -3.0), START, (5.0, 8.0)))
    np.testing.assert_allclose(several[1], single[0], rtol=1e-6)
    torch.testing.assert_close(together.plans.ahead(1), alone.plans.ahead(0))


def test_frames_are_encoded_once_a_step() -> None:
    model = ToyModel()
    agent = VelapAgent(model, toy_config(n_iter=20))
    for _ in range(3):
        agent.act(frames_at(START, START))
    assert model.encoded_batches == [2, 2, 2]
    assert frames_at(START).shape == (1, 2, SIDE, SIDE, 3)
