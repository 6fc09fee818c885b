"""Rehearsed plans in the toy world: what the controller cannot walk is not followed."""

from __future__ import annotations

import pytest
import torch

from toy_world import DISCOUNT, GOAL, SPEED, START, geodesic, roots, row_generators, toy_fns
from velap.config.planning import PlannerConfig
from velap.errors import ConfigError
from velap.search.est import plan
from velap.search.rehearsal import LOOK_EVERY, rehearse, walk
from velap.search.types import Plan, Rejections, SearchFns, Tree

THROUGH = ((-1.0, 0.0), (1.0, 0.0), GOAL)
AROUND = ((-1.0, 7.0), (1.0, 7.0), GOAL)
CONFIG = PlannerConfig(rehearsals=2, rehearsal_paths=3, rehearsal_noise=0.1)


def straight(z: torch.Tensor, goal: torch.Tensor) -> torch.Tensor:
    """A controller that knows no wall."""
    return (goal - z) / (goal - z).norm(dim=-1, keepdim=True).clamp(min=1)


def true_value(z: torch.Tensor) -> torch.Tensor:
    return DISCOUNT ** geodesic(z, z.new_tensor(GOAL).expand_as(z))


def fns(**changes: object) -> SearchFns:
    return toy_fns(**{"act_local": straight, "value": true_value, **changes})


def two_ways() -> Plan:
    """A tree of one way through the wall, that an erring search took for free, and one around it; the first was chosen."""
    latents = torch.tensor([[START, *THROUGH, *AROUND]], dtype=torch.float64)
    steps = torch.tensor([[0.0, 5, 7, 12, 9, 11, 20]], dtype=torch.float64)
    count = torch.zeros(1, 7, dtype=torch.int64)
    tree = Tree(
        latents=latents, parents=torch.tensor([[-1, 0, 1, 2, 0, 4, 5]]), goal_values=true_value(latents), root_steps=steps,
        neighbour_counts=count, expansions=count, size=torch.tensor([7]),
    )
    none = torch.zeros(1, dtype=torch.int64)
    nodes = torch.tensor([[0, 1, 2, 3]])
    return Plan(
        waypoints=latents[:, :4], length=torch.tensor([4]), cost=steps[:, 3], reached_goal=torch.tensor([True]), nodes=nodes,
        tree=tree, rejections=Rejections(none, none, none, none),
    )


def test_the_way_that_can_be_walked_replaces_the_one_through_the_wall() -> None:
    found = two_ways()
    chosen = rehearse(fns(), found, CONFIG, 1.0, torch.Generator().manual_seed(0))
    length = int(chosen.length[0])
    assert chosen.nodes[0, :length].tolist() == [0, 4, 5, 6][:length], "its end, or a node on the way that costs the same"
    leaf = chosen.nodes[0, length - 1]
    assert chosen.waypoints[0, :length].tolist() == [list(START), *map(list, AROUND)][:length]
    assert chosen.cost[0] == found.tree.root_steps[0, leaf] and chosen.reached_goal[0] == (leaf == 6)


def test_a_wall_that_the_dynamics_do_not_know_is_walked_through() -> None:
    free = fns(step=lambda z, a: z + SPEED * a)
    assert rehearse(free, two_ways(), CONFIG, 1.0, torch.Generator()).nodes[0, 1] == 1


def test_a_walk_costs_its_steps_and_what_lies_ahead_of_its_end() -> None:
    way = torch.tensor([[START, (-6.0, 4.0), (-6.0, 8.0)], [START, (3.0, 0.0), (3.0, 0.0)]], dtype=torch.float64)
    cost = walk(fns(), way, torch.tensor([3, 2]), torch.tensor([30.0, 12.0], dtype=torch.float64), 1.0)
    # the first is walked, less the last metre; the second stands at the wall until its time is up
    steps = 7 / SPEED
    end = torch.tensor([-6.0, 7.5], dtype=torch.float64)
    ahead = geodesic(end, torch.tensor(GOAL, dtype=torch.float64))
    assert steps + ahead - 1 <= cost[0] <= steps + LOOK_EVERY + ahead + 2
    wall = torch.tensor([-6.0 + 6 * SPEED, 0.0], dtype=torch.float64)
    assert cost[1] == pytest.approx(14 + geodesic(wall, torch.tensor(GOAL, dtype=torch.float64)))


def test_rows_rehearse_by_their_own_generators() -> None:
    cfg = PlannerConfig(n_iter=120, n_sim=3, candidates=20, rehearsals=3, discard_low_exponent=4.0)
    world = fns(reach=lambda a, b: (DISCOUNT ** geodesic(a, b), torch.zeros(a.shape[:-1], dtype=a.dtype)))
    z = roots(3, spread=1.0)
    together = rehearse(world, plan(world, z, cfg, row_generators(3)), cfg, 2.0, row_generators(3, 7))
    alone = rehearse(world, plan(world, z[1:2], cfg, row_generators(1, 1)), cfg, 2.0, row_generators(1, 8))
    length = int(alone.length[0])
    assert together.length[1] == length
    assert together.nodes[1, :length].tolist() == alone.nodes[0, :length].tolist()


def test_a_root_alone_stays_and_a_model_without_its_policy_is_refused() -> None:
    cfg = PlannerConfig(n_iter=10, rehearsals=1)
    nowhere = fns(step=lambda z, a: z)
    found = plan(nowhere, roots(1), cfg, torch.Generator())
    assert rehearse(nowhere, found, cfg, 1.0, torch.Generator()).length.tolist() == [1]
    with pytest.raises(ConfigError, match="rehearsals"):
        rehearse(toy_fns(), found, cfg, 1.0, torch.Generator())
