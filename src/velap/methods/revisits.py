"""What standing somewhere before says about the promises made there (ours).

B environments, M steps remembered, D latent dimensions.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Value = Callable[[Tensor], Tensor]
"""Q^g: `[*, D] → [*]` [Q-value]."""


class Revisits:
    """Q^g lowered around the states that the episode has been in: each moves the goal away by some steps.

    A state that promises the goal and does not keep it holds the robot until the time is up: plans end there again and
    again, and π^g takes over there for nothing. As in learning real-time A* (Korf, 1990) the promise is corrected while the
    robot stays, and another way becomes the better one. One that gets on leaves its past behind and pays little.
    """

    def __init__(self, penalty: float, step_distance: float, discount: float) -> None:
        self._penalty, self._discount = penalty, discount
        self._width = max(step_distance, 1e-6)
        """Width of the kernel [latent distance], one step."""
        self._visited: list[list[Tensor]] = []

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        if len(rows) != len(self._visited):
            self._visited = [[] for _ in range(len(rows))]
        for row in rows.nonzero().flatten().tolist():
            self._visited[row] = []

    def observe(self, latents: Tensor, values: Tensor) -> Tensor:
        """Values [B] at the latents [B, D] after their correction; the latents count from now on."""
        corrected = [self._lowered(row, latents[row : row + 1], values[row : row + 1]) for row in range(len(latents))]
        for visited, latent in zip(self._visited, latents, strict=True):
            visited.append(latent.clone())
        return torch.cat(corrected)

    def of_row(self, row: int, value: Value) -> Value | None:
        """Q^g as the row's episode corrects it; None before it has been anywhere."""
        if not self._visited[row]:
            return None
        return lambda latents: self._lowered(row, latents, value(latents))

    def _lowered(self, row: int, latents: Tensor, values: Tensor) -> Tensor:
        """values [*] of latents [*, D], times γ for every step that the visits cost."""
        if not self._visited[row]:
            return values
        visited = torch.stack(self._visited[row])
        distance = torch.cdist(latents.reshape(-1, latents.shape[-1]), visited) / self._width
        steps = self._penalty * torch.exp(-distance.square() / 2).sum(1)
        return values * (self._discount**steps).view(values.shape)
