"""What an episode corrects in h and Q^g: by how much, where it holds, and when it is forgotten."""

from __future__ import annotations

import pytest
import torch
from torch import tensor

from toy_world import toy_fns
from velap.methods.corrections import Residuals, Revisits
from velap.search.types import SearchFns

STEP = 1.0
RIGHT, LEFT = tensor([[1.0]]), tensor([[-1.0]])


def straight(latents: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """A world without walls, as h sees it: one dimension, one step length a unit of action."""
    return latents + actions * STEP


FNS = toy_fns(step=straight, step_distance=STEP)


def pushed(size: int = 4, moved: float = 0.0) -> Residuals:
    """After one push to the right at 0 that led to `moved`."""
    residuals = Residuals(size, FNS)
    residuals.forget(torch.ones(1, dtype=torch.bool))
    residuals.observe(tensor([[0.0]]))
    residuals.acted(tensor([[0.0]]), RIGHT)
    residuals.observe(tensor([[moved]]))
    return residuals


def in_row(residuals: Residuals, row: int = 0) -> SearchFns | None:
    """The model as a row corrects it; None where it leaves it alone."""
    corrected = residuals.in_row(FNS, row)
    return None if corrected is FNS else corrected


def predict(residuals: Residuals, at: float, action: torch.Tensor) -> float:
    alone, together = in_row(residuals), residuals.in_rows(FNS, tensor([0])).step(tensor([[[at]]]), action.unsqueeze(0))
    if alone is not None:
        torch.testing.assert_close(alone.step(tensor([[at]]), action), together[0])
    return together.item()


def test_what_did_not_move_is_expected_to_stay() -> None:
    residuals = pushed()
    assert predict(residuals, 0.0, RIGHT) == pytest.approx(0.0, abs=1e-6)
    assert predict(residuals, 0.5, RIGHT) == pytest.approx(1.5 - torch.tensor(-0.25).exp().item(), abs=1e-5)


def test_other_actions_and_places_are_left_alone() -> None:
    residuals = pushed()
    assert predict(residuals, 0.0, LEFT) == pytest.approx(-1.0, abs=1e-4)
    assert predict(residuals, 5.0, RIGHT) == pytest.approx(6.0, abs=1e-4)


def test_corrections_of_several_steps_are_averaged_and_never_add_up() -> None:
    residuals = pushed()
    for _ in range(3):
        residuals.acted(tensor([[0.0]]), RIGHT)
        residuals.observe(tensor([[0.0]]))
    assert predict(residuals, 0.0, RIGHT) == pytest.approx(0.0, abs=1e-6)


def test_small_errors_are_not_kept() -> None:
    assert predict(pushed(moved=0.9), 0.0, RIGHT) == pytest.approx(1.0)
    assert in_row(pushed(moved=0.9)) is None
    assert in_row(pushed()) is not None


def test_only_the_last_steps_are_remembered() -> None:
    residuals = pushed(size=2)
    for place in (10.0, 20.0):
        residuals.acted(tensor([[place]]), RIGHT)
        residuals.observe(tensor([[place]]))
    assert predict(residuals, 0.0, RIGHT) == pytest.approx(1.0), "the first of three"
    assert predict(residuals, 10.0, RIGHT) == pytest.approx(10.0, abs=1e-4)


def test_a_row_forgets_alone_and_the_frame_after_a_reset_teaches_nothing() -> None:
    residuals = Residuals(4, FNS)
    residuals.forget(torch.ones(2, dtype=torch.bool))
    here, push = torch.zeros(2, 1), RIGHT.expand(2, 1)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.forget(tensor([True, False]))
    residuals.observe(here)
    moved = residuals.in_rows(FNS, tensor([0, 1])).step(here.unsqueeze(1), push.unsqueeze(1)).flatten()
    assert moved.tolist() == pytest.approx([1.0, 0.0], abs=1e-6)
    second = residuals.in_rows(FNS, tensor([1])).step(here[1:].unsqueeze(1), push[1:].unsqueeze(1))
    assert second.item() == pytest.approx(0, abs=1e-6)


def test_another_batch_starts_anew() -> None:
    residuals = pushed()
    residuals.forget(torch.ones(3, dtype=torch.bool))
    here, push = torch.zeros(3, 1), RIGHT.expand(3, 1)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.observe(here + tensor([[1.0], [0.0], [1.0]]))
    moved = residuals.in_rows(FNS, tensor([0, 1, 2])).step(here.unsqueeze(1), push.unsqueeze(1)).flatten()
    assert moved.tolist() == pytest.approx([1.0, 0.0, 1.0], abs=1e-6)


DISCOUNT = 0.9


def revisits(rows: int = 1) -> Revisits:
    """A visit costs two steps; one step is half a unit long."""
    started = Revisits(2.0, toy_fns(discount=DISCOUNT, step_distance=0.5))
    started.forget(torch.ones(rows, dtype=torch.bool))
    return started


def promising(promise: float) -> SearchFns:
    """Q^g is the same everywhere."""
    return toy_fns(value=lambda z: torch.full(z.shape[:-1], promise))


def test_every_visit_costs_its_steps_and_half_a_kernel_one_step_away() -> None:
    past, here, fns = revisits(), tensor([[1.0, 0.0]]), promising(0.8)
    assert past.in_row(fns, 0) is fns, "no state has a past yet"
    assert past.in_rows(fns, tensor([0])).value(here).item() == pytest.approx(0.8)
    past.observe(here)
    assert past.in_rows(fns, tensor([0])).value(here).item() == pytest.approx(0.8 * DISCOUNT**2)
    past.observe(here)
    value = past.in_row(fns, 0).value
    expected = 0.8 * DISCOUNT ** (2 * 2 * torch.tensor([0.0, -0.5, -50.0]).exp())
    torch.testing.assert_close(value(tensor([[1.0, 0.0], [1.5, 0.0], [6.0, 0.0]])), expected)
    assert value(torch.zeros(2, 3, 2)).shape == (2, 3)


def test_rows_have_their_own_past_and_forget_alone() -> None:
    past, here, fns = revisits(rows=2), torch.zeros(2, 1), promising(1.0)
    past.observe(here)
    past.forget(tensor([True, False]))
    assert past.in_row(fns, 0) is fns
    torch.testing.assert_close(past.in_rows(fns, tensor([0, 1])).value(here), tensor([1.0, DISCOUNT**2]))
    torch.testing.assert_close(past.in_rows(fns, tensor([1])).value(here[:1]), tensor([DISCOUNT**2]))
