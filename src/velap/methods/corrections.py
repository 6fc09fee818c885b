"""What the episode so far corrects in the model that its plans and its controller use (ours).

A correction wraps the callables of the search: `in_row` for all queries of one row, such as those of its plan; `in_rows` for
one or several queries of each of some rows.

B environments, P rows that ask, K queries a row, M steps remembered, R points, D latent dimensions, A action dimensions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod

import torch
from torch import Tensor

from velap.config.planning import ControllerConfig
from velap.search.types import SearchFns


class Correction(ABC):
    """Wraps the model by what the rows' episodes have shown. A row's wrapper depends on its own episode alone."""

    @abstractmethod
    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""

    @abstractmethod
    def observe(self, latents: Tensor) -> None:
        """The latents [B, D] that the last actions led to."""

    def acted(self, latents: Tensor, actions: Tensor) -> None:  # noqa: B027 - most corrections need not know
        """The actions [B, A] in [-1, 1] that are taken from latents [B, D] now."""

    @abstractmethod
    def in_row(self, fns: SearchFns, row: int) -> SearchFns:
        """The model as one row corrects it, for `[R, D]`; `fns` itself where there is nothing to correct."""

    @abstractmethod
    def in_rows(self, fns: SearchFns, rows: Tensor) -> SearchFns:
        """The model as each of `rows` int64 [P] corrects it for its own queries, values of `[P, D]` and steps from
        `[P, K, D]`; `fns` itself where there is nothing to correct."""


def corrections_of(config: ControllerConfig, fns: SearchFns) -> list[Correction]:
    """The corrections that a config asks for."""
    wanted: list[Correction] = []
    if config.residuals > 0:
        wanted.append(Residuals(config.residuals, fns))
    if config.revisit_penalty > 0:
        wanted.append(Revisits(config.revisit_penalty, fns))
    return wanted


class Residuals(Correction):
    """h corrected by its own errors: after a few pushes against a wall that h does not know, the model predicts that the
    block stays.

    The error of every step that was taken is remembered with its latent and action, and added to predictions from nearby
    latents by similar actions, weighted by a Gaussian kernel.
    """

    LATENT_WIDTH = 1.0
    """Width of the kernel over latents [one-step lengths]."""
    ACTION_WIDTH = 0.5
    """Width of the kernel over actions in [-1, 1]."""
    LEAST_ERROR = 0.4
    """Smaller errors are not corrected [one-step lengths]."""

    def __init__(self, size: int, fns: SearchFns) -> None:
        self.size = size
        """M, steps remembered."""
        self._step = fns.step
        self._width = self.LATENT_WIDTH * max(fns.step_distance, 1e-6)
        self._least = self.LEAST_ERROR * max(fns.step_distance, 1e-6)
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
        """The latents [B, D] that the last actions led to; h's errors are remembered."""
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

    def in_row(self, fns: SearchFns, row: int) -> SearchFns:
        """h as one row corrects it: `[R, D], [R, A] → [R, D]`."""
        known = self._known[row] > 0
        if not known.any():
            return fns
        memory = self._latents[row, known], self._actions[row, known], self._errors[row, known]
        return self._wrapped(fns, *memory, torch.ones(1, int(known.sum()), device=known.device))

    def in_rows(self, fns: SearchFns, rows: Tensor) -> SearchFns:
        """h as each of `rows` int64 [P] corrects it: `[P, K, D], [P, K, A] → [P, K, D]`."""
        known = self._known[rows]
        if not known.any():
            return fns
        return self._wrapped(fns, self._latents[rows], self._actions[rows], self._errors[rows], known.unsqueeze(1))

    def _wrapped(self, fns: SearchFns, places: Tensor, taken: Tensor, errors: Tensor, counts: Tensor) -> SearchFns:
        """h with the errors [*, M, D] made at `places` [*, M, D] by `taken` [*, M, A], of which `counts` [*, 1, M] count."""

        def step(latents: Tensor, actions: Tensor) -> Tensor:
            off, turned = torch.cdist(latents, places) / self._width, torch.cdist(actions, taken) / self.ACTION_WIDTH
            weight = (-(off.square() + turned.square())).exp() * counts
            return fns.step(latents, actions) + weight @ errors / weight.sum(-1, keepdim=True).clamp(min=1)

        return fns._replace(step=step, rollout=None)


class Revisits(Correction):
    """Q^g lowered around the states that the episode has been in: each moves the goal away by some steps.

    A state whose Q^g is too high holds the robot until time is up: plans keep ending there, and π^g takes over in vain. As
    in learning real-time A* (Korf, 1990), the estimate is corrected while the robot stays, until another way is better. A
    robot that moves on leaves its visits behind and pays little.
    """

    def __init__(self, penalty: float, fns: SearchFns) -> None:
        self._penalty, self._discount = penalty, fns.discount
        self._width = max(fns.step_distance, 1e-6)
        """Width of the kernel [latent distance], one step."""
        self._visited: list[list[Tensor]] = []

    def forget(self, rows: Tensor) -> None:
        """Start new episodes in `rows`, bool [B]."""
        if len(rows) != len(self._visited):
            self._visited = [[] for _ in range(len(rows))]
        for row in rows.nonzero().flatten().tolist():
            self._visited[row] = []

    def observe(self, latents: Tensor) -> None:
        """The latents [B, D] count as visited from now on."""
        for visited, latent in zip(self._visited, latents, strict=True):
            visited.append(latent.clone())

    def in_row(self, fns: SearchFns, row: int) -> SearchFns:
        """Q^g as one row corrects it: `[*, D] → [*]`."""
        if not self._visited[row]:
            return fns
        return fns._replace(value=lambda latents: self._lowered(row, latents, fns.value(latents)))

    def in_rows(self, fns: SearchFns, rows: Tensor) -> SearchFns:
        """Q^g as each of `rows` int64 [P] corrects it: `[P, D] → [P]`."""

        def value(latents: Tensor) -> Tensor:
            values = fns.value(latents)
            singles = zip(rows.tolist(), latents.split(1), values.split(1), strict=True)
            return torch.cat([self._lowered(*single) for single in singles])

        return fns._replace(value=value)

    def _lowered(self, row: int, latents: Tensor, values: Tensor) -> Tensor:
        """values [*] of latents [*, D], times γ for every step that the visits cost."""
        if not self._visited[row]:
            return values
        visited = torch.stack(self._visited[row])
        distance = torch.cdist(latents.reshape(-1, latents.shape[-1]), visited) / self._width
        steps = self._penalty * torch.exp(-distance.square() / 2).sum(1)
        return values * (self._discount**steps).view(values.shape)
