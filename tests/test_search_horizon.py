"""Q ↔ steps: the numbers of Table 8, the floor, and tensors equal to floats."""

from __future__ import annotations

import math

import pytest
import torch

from velap.models.horizon import Q_FLOOR, q_from_steps, steps_from_q


@pytest.mark.parametrize(("steps", "q"), [(0.0, 1.0), (2.0, 0.9216), (3.0, 0.884736), (5.0, 0.8153726976)])
def test_table_8_thresholds_both_ways(steps: float, q: float) -> None:
    assert q_from_steps(steps, 0.96) == pytest.approx(q)
    assert steps_from_q(q, 0.96) == pytest.approx(steps, abs=1e-9)
    torch.testing.assert_close(q_from_steps(torch.tensor([steps]), 0.96), torch.tensor([q]))
    torch.testing.assert_close(steps_from_q(torch.tensor([q]), 0.96), torch.tensor([steps]), atol=1e-4, rtol=0)


def test_values_that_no_distance_has_are_capped() -> None:
    far = math.log(Q_FLOOR) / math.log(0.96)
    assert 338 < far < 339
    values = torch.tensor([-1.0, 0.0, Q_FLOOR / 2, 1.0, 1.5, math.inf, -math.inf], dtype=torch.float64)
    expected = torch.tensor([far, far, far, 0.0, 0.0, 0.0, far], dtype=torch.float64)
    torch.testing.assert_close(steps_from_q(values, 0.96), expected)
    assert [steps_from_q(float(q), 0.96) for q in values] == pytest.approx(expected.tolist())


def test_nan_stays_nan() -> None:
    assert math.isnan(steps_from_q(math.nan, 0.96))
    assert steps_from_q(torch.tensor(math.nan), 0.96).isnan()
