"""Slots, sinks and paths, and what holds for every tree that a plan grows."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from toy_world import DISCOUNT, algorithm_1, reach, roots, row_generators, toy_fns
from velap.search import neighbours
from velap.search.est import plan
from velap.search.tree import Candidates, free_slots, insert_, new_tree, take, trace_back, trimmed


def candidates(values: list[list[float]]) -> Candidates:
    """Children of the root whose every number is their value."""
    numbers = torch.tensor(values, dtype=torch.float32)
    return Candidates(numbers.unsqueeze(-1), torch.zeros_like(numbers, dtype=torch.int64), numbers, numbers, numbers.long())


def test_accepted_candidates_take_the_next_slots_and_rejects_leave_no_trace() -> None:
    tree = new_tree(torch.zeros(2, 1), torch.tensor([0.5, 0.6]), capacity=5)
    for accepted in ([[True, False, True], [False, False, False]], [[True, False, False], [False, True, True]]):
        slots = free_slots(tree, torch.tensor(accepted))
        insert_(tree, candidates([[1, 2, 3], [4, 5, 6]]), slots)
    tree = trimmed(tree)
    assert tree.size.tolist() == [4, 3]
    assert tree.latents[..., 0].tolist() == [[0, 1, 3, 1, 0], [0, 5, 6, 0, 0]]
    assert tree.parents.tolist() == [[-1, 0, 0, 0, -1], [-1, 0, 0, -1, -1]]
    assert tree.neighbour_counts.tolist() == [[0, 1, 3, 1, 0], [0, 5, 6, 0, 0]]
    assert tree.root_steps.tolist() == [[0, 1, 3, 1, torch.inf], [0, 5, 6, torch.inf, torch.inf]]
    torch.testing.assert_close(tree.goal_values[:, 0], torch.tensor([0.5, 0.6]))
    assert tree.goal_values[1, 3:].tolist() == [-torch.inf] * 2


def test_a_full_tree_takes_nothing_more() -> None:
    tree = new_tree(torch.zeros(1, 1), torch.zeros(1), capacity=3)
    slots = free_slots(tree, torch.tensor([[True, True, True, True]]))
    assert slots.tolist() == [[1, 2, 3, 3]]
    insert_(tree, candidates([[1, 2, 3, 4]]), slots)
    assert tree.size.tolist() == [3]
    before = trimmed(tree).latents.clone()
    slots = free_slots(tree, torch.tensor([[True, True]]))
    assert slots.tolist() == [[3, 3]]
    insert_(tree, candidates([[8, 9]]), slots)
    assert tree.size.tolist() == [3]
    assert trimmed(tree).latents.tolist() == before.tolist() == [[[0], [1], [2]]]


def test_paths_start_at_the_root_and_repeat_the_leaf() -> None:
    parents = torch.tensor([[-1, 0, 1, 0, 2, -1], [-1, 0, 0, -1, -1, -1], [-1, 0, 0, -1, -1, -1]])
    nodes, length = trace_back(parents, torch.tensor([4, 2, 0]), depth=4)
    assert nodes.tolist() == [[0, 1, 2, 4, 4], [0, 2, 2, 2, 2], [0, 0, 0, 0, 0]]
    assert length.tolist() == [4, 2, 1]
    assert trace_back(parents, torch.tensor([4, 2, 0]), depth=3)[0].shape == (3, 4)


def test_take_gathers_rows_of_each_batch() -> None:
    rows = torch.arange(12.0).view(2, 3, 2)
    assert take(rows, torch.tensor([[2, 0], [1, 1]])).tolist() == [[[4, 5], [0, 1]], [[8, 9], [8, 9]]]
    assert take(rows, torch.tensor([[[2]], [[0]]])).shape == (2, 1, 1, 2)


@pytest.fixture(scope="module", autouse=True)
def compare_with_every_node() -> Iterator[None]:
    """As the paper does: with no more than MAX_NEIGHBOURS inside d_neigh that makes no difference, here there are more."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(neighbours, "MAX_NEIGHBOURS", 1000)
        yield


def one_way_reach(start: torch.Tensor, end: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Down is slower than up: Q^{i,j} and Q^{j,i} differ."""
    q, std = reach(start, end)
    return q * DISCOUNT ** (0.5 * (start - end)[..., 1].clamp(min=0)), std


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**31), candidates=st.integers(1, 40), n_iter=st.integers(1, 80), n_sim=st.integers(1, 6),
    coherent=st.booleans(), p_policy=st.sampled_from([0.0, 0.2, 1.0]), high=st.sampled_from([0.5, 2.0]),
)
def test_trees_keep_their_properties(
    seed: int, candidates: int, n_iter: int, n_sim: int, coherent: bool, p_policy: float, high: float
) -> None:
    cfg = algorithm_1(
        n_iter=n_iter, candidates=candidates, n_sim=n_sim, coherent_noise=coherent, p_policy=p_policy,
        discard_high_exponent=high, discard_low_exponent=n_sim + 1.0, goal_exponent=9.0,
    )
    fns = toy_fns(reach=one_way_reach)
    found = plan(fns, roots(2, spread=5.0, seed=seed), cfg, row_generators(2, seed))
    tree, used = found.tree, torch.arange(n_iter + 1) < found.tree.size[:, None]

    assert (tree.parents[:, 0] == -1).all()
    assert ((tree.parents >= 0) == used)[:, 1:].all(), "every node but the root has a parent"
    assert (tree.parents < torch.arange(n_iter + 1)).all(), "parents come before children, so there is no cycle"

    edge_q = fns.reach(take(tree.latents, tree.parents.clamp(min=0)), tree.latents)[0]
    steps = tree.root_steps.gather(1, tree.parents.clamp(min=0)) + edge_q.log() / torch.tensor(DISCOUNT).log()
    torch.testing.assert_close(tree.root_steps[:, 1:][used[:, 1:]], steps[:, 1:][used[:, 1:]], rtol=1e-6, atol=1e-6)

    start, end = tree.latents[:, :, None], tree.latents[:, None]
    pair_q = fns.reach(start.expand(-1, -1, n_iter + 1, -1), end.expand(-1, n_iter + 1, -1, -1))[0]
    other = used[:, :, None] & used[:, None] & ~torch.eye(n_iter + 1, dtype=torch.bool)
    near = other & ((start - end).norm(dim=-1) <= fns.d_neigh)
    recounted = (near & (pair_q > DISCOUNT**3)).sum(1)
    assert recounted.tolist() == tree.neighbour_counts.tolist()
    assert (pair_q[near.tril(-1).mT] < DISCOUNT**high).all(), "no earlier node is too close to a later one"

    for row in range(2):
        path = found.nodes[row, : found.length[row]].tolist()
        assert path[0] == 0
        assert tree.parents[row, path[1:]].tolist() == path[:-1]
        assert set(found.nodes[row, found.length[row] :].tolist()) <= {path[-1]}
    torch.testing.assert_close(found.waypoints, take(tree.latents, found.nodes))
    assert (torch.stack(found.rejections).sum(0) + tree.size - 1).tolist() == [n_iter, n_iter]
