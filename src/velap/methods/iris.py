"""IRIS (Mandlekar et al. 2020) on frozen latents, and its multi-step extension (App. D.6, D.7).

The appendix on IRIS is empty, so this follows §5.1: a manager samples subgoals n steps ahead from a cVAE, the value picks
one, a worker heads for it for n steps.

B environments, P rows that plan at one step, D latent, A action dimension.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.planning import PlanningAgent
from velap.search.manager import IRISConfig, choose_subgoal
from velap.search.sampling import normal

if TYPE_CHECKING:
    from velap.models.heads import SubgoalHead
    from velap.models.velap import LatentModel


class IRISAgent(PlanningAgent):
    """Every `head.horizon` steps the manager picks a subgoal; in between the worker acts towards it."""

    def __init__(self, method: str, model: LatentModel, frame_stack: int, head: SubgoalHead, settings: IRISConfig) -> None:
        super().__init__(model, frame_stack, head.horizon)
        self.method = method
        self._head = head
        self._settings = settings
        self._subgoals: Tensor | None = None

    def subgoal(self, row: int) -> Tensor:
        """[D] the subgoal that `row` heads for."""
        assert self._subgoals is not None, "no row has planned yet"
        return self._subgoals[row].clone()

    def _allocate(self, batch: int) -> None:
        self._subgoals = None

    def _forget(self, row: int) -> None:
        pass

    def _plan(self, rows: NDArray[np.int64], latents: Tensor, generators: list[torch.Generator]) -> None:
        shape = (self._settings.samples, self._settings.rollout, self._head.noise_dim)
        chosen = choose_subgoal(self._head.propose, self._model.value, latents, normal(shape, latents, generators))
        if self._subgoals is None:
            self._subgoals = latents.new_zeros(len(self._age), latents.shape[-1])
        self._subgoals[torch.from_numpy(rows).to(self._device)] = chosen

    def _follow(self, latents: Tensor) -> Tensor:
        assert self._subgoals is not None, "every row has planned"
        return self._head.act(latents, self._subgoals)
