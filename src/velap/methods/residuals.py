"""What the last steps of an episode showed h to be wrong about (ours).

B environments, M steps remembered, K queries a row, D latent dimensions, A action dimensions.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Step = Callable[[Tensor, Tensor], Tensor]
"""h: `[*, D], [*, A] → [*, D]`."""


class Residuals:
    """h corrected by its own errors: a block that pushes against a wall which h does not see comes to expect to stay.

    The error of every step that was taken is remembered with its latent and action, and added to predictions from nearby
    latents by similar actions, weighted by a Gaussian kernel.
    """

    LATENT_WIDTH = 1.0
    """Width of the kernel over latents [one-step lengths]."""
    ACTION_WIDTH = 0.5
    """Width of the kernel over actions in [-1, 1]."""
    LEAST_ERROR = 0.4
    """Smaller errors are left alone [one-step lengths]."""

    def __init__(self, size: int, step: Step, step_distance: float) -> None:
        self.size = size
        """M, steps remembered."""
        self._step = step
        self._width = self.LATENT_WIDTH * max(step_distance, 1e-6)
        self._least = self.LEAST_ERROR * max(step_distance, 1e-6)
        self._latents = self._actions = self._errors = torch.empty(0, 0, 0)
        self._known = torch.empty(0, 0)
        self._taken = torch.empty(0, dtype=torch.long)
        """[B] steps that were taken in each row's episode; where they go does not depend on earlier episodes."""

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        if len(rows) != len(self._known):
            self._known = torch.zeros(len(rows), self.size, device=rows.device)
            self._taken = torch.zeros_like(rows, dtype=torch.long)
            self._latents = self._actions = self._errors = torch.empty(0, 0, 0, device=rows.device)
        self._known[rows], self._taken[rows] = 0, 0

    def observe(self, latents: Tensor) -> None:
        """The latents [B, D] that the last actions led to."""
        if self._latents.shape[:2] != self._known.shape:
            return
        row, slot = torch.arange(len(latents), device=latents.device), (self._taken - 1) % self.size
        error = latents - self._step(self._latents[row, slot], self._actions[row, slot])
        counts = (self._taken > 0) & (error.norm(dim=-1) > self._least)
        self._errors[row, slot] = torch.where(counts.unsqueeze(-1), error, 0)
        self._known[row, slot] = counts.float()

    def acted(self, latents: Tensor, actions: Tensor) -> None:
        """The actions [B, A] in [-1, 1] that are taken from latents [B, D] now."""
        if self._latents.shape[1:] != (self.size, latents.shape[1]):
            self._latents = latents.new_zeros(len(latents), self.size, latents.shape[1])
            self._errors = torch.zeros_like(self._latents)
            self._actions = actions.new_zeros(len(actions), self.size, actions.shape[1])
        row, slot = torch.arange(len(latents), device=latents.device), self._taken % self.size
        self._latents[row, slot], self._actions[row, slot], self._known[row, slot] = latents, actions, 0
        self._taken += 1

    def of_rows(self, rows: Tensor) -> Step:
        """h as each of `rows` int64 [P] corrects it for its own queries: `[P, K, D], [P, K, A] → [P, K, D]`."""
        known = self._known[rows]
        if not known.any():
            return self._step
        memory = self._latents[rows], self._actions[rows], self._errors[rows], known.unsqueeze(1)
        return lambda latents, actions: self._corrected(latents, actions, *memory)

    def of_row(self, row: int) -> Step | None:
        """h as one row corrects it, `[R, D], [R, A] → [R, D]`; None where it has nothing to correct."""
        known = self._known[row] > 0
        if not known.any():
            return None
        memory = self._latents[row, known], self._actions[row, known], self._errors[row, known]
        ones = torch.ones(1, int(known.sum()), device=known.device)
        return lambda latents, actions: self._corrected(latents, actions, *memory, ones)

    def _corrected(
        self, latents: Tensor, actions: Tensor, places: Tensor, taken: Tensor, errors: Tensor, counts: Tensor
    ) -> Tensor:
        """h with the errors [*, M, D] made at `places` [*, M, D] by `taken` [*, M, A], of which `counts` [*, 1, M] count."""
        off, turned = torch.cdist(latents, places) / self._width, torch.cdist(actions, taken) / self.ACTION_WIDTH
        weight = (-(off.square() + turned.square())).exp() * counts
        return self._step(latents, actions) + weight @ errors / weight.sum(-1, keepdim=True).clamp(min=1)
