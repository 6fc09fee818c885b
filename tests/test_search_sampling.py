"""P_node of Eq. 6-7, its draws, and randomness that belongs to a row."""

from __future__ import annotations

import pytest
import torch
from scipy.stats import chisquare

from toy_world import algorithm_1
from velap.config.planning import PlannerConfig
from velap.search.sampling import TEMPERATURE_SPARSE, TEMPERATURE_VALUE, draw_noise, node_distribution, sample_nodes

COUNTS = torch.tensor([[0, 1, 3, 2, 0]])
VALUES = torch.tensor([[0.2, 0.1, 0.5, 0.45, -torch.inf]], dtype=torch.float64)
USED = torch.tensor([[True, True, True, True, False]])


def by_hand(cfg: PlannerConfig) -> torch.Tensor:
    sparse = torch.exp(-COUNTS[0, :4].double() / TEMPERATURE_SPARSE)
    value = torch.exp(VALUES[0, :4] / TEMPERATURE_VALUE)
    rest = 1 - cfg.p_sparse - cfg.p_value
    return cfg.p_sparse * sparse / sparse.sum() + cfg.p_value * value / value.sum() + rest / 4


@pytest.mark.parametrize(
    ("p_sparse", "p_value"), [(1.0, 0.0), (0.0, 1.0), (0.0, 0.0), (0.4, 0.4), (0.7, 0.3)],
)
def test_distribution_is_eq_6_and_7(p_sparse: float, p_value: float) -> None:
    cfg = algorithm_1(p_sparse=p_sparse, p_value=p_value)
    found = node_distribution(COUNTS, VALUES, USED, cfg)
    torch.testing.assert_close(found[0, :4], by_hand(cfg), rtol=1e-6, atol=1e-7)
    assert found[0, 4].item() == 0
    assert found.sum().item() == pytest.approx(1)


def test_draws_follow_the_distribution() -> None:
    cfg = algorithm_1(p_sparse=0.3, p_value=0.5)
    distribution = node_distribution(COUNTS, VALUES, USED, cfg)
    uniform = torch.rand(1, 20_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    drawn = sample_nodes(distribution, uniform, torch.tensor([4]))
    observed = torch.bincount(drawn[0], minlength=5)
    assert observed[4] == 0
    assert chisquare(observed[:4].numpy(), (by_hand(cfg) * 20_000).numpy()).pvalue > 0.01


def test_draws_never_leave_the_tree_nor_hit_nodes_of_weight_zero() -> None:
    distribution = torch.tensor([[0.0, 0.5, 0.0, 0.5, 0.0], [1.0, 0.0, 0.0, 0.0, 0.0]])
    edges = torch.tensor([[0.0, 0.5, 0.49999997, 0.99999994]] * 2)
    assert sample_nodes(distribution, edges, torch.tensor([4, 1])).tolist() == [[1, 3, 1, 3], [0, 0, 0, 0]]
    nan = torch.full((2, 5), torch.nan)
    assert sample_nodes(nan, edges, torch.tensor([4, 1])).amax(1).tolist() == [3, 0], "broken critics pick no unused slot"


def test_noise_of_a_row_is_its_generators_alone() -> None:
    cfg, like = algorithm_1(n_iter=30, n_sim=5, coherent_noise=False), torch.zeros(3, 7)
    make = lambda rows: [torch.Generator().manual_seed(10 + row) for row in rows]  # noqa: E731
    together = draw_noise(cfg, 4, like, make(range(3)))
    assert [tuple(part.shape) for part in together] == [(3, 30), (3, 30), (3, 30, 5, 4)]
    for row in range(3):
        alone = draw_noise(cfg, 4, like[:1], make([row])[0])
        for one, many in zip(alone, together, strict=True):
            torch.testing.assert_close(one[0], many[row], rtol=0, atol=0)
    assert not torch.equal(together.node, together.policy)
    assert abs(float(together.action.std()) - 1) < 0.05
    assert draw_noise(algorithm_1(n_iter=30), 4, like, make(range(3))).action.shape == (3, 30, 1, 4)
    assert together.part(5, 9).action.tolist() == together.action[:, 5:9].tolist()
