"""The search with provenance on the exact toy world, and the controller that walks every edge by its proposer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from toy_env import ACTION_SCALE, ToyEnv, ToyModel, draw, toy_config
from toy_world import GOAL, START, TIP, crosses_wall, geodesic, move, roots, row_generators, straight_to_goal, toy_fns
from velap.config.planning import PlannerConfig
from velap.methods.base import make_agent
from velap.methods.provenance import PATIENCE, ProvenanceAgent, proposers_of, search_of
from velap.methods.tree_agent import Actor
from velap.methods.velap import VelapAgent, VelapSettings
from velap.registry import PLANNERS
from velap.search import est
from velap.search.provenance import RISK, Provenance, plan

CONFIG = PlannerConfig(n_iter=400, n_sim=5, discard_low_exponent=10.0)


def search(start: tuple[float, float], risk: float = RISK, **changes: object) -> Provenance:
    return plan(toy_fns(**changes), torch.tensor([start]), CONFIG, row_generators(1), policies=[straight_to_goal], risk=risk)


def edges(found: Provenance) -> list[tuple[torch.Tensor, torch.Tensor, int]]:
    """Start, end and proposer of the edges of row 0's path."""
    length = int(found.length[0])
    way, who = found.waypoints[0, :length], found.proposers[0, :length].tolist()
    return [(way[i - 1], way[i], who[i]) for i in range(1, length)]


def test_the_policys_own_way_is_taken_where_it_leads_to_the_goal() -> None:
    found = search((1.0, -8.0))
    assert found.reached_goal.all()
    assert {who for _, _, who in edges(found)} == {1}
    assert len(edges(found)) <= 2
    assert not (search((1.0, -8.0), 0.0).proposers == 1).all(), "edges of g are shorter where they carry no risk"


def test_an_edge_of_the_policy_is_its_own_walk_of_n_sim_steps() -> None:
    found = search(START)
    walks = [(a, b) for a, b, who in edges(found) if who == 1]
    assert walks
    for a, b in walks:
        for _ in range(CONFIG.n_sim):
            a = move(a, straight_to_goal(a))
        torch.testing.assert_close(a, b)


def test_g_leads_around_the_wall_that_stops_the_policy() -> None:
    found = search(START)
    assert found.reached_goal.all()
    assert geodesic(found.waypoints[0, int(found.length[0]) - 1], torch.tensor(GOAL)) < 6
    assert all(not crosses_wall(a, b) for a, b, _ in edges(found))
    assert 0 in {who for _, _, who in edges(found)}


def test_a_walk_through_the_wall_is_refused_where_the_local_critic_knows_a_longer_way() -> None:
    leaks = search((-1.0, -8.0), step=lambda z, action: z + 0.97 * action)
    tree = leaks.tree
    size = int(tree.size[0])
    walked = geodesic(tree.latents[0, tree.parents[0, 1:size]], tree.latents[0, 1:size])
    assert size > 10
    assert walked.max() < CONFIG.discard_low_exponent, f"the way round the tip at {TIP} is longer than τ_low"


def test_an_edge_costs_n_sim_steps_by_the_policy_and_its_distance_by_g() -> None:
    found = search(START)
    tree = found.tree
    for (a, b, who), slot, before in zip(edges(found), found.nodes[0, 1:].tolist(), found.nodes[0].tolist(), strict=False):
        cost = float(tree.root_steps[0, slot] - tree.root_steps[0, before])
        assert cost == pytest.approx(CONFIG.n_sim if who == 1 else float(geodesic(a, b)), abs=1e-3)
    by_g = found.proposers[0, : int(found.length[0])].tolist().count(0) - 1  # the root has no edge
    assert float(found.cost[0]) == pytest.approx(float(tree.root_steps[0, found.nodes[0, -1]]) + 30.0 * by_g, abs=1e-3)


def test_a_row_is_planned_by_its_own_generator_alone() -> None:
    z_root, fns, risk = roots(3, spread=3.0), toy_fns(), 30.0
    together = plan(fns, z_root, CONFIG, row_generators(3, 5), policies=[straight_to_goal], risk=risk)
    for row in range(3):
        alone = plan(fns, z_root[row : row + 1], CONFIG, row_generators(1, 5 + row), policies=[straight_to_goal], risk=risk)
        length = int(alone.length[0])
        assert int(together.length[row]) == length
        torch.testing.assert_close(alone.waypoints[0, :length], together.waypoints[row, :length])
        assert alone.proposers[0, :length].tolist() == together.proposers[row, :length].tolist()


def frames_at(*positions: tuple[float, float]) -> np.ndarray:
    return np.stack([np.stack([draw(np.array(position))] * 2) for position in positions])


def set_plan(agent: ProvenanceAgent, waypoints: list[tuple[float, float]], proposers: list[int],
             promised: list[float]) -> None:
    """Let row 0 follow this plan, its root first."""
    made = replace(search(START), waypoints=torch.tensor([waypoints]), length=torch.tensor([len(waypoints)]),
                   proposers=torch.tensor([proposers]), steps_to_goal=torch.tensor([promised]))
    agent.follow(torch.tensor([0]), made)


def new_agent(**changes: object) -> ProvenanceAgent:
    agent = ProvenanceAgent(ToyModel(**changes), toy_config(provenance=True))
    agent.reset(np.ones(1, bool), np.array([0]))
    return agent


def test_every_edge_is_walked_by_its_proposer() -> None:
    agent = new_agent()
    set_plan(agent, [START, (-6.0, 5.0)], [0, 0], [12.0, 13.0])
    by_g = agent.act(frames_at(START))[0]
    assert by_g[1] > 0.8 * ACTION_SCALE, "an edge of g is walked to its waypoint, which is above"
    assert agent.by_plan.all() and agent.last_actors == [Actor.LOCAL]
    agent = new_agent()
    set_plan(agent, [START, (-6.0, 5.0)], [0, 1], [12.0, 7.0])
    np.testing.assert_allclose(agent.act(frames_at(START))[0], [ACTION_SCALE, 0.0], atol=0.03)
    assert agent.by_plan.all() and agent.last_actors == [Actor.POLICY]
    agent = new_agent(act_success=lambda z: z.new_tensor([0.0, -1.0]).expand_as(z))
    set_plan(agent, [START, (-6.0, 5.0)], [0, 2], [12.0, 7.0])
    np.testing.assert_allclose(agent.act(frames_at(START))[0], [0.0, -ACTION_SCALE], atol=0.03)
    assert agent.by_plan.all() and agent.last_actors == [Actor.CLONE]


def test_a_promise_that_does_not_come_true_ends_the_plan() -> None:
    agent = new_agent()
    set_plan(agent, [START, (0.0, 0.0), (5.0, 0.0)], [0, 1, 1], [12.0, 6.0, 1.0])
    planned, n_sim = [], toy_config().planner.n_sim
    for _ in range(n_sim + 2):  # the block stands still
        agent.act(frames_at(START))
        planned.append(bool(np.isfinite(agent.last_plan_ms).any()))
    assert planned.index(True) == n_sim - 1, "it plans again after the n_sim steps that the edge had"


def test_near_the_goal_the_global_policy_acts_and_nothing_is_planned() -> None:
    agent = new_agent()
    np.testing.assert_allclose(agent.act(frames_at((2.0, 0.0)))[0], [ACTION_SCALE, 0.0], atol=0.03)
    assert not np.isfinite(agent.last_plan_ms).any()
    assert agent.near_goal.all() and not agent.by_plan.any() and agent.last_actors == [Actor.GOAL]


def test_where_the_tree_is_its_root_alone_the_global_policy_acts_and_no_plan_is_followed() -> None:
    agent = new_agent(step=lambda z, action: z)
    np.testing.assert_allclose(agent.act(frames_at(START))[0], [ACTION_SCALE, 0.0], atol=0.03)
    assert agent.plans.length.tolist() == [1]
    assert not agent.by_plan.any() and agent.last_actors == [Actor.NOWHERE]


def test_an_edge_of_g_that_is_not_walked_in_time_ends_the_plan() -> None:
    agent = new_agent()
    set_plan(agent, [START, (-6.0, 8.0), (0.0, 8.0)], [0, 0, 0], [12.0, 14.0, 10.0])
    planned, patience = [], PATIENCE * toy_config().planner.n_sim
    for _ in range(patience + 2):  # the block stands still
        agent.act(frames_at(START))
        planned.append(bool(np.isfinite(agent.last_plan_ms).any()))
    assert planned.index(True) == patience - 1


@pytest.mark.parametrize(("rates", "expected"), [
    ((0.4, 0.9), [Actor.CLONE]), ((0.9, 0.4), [Actor.POLICY]), ((0.0, 0.0), [Actor.POLICY, Actor.CLONE])])
def test_who_gets_to_the_goal_more_often_by_h_proposes(rates: tuple[float, float], expected: list[Actor]) -> None:
    fns = toy_fns(act_success=straight_to_goal, arrival_rates=rates)
    assert [each.actor for each in proposers_of(fns)] == expected
    assert [each.actor for each in proposers_of(fns._replace(act_success=None))] == [Actor.POLICY]


@pytest.mark.parametrize(("share", "kind"), [(0.039, VelapAgent), (0.04, ProvenanceAgent)])
def test_where_the_config_leaves_it_open_the_share_of_successes_in_the_data_decides(share: float, kind: type) -> None:
    model, config = ToyModel(success_share=share), toy_config(provenance=None)
    agent = make_agent("velap", model, config, ToyEnv().action_space)  # type: ignore[arg-type]
    assert type(agent) is kind
    found = search_of(model, config)(roots(1), row_generators(1))  # type: ignore[arg-type]
    assert isinstance(found, Provenance) == (kind is ProvenanceAgent)


def test_the_config_and_the_planner_decide_which_agent_acts(monkeypatch: pytest.MonkeyPatch) -> None:
    model, space = ToyModel(), ToyEnv().action_space
    kinds = {provenance: type(make_agent("velap", model, toy_config(provenance=provenance), space))  # type: ignore[arg-type]
             for provenance in (True, False)}
    assert kinds == {True: ProvenanceAgent, False: VelapAgent}
    monkeypatch.setitem(PLANNERS, "mine", est.plan)
    agent = make_agent("velap", model, toy_config(provenance=True), space,  # type: ignore[arg-type]
                       settings=VelapSettings("mine"))
    assert type(agent) is VelapAgent, "another planner's waypoints are followed by Algorithm 2"
