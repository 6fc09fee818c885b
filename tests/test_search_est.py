"""Algorithm 1 as a whole: against the plain-Python reference, round a wall, in batches and in every degenerate case."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from algorithm1 import reference_plan
from toy_world import (
    DISCOUNT,
    GOAL,
    HALF_WIDTH,
    SPEED,
    TIP,
    algorithm_1,
    geodesic,
    misleading_value,
    move,
    reach,
    roots,
    row_generators,
    toy_fns,
)
from velap.search import neighbours
from velap.search.est import plan
from velap.search.sampling import draw_noise
from velap.search.types import Plan

CONFIG = algorithm_1(n_iter=250, n_sim=5, candidates=25, discard_low_exponent=6.0)


@pytest.fixture(scope="module", autouse=True)
def compare_with_every_node() -> Iterator[None]:
    """As the paper does: with no more than MAX_NEIGHBOURS inside d_neigh that makes no difference, here there are more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "MAX_NEIGHBOURS", 1000)
        yield


def doubtful_reach(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Down is slower than up, and the ensemble disagrees in the half-plane y < -1."""
    q, std = reach(start, end)
    return q * DISCOUNT ** (start - end)[..., 1].clamp(min=0), std + 0.1 * (end[..., 1] < -1)


def through_walls(z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
    """Dynamics that know no wall, so that the critics have something to refuse."""
    return z + SPEED * action


@pytest.mark.parametrize(("seed", "candidates"), [(0, 1), (1, 1), (2, 1), (3, 1), (4, 1), (5, 1), (6, 7), (7, 7), (8, 50)])
def test_equals_plain_python_algorithm_1(seed: int, candidates: int) -> None:
    coherent = seed % 2 == 0
    cfg = algorithm_1(
        n_iter=100, n_sim=4 if coherent else 10, candidates=candidates, p_policy=0.3, coherent_noise=coherent,
        discard_low_exponent=6.0 if coherent else None, goal_exponent=5.0 + 6 * (seed > 2),
        anchor="snap" if seed in (0, 3, 6) else "none",
    )
    fns = toy_fns(reach=doubtful_reach, step=through_walls, project=lambda z: (z, z.new_zeros(z.shape[:-1])))
    z_root = roots(1, spread=1.0, seed=seed)
    found = plan(fns, z_root, cfg, torch.Generator().manual_seed(seed))
    noise = draw_noise(cfg, fns.noise_dim, z_root, torch.Generator().manual_seed(seed))
    expected = reference_plan(fns, z_root[0], cfg, noise)

    size = len(expected["nodes"])
    assert size > 10
    assert found.tree.size.tolist() == [size]
    assert found.tree.parents[0, :size].tolist() == expected["parents"]
    assert found.tree.neighbour_counts[0, :size].tolist() == expected["counts"]
    assert found.tree.expansions[0, :size].tolist() == expected["expansions"]
    torch.testing.assert_close(found.tree.latents[0, :size], torch.stack(expected["nodes"]), rtol=0, atol=1e-12)
    torch.testing.assert_close(found.tree.root_steps[0, :size].tolist(), expected["steps"])
    torch.testing.assert_close(found.tree.goal_values[0, :size].tolist(), expected["values"])
    assert found.nodes[0, : found.length[0]].tolist() == expected["path"]
    assert found.reached_goal.tolist() == [bool(expected["goals"])]
    assert min(int(count) for count in found.rejections[1:]) > 0, "the case exercises all three rejections"


def climb(z: torch.Tensor, steps: int) -> torch.Tensor:
    """Greedy ascent of the goal value: of 64 directions and standing still the best, step after step."""
    angles = torch.arange(64, dtype=z.dtype) * (2 * torch.pi / 64)
    moves = torch.cat([torch.stack([angles.cos(), angles.sin()], -1), z.new_zeros(1, 2)])
    for _ in range(steps):
        reachable = move(z.unsqueeze(-2).expand(*z.shape[:-1], len(moves), 2), moves)
        best = misleading_value(reachable).argmax(-1)
        z = reachable.gather(-2, best[..., None, None].expand(*best.shape, 1, 2)).squeeze(-2)
    return z


def test_finds_the_way_round_a_wall_where_greedy_ascent_is_stuck() -> None:
    z_root = roots(8, spread=1.0)
    stuck = climb(z_root, 200)
    assert (stuck[:, 0] < 0).all()
    assert (misleading_value(stuck) < DISCOUNT**5).all()

    found = plan(toy_fns(), z_root, CONFIG, row_generators(8))
    assert found.reached_goal.all()
    ends = found.nodes.new_zeros(8, 1) + found.length[:, None] - 1
    leaves = found.waypoints.gather(1, ends[..., None].expand(-1, -1, 2)).squeeze(1)
    assert (leaves[:, 0] > 0).all()
    assert (leaves - leaves.new_tensor(GOAL)).norm(dim=-1).max() < 5
    shortest = geodesic(z_root, leaves)
    assert (found.cost >= shortest - 1e-9).all()
    assert (found.cost < 2.5 * shortest).all()
    torch.testing.assert_close(found.waypoints[:, 0], z_root)
    hops = geodesic(found.waypoints[:, :-1], found.waypoints[:, 1:])
    torch.testing.assert_close(hops.sum(1), found.cost)


def assert_same_row(one: Plan, many: Plan, row: int) -> None:
    """Every choice is the same; numbers may differ in the last bit: vectorised arithmetic depends on shapes."""
    for name in ("waypoints", "length", "cost", "reached_goal", "nodes"):
        torch.testing.assert_close(getattr(one, name)[0], getattr(many, name)[row], rtol=0, atol=1e-12)
    for name in ("latents", "parents", "goal_values", "root_steps", "neighbour_counts", "size"):
        torch.testing.assert_close(getattr(one.tree, name)[0], getattr(many.tree, name)[row], rtol=0, atol=1e-12)
    assert [int(count[0]) for count in one.rejections] == [int(count[row]) for count in many.rejections]


def test_rows_of_a_batch_do_not_depend_on_each_other() -> None:
    z_root = roots(5, spread=3.0)
    many = plan(toy_fns(), z_root, CONFIG, row_generators(5))
    assert len({tuple(row) for row in many.tree.parents.tolist()}) == 5
    for row in range(5):
        alone = plan(toy_fns(), z_root[row : row + 1], CONFIG, row_generators(5)[row])
        assert_same_row(alone, many, row)


def test_a_single_generator_serves_a_whole_batch() -> None:
    found = plan(toy_fns(), roots(3), CONFIG, torch.Generator().manual_seed(0))
    again = plan(toy_fns(), roots(3), CONFIG, torch.Generator().manual_seed(0))
    torch.testing.assert_close(found.tree.latents, again.tree.latents, rtol=0, atol=0)
    assert len({tuple(row) for row in found.tree.parents.tolist()}) == 3


def test_generators_must_be_one_a_row() -> None:
    with pytest.raises(ValueError, match="got 2 generators for 3 rows"):
        plan(toy_fns(), roots(3), CONFIG, row_generators(2))
    with pytest.raises(ValueError, match=r"expected \[B, D\]"):
        plan(toy_fns(), roots(3)[0], CONFIG, row_generators(2))


def test_root_at_the_goal_is_a_path_of_one_node() -> None:
    z_root = torch.tensor([GOAL], dtype=torch.float64)
    found = plan(toy_fns(), z_root, CONFIG, row_generators(1))
    assert found.length.tolist() == [1]
    assert found.reached_goal.tolist() == [True]
    assert found.cost.tolist() == [0.0]
    assert found.nodes.unique().tolist() == [0]
    torch.testing.assert_close(found.waypoints, z_root[:, None].expand_as(found.waypoints))


@pytest.mark.parametrize("broken", ["nothing moves", "too far", "critics are NaN"])
def test_nothing_accepted_leaves_the_root(broken: str) -> None:
    fns = {
        "nothing moves": toy_fns(step=lambda z, a: z),
        "too far": toy_fns(step=lambda z, a: z + 100),
        "critics are NaN": toy_fns(reach=lambda a, b: (a[..., 0] * torch.nan, a[..., 0])),
    }[broken]
    found = plan(fns, roots(2), CONFIG, row_generators(2))
    assert found.tree.size.tolist() == [1, 1]
    assert found.length.tolist() == [1, 1]
    assert found.cost.tolist() == [0.0, 0.0]
    assert found.reached_goal.tolist() == [False, False]
    reason = found.rejections.high if broken == "nothing moves" else found.rejections.low
    assert reason.tolist() == [CONFIG.n_iter] * 2
    assert found.tree.parents.unique().tolist() == [-1]


def test_a_full_tree_when_everything_is_accepted() -> None:
    accept_all = toy_fns(reach=lambda a, b: (torch.full_like(a[..., 0], DISCOUNT**3), a[..., 0] * 0))
    cfg = algorithm_1(n_iter=30, candidates=7, n_sim=4, goal_exponent=1.0)
    found = plan(accept_all, roots(2), cfg, row_generators(2))
    assert found.tree.size.tolist() == [31, 31]
    assert (found.tree.parents[:, 1:] >= 0).all()
    assert torch.isfinite(found.tree.root_steps).all()
    assert sum(int(count.sum()) for count in found.rejections) == 0
    assert found.tree.latents.shape == (2, 31, 2)


def test_without_a_goal_the_path_leads_to_the_highest_value() -> None:
    cfg = algorithm_1(n_iter=60, discard_low_exponent=6.0, goal_exponent=0.0)
    found = plan(toy_fns(), roots(3, spread=2.0), cfg, row_generators(3))
    assert found.reached_goal.tolist() == [False] * 3
    leaf = found.nodes[:, -1]
    assert leaf.tolist() == found.tree.goal_values.argmax(1).tolist()
    torch.testing.assert_close(found.cost, found.tree.root_steps.gather(1, leaf[:, None]).squeeze(1))


def test_of_several_goal_nodes_the_nearest_is_chosen() -> None:
    cfg = algorithm_1(n_iter=100, discard_low_exponent=6.0, goal_exponent=11.0)
    found = plan(toy_fns(), roots(4), cfg, row_generators(4))
    is_goal = found.tree.goal_values > DISCOUNT**11
    assert (is_goal.sum(1) > 1).all()
    nearest = found.tree.root_steps.masked_fill(~is_goal, torch.inf).amin(1)
    torch.testing.assert_close(found.cost, nearest)
    assert (found.tree.goal_values.argmax(1) != found.nodes[:, -1]).any(), "the highest value is not always the nearest"


def test_iterations_count_expansions_not_rounds() -> None:
    cfg = algorithm_1(n_iter=60, candidates=25, discard_low_exponent=6.0)
    calls: list[int] = []

    def counted(z: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        calls.append(z.numel() // 2)
        return move(z, action)

    found = plan(toy_fns(step=counted), roots(2), cfg, row_generators(2))
    assert calls == [2 * 25] * 5 + [2 * 25] * 5 + [2 * 10] * 5
    rejected = torch.stack(found.rejections).sum(0)
    assert (rejected + found.tree.size - 1).tolist() == [60, 60]


def test_world_is_exact() -> None:
    points = torch.tensor([[-1.0, 0.0], [1.0, 0.0], [-1.0, 7.0], [1.0, 7.0]], dtype=torch.float64)
    assert geodesic(points[0], points[1]).item() == pytest.approx(2 * (1 + TIP**2) ** 0.5)
    assert geodesic(points[2], points[3]).item() == pytest.approx(2.0)
    assert move(points[0] * 0.5, torch.tensor([1.0, 0.0])).tolist() == [-0.5, 0.0]
    assert move(points[1] * HALF_WIDTH, torch.tensor([1.0, 0.0])).tolist() == [HALF_WIDTH, 0.0]


def test_few_rows_are_planned_on_one_thread_and_the_setting_comes_back():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    seen = []

    def counted(z):
        seen.append(torch.get_num_threads())
        return misleading_value(z)

    try:
        plan(toy_fns(value=counted), roots(1), algorithm_1(n_iter=20, candidates=10), torch.Generator().manual_seed(0))
        assert set(seen) == {1}
        assert torch.get_num_threads() == 2
        seen.clear()
        plan(toy_fns(value=counted), roots(32), algorithm_1(n_iter=20, candidates=10), torch.Generator().manual_seed(0))
        assert set(seen) == {2}
    finally:
        torch.set_num_threads(before)
