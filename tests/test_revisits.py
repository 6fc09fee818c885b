"""Q^g lowered around visited states: by how much, where, and when that is forgotten."""

from __future__ import annotations

import pytest
import torch
from torch import tensor

from velap.methods.revisits import Revisits

DISCOUNT = 0.9


def started(penalty: float = 2.0, rows: int = 1) -> Revisits:
    revisits = Revisits(penalty, 0.5, DISCOUNT)
    revisits.forget(torch.ones(rows, dtype=torch.bool))
    return revisits


def test_every_visit_costs_its_steps_and_half_a_kernel_one_step_away() -> None:
    revisits, here = started(), tensor([[1.0, 0.0]])
    assert revisits.of_row(0, lambda z: z.sum(-1)) is None
    assert revisits.observe(here, tensor([0.8])).item() == pytest.approx(0.8), "the first state has no past"
    assert revisits.observe(here, tensor([0.8])).item() == pytest.approx(0.8 * DISCOUNT**2)
    value = revisits.of_row(0, lambda z: torch.full(z.shape[:-1], 0.8))
    assert value is not None
    expected = 0.8 * DISCOUNT ** (2 * 2 * torch.tensor([0.0, -0.5, -50.0]).exp())
    torch.testing.assert_close(value(tensor([[1.0, 0.0], [1.5, 0.0], [6.0, 0.0]])), expected)
    assert value(torch.zeros(2, 3, 2)).shape == (2, 3)


def test_rows_have_their_own_past_and_forget_alone() -> None:
    revisits, here = started(rows=2), torch.zeros(2, 1)
    revisits.observe(here, torch.ones(2))
    revisits.forget(tensor([True, False]))
    assert revisits.of_row(0, lambda z: z) is None
    torch.testing.assert_close(revisits.observe(here, torch.ones(2)), tensor([1.0, DISCOUNT**2]))
