"""One round: thresholds, simulation, anchors, novelty within the round, and equal results with and without packing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toy_world import DISCOUNT, SPEED, algorithm_1, reach, roots, row_generators, toy_fns
from velap.config.planning import PlannerConfig
from velap.errors import ConfigError
from velap.search import est, neighbours, simulation
from velap.search.est import expand_, plan, thresholds
from velap.search.neighbours import first_come
from velap.search.sampling import Noise, draw_noise
from velap.search.simulation import simulate
from velap.search.tree import new_tree, trimmed

CONFIG = algorithm_1(n_iter=100, n_sim=5, candidates=25, discard_low_exponent=6.0)


def test_thresholds_are_the_exponents_of_table_8() -> None:
    like = torch.zeros(1, dtype=torch.float64)
    found = thresholds(algorithm_1(n_sim=10), 0.96, like)
    assert [float(value) for value in found] == pytest.approx([0.96**2, 0.96**10, 0.04, 0.96**3, 0.96**5])
    ours = thresholds(algorithm_1(n_sim=10, discard_low_exponent=20.0), 0.96, like)
    assert float(ours.low) == pytest.approx(0.96**20)


@pytest.mark.parametrize(("q", "std", "field"), [
    (DISCOUNT**5.01, 0.0, "low"), (DISCOUNT**4.99, 0.0, None), (DISCOUNT**4, 1.01 * (1 - DISCOUNT), "std"),
    (DISCOUNT**4, 0.99 * (1 - DISCOUNT), None), (DISCOUNT**1.99, 0.0, "high"), (DISCOUNT**2.01, 0.0, None),
    (DISCOUNT**5.01, 1.0, "low"), (DISCOUNT**1.99, 1.0, "std"),
])
def test_each_rejection_at_its_threshold(q: float, std: float, field: str | None) -> None:
    cfg = algorithm_1(n_iter=1, n_sim=5, candidates=1)
    fns = toy_fns(reach=lambda a, b: (torch.full_like(a[..., 0], q), torch.full_like(a[..., 0], std)))
    found = plan(fns, roots(1), cfg, row_generators(1))
    assert found.tree.size.tolist() == [2 if field is None else 1]
    assert {name: int(count) for name, count in found.rejections._asdict().items() if count} == ({field: 1} if field else {})


def noise_of(actions: list[list[float]], by_policy: list[bool]) -> Noise:
    policy = torch.where(torch.tensor([by_policy]), 0.0, 0.9).double()
    return Noise(torch.zeros_like(policy), policy, torch.tensor(actions, dtype=torch.float64)[None, :, None])


def test_simulation_repeats_coherent_noise_and_follows_the_policy_where_told() -> None:
    cfg = algorithm_1(n_sim=3, p_policy=0.5)
    start = torch.tensor([[[-6.0, 0.0], [-5.0, 0.0], [-6.0, 0.0]]], dtype=torch.float64)
    noise = noise_of([[0.0, 2.0], [0.0, 2.0], [-2.0, 0.0]], [False, True, False])
    found = simulate(toy_fns(), start, noise, cfg)[0]
    expected = found.new_tensor([[-6, 3 * SPEED], [-5 + 3 * SPEED, 0], [-6 - 3 * SPEED, 0]])
    torch.testing.assert_close(found, expected)


def test_simulation_without_coherence_draws_each_step() -> None:
    cfg = algorithm_1(n_sim=3, p_policy=0.0, coherent_noise=False)
    noise = noise_of([[0.0, 1.0]], [False])._replace(action=torch.tensor([[[[0.0, 1], [-1, 0], [-1, 0]]]]).double())
    found = simulate(toy_fns(), roots(1)[:, None], noise, cfg)[0]
    torch.testing.assert_close(found, found.new_tensor([[-6 - 2 * SPEED, SPEED]]))


def by_turns(novel: list[bool], blocks: list[list[bool]]) -> list[bool]:
    accepted: list[bool] = []
    for k, fresh in enumerate(novel):
        accepted.append(fresh and not any(accepted[j] and blocks[k][j] for j in range(k)))
    return accepted


@settings(max_examples=100, deadline=None)
@given(seed=st.integers(0, 2**31), count=st.integers(1, 30), density=st.sampled_from([0.05, 0.3, 0.9]))
def test_first_come_is_the_sequential_rule(seed: int, count: int, density: float) -> None:
    generator = torch.Generator().manual_seed(seed)
    novel = torch.rand(3, count, generator=generator) < 0.8
    blocks = (torch.rand(3, count, count, generator=generator) < density).tril(-1)
    found = first_come(novel, blocks)
    for row in range(3):
        assert found[row].tolist() == by_turns(novel[row].tolist(), blocks[row].tolist())


def test_first_come_along_the_longest_chain() -> None:
    chain = torch.ones(1, 25, 25, dtype=torch.bool).tril(-1) & ~torch.ones(1, 25, 25, dtype=torch.bool).tril(-2)
    assert first_come(torch.ones(1, 25, dtype=torch.bool), chain)[0].tolist() == [k % 2 == 0 for k in range(25)]


def test_equal_candidates_of_one_round_enter_once() -> None:
    cfg = algorithm_1(n_iter=25, candidates=25, n_sim=4, p_policy=1.0, discard_low_exponent=6.0)
    found = plan(toy_fns(), roots(3), cfg, row_generators(3))
    assert found.tree.size.tolist() == [2, 2, 2]
    assert found.rejections.high.tolist() == [24, 24, 24]


def test_candidates_of_one_round_are_novel_against_each_other() -> None:
    cfg = algorithm_1(n_iter=40, candidates=40, n_sim=5, discard_low_exponent=6.0, p_policy=0.0)
    tree = plan(toy_fns(), roots(1), cfg, row_generators(1)).tree
    nodes = tree.latents[0, : tree.size[0]]
    assert 8 < len(nodes) < 30
    assert torch.pdist(nodes).min() > 2
    alone = plan(toy_fns(d_neigh=0.0), roots(1), cfg, row_generators(1)).tree
    assert alone.size[0] == 41, "without neighbours to compare with all would have entered"


def test_only_the_nearest_neighbours_are_compared_with(monkeypatch: pytest.MonkeyPatch) -> None:
    cfg = algorithm_1(n_iter=100, candidates=1, n_sim=5, discard_low_exponent=6.0, p_sparse=0.0)
    full = plan(toy_fns(), roots(1), cfg, row_generators(1)).tree
    monkeypatch.setattr(neighbours, "MAX_NEIGHBOURS", 1)
    few = plan(toy_fns(), roots(1), cfg, row_generators(1)).tree
    assert full.latents[0].tolist() == few.latents[0].tolist(), "in a metric world the nearest node decides about novelty"
    assert few.neighbour_counts.sum() < full.neighbour_counts.sum()


def grid_projection(z: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """A bank with a latent at every whole number of the half-plane y >= 0."""
    nearest = z.round()
    nearest = torch.stack([nearest[..., 0], nearest[..., 1].clamp(min=0)], -1)
    return nearest, (nearest - z).norm(dim=-1)


def test_anchors_snap_to_the_data_and_refuse_what_they_do_not_support() -> None:
    fns = toy_fns(project=grid_projection)
    free, snapped = (plan(fns, roots(2), PlannerConfig(**{**CONFIG.__dict__, "anchor": anchor}), row_generators(2))
                     for anchor in ("none", "snap"))
    free_nodes, nodes = (found.tree.latents[:, 1:][found.tree.parents[:, 1:] >= 0] for found in (free, snapped))
    assert free_nodes[:, 1].min() < -3
    assert free.rejections.unsupported.tolist() == [0, 0]
    assert nodes[:, 1].min() >= -1
    assert (nodes == nodes.round()).all()
    assert (snapped.rejections.unsupported > 10).all()


def test_anchors_are_left_to_the_model_where_the_config_says_auto() -> None:
    def nodes(anchor: str, snaps: bool) -> torch.Tensor:
        fns = toy_fns(project=grid_projection, snaps=snaps)
        return plan(fns, roots(2), PlannerConfig(**{**CONFIG.__dict__, "anchor": anchor}), row_generators(2)).tree.latents

    for snaps, same in ((True, "snap"), (False, "none")):
        assert torch.equal(nodes("auto", snaps), nodes(same, not snaps))
    assert not torch.equal(nodes("auto", True), nodes("auto", False))


def test_anchors_need_a_bank() -> None:
    with pytest.raises(ConfigError, match=r"`anchor` is 'snap'.*bank_size"):
        plan(toy_fns(), roots(1), algorithm_1(anchor="snap"), row_generators(1))


def accept_all(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Every pair is 2.5 steps apart: all candidates enter, each next to all others within d_neigh."""
    return torch.full_like(start[..., 0], DISCOUNT**2.5), torch.zeros_like(start[..., 0])


@pytest.mark.parametrize("reach_fn", [reach, accept_all])
def test_packing_changes_no_result(monkeypatch: pytest.MonkeyPatch, reach_fn: Callable[..., Any]) -> None:
    cfg, fns = PlannerConfig(**{**CONFIG.__dict__, "candidates": 10}), toy_fns(reach=reach_fn)
    packed = plan(fns, roots(3, spread=2.0), cfg, row_generators(3))
    for module in (neighbours, simulation, est):
        monkeypatch.setattr(module, "packs", lambda z: False)
    whole = plan(fns, roots(3, spread=2.0), cfg, row_generators(3))
    assert (packed.tree.size == 101).all() == (reach_fn is accept_all)
    assert packed.tree.parents.tolist() == whole.tree.parents.tolist()
    assert packed.tree.neighbour_counts.tolist() == whole.tree.neighbour_counts.tolist()
    torch.testing.assert_close(packed.tree.latents, whole.tree.latents, rtol=0, atol=1e-12)
    torch.testing.assert_close(packed.waypoints, whole.waypoints, rtol=0, atol=1e-12)


def test_a_round_is_one_graph_without_reading_anything_back() -> None:
    z_root = roots(2, spread=2.0)
    fns, limits = toy_fns(), thresholds(CONFIG, DISCOUNT, roots(1))
    noise = draw_noise(CONFIG, fns.noise_dim, z_root, row_generators(2))
    trees = []
    for run in (expand_, torch.compile(expand_, backend="eager", fullgraph=True)):
        tree = new_tree(z_root, fns.value(z_root), CONFIG.n_iter + 1)
        expand_(tree, fns, CONFIG, limits, noise.part(0, 25), slots=1)
        run(tree, fns, CONFIG, limits, noise.part(25, 50), slots=26)
        trees.append(trimmed(tree))
    assert trees[0].parents.tolist() == trees[1].parents.tolist()
    torch.testing.assert_close(trees[0].latents, trees[1].latents, rtol=0, atol=1e-12)


def test_networks_see_only_the_rows_that_matter_on_a_cpu() -> None:
    rows: list[int] = []

    def counted(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rows.append(start.numel() // 2)
        return reach(start, end)

    found = plan(toy_fns(reach=counted), roots(1), CONFIG, row_generators(1))
    assert found.tree.size[0] > 20
    assert 100 < sum(rows) < 600, "every pair would be 4 rounds x 25 candidates x 41 slots x 2 directions"
