"""Corrections of h by its own errors: where they hold, where they do not, and when they are forgotten."""

from __future__ import annotations

import pytest
import torch
from torch import tensor

from velap.methods.residuals import Residuals

STEP = 1.0
RIGHT, LEFT = tensor([[1.0]]), tensor([[-1.0]])


def straight(latents: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """A world without walls, as h sees it: one dimension, one step length a unit of action."""
    return latents + actions * STEP


def pushed(size: int = 4, moved: float = 0.0) -> Residuals:
    """After one push to the right at 0 that led to `moved`."""
    residuals = Residuals(size, straight, STEP)
    residuals.forget(torch.ones(1, dtype=torch.bool))
    residuals.observe(tensor([[0.0]]))
    residuals.acted(tensor([[0.0]]), RIGHT)
    residuals.observe(tensor([[moved]]))
    return residuals


def predict(residuals: Residuals, at: float, action: torch.Tensor) -> float:
    alone = residuals.of_row(0)
    together = residuals.of_rows(tensor([0]))(tensor([[[at]]]), action.unsqueeze(0))
    if alone is not None:
        torch.testing.assert_close(alone(tensor([[at]]), action), together[0])
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
    assert pushed(moved=0.9).of_row(0) is None
    assert pushed().of_row(0) is not None


def test_only_the_last_steps_are_remembered() -> None:
    residuals = pushed(size=2)
    for place in (10.0, 20.0):
        residuals.acted(tensor([[place]]), RIGHT)
        residuals.observe(tensor([[place]]))
    assert predict(residuals, 0.0, RIGHT) == pytest.approx(1.0), "the first of three"
    assert predict(residuals, 10.0, RIGHT) == pytest.approx(10.0, abs=1e-4)


def test_a_row_forgets_alone_and_the_frame_after_a_reset_teaches_nothing() -> None:
    residuals = Residuals(4, straight, STEP)
    residuals.forget(torch.ones(2, dtype=torch.bool))
    here, push = torch.zeros(2, 1), RIGHT.expand(2, 1)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.forget(tensor([True, False]))
    residuals.observe(here)
    moved = residuals.of_rows(tensor([0, 1]))(here.unsqueeze(1), push.unsqueeze(1)).flatten()
    assert moved.tolist() == pytest.approx([1.0, 0.0], abs=1e-6)
    assert residuals.of_rows(tensor([1]))(here[1:].unsqueeze(1), push[1:].unsqueeze(1)).item() == pytest.approx(0, abs=1e-6)


def test_another_batch_starts_anew() -> None:
    residuals = pushed()
    residuals.forget(torch.ones(3, dtype=torch.bool))
    here, push = torch.zeros(3, 1), RIGHT.expand(3, 1)
    residuals.observe(here)
    residuals.acted(here, push)
    residuals.observe(here + tensor([[1.0], [0.0], [1.0]]))
    moved = residuals.of_rows(tensor([0, 1, 2]))(here.unsqueeze(1), push.unsqueeze(1)).flatten()
    assert moved.tolist() == pytest.approx([1.0, 0.0, 1.0], abs=1e-6)
