"""Shooting baselines as agents: MPPI (App. D.4) and MBOP (App. D.5), replanned every few steps.

B environments, P rows that plan at one step, H horizon [steps], D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.errors import ConfigError
from velap.methods.planning import PlanningAgent
from velap.search.shooting import ShootingConfig, Shot, shift_mean
from velap.search.types import RowGenerator, SearchFns

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


ConfigT = TypeVar("ConfigT", bound=ShootingConfig)
Shoot = Callable[[SearchFns, Tensor, ConfigT, RowGenerator, Tensor | None], Shot]
"""The model, latents [P, D], how to plan, generators, and the shifted means [P, H, A] of the plans before -> new plans."""


class MPCAgent(PlanningAgent):
    """Executes the first `replan_every` actions of a shot, then optimises again from the shifted mean.

    Both methods start a plan from the one before: TD-MPC shifts the mean (its `prev_mean`; the deviation starts wide again),
    MBOP mixes with the shifted previous trajectory (Alg. 3). The first plan of an episode starts from zeros.
    """

    def __init__(self, method: str, model: LatentModel, planner: ConfigT, shoot: Shoot[ConfigT]) -> None:
        if planner.replan_every > planner.horizon:
            raise ConfigError(f"`replan_every` is {planner.replan_every} and `horizon` {planner.horizon} steps; expected a "
                              "plan as long as what is executed of it. Change one of them.")
        super().__init__(method, model, planner.replan_every)
        self._planner: ShootingConfig = planner
        self._shoot: Shoot[Any] = shoot
        self._fns = model.search_fns(hidden=planner.arithmetic)
        self._actions = torch.empty(0)
        self._mean = torch.empty(0)

    def _allocate(self, batch: int) -> None:
        shape = (batch, self._planner.horizon, self._model.action_dim)
        dtype = next(self._model.parameters()).dtype
        self._actions = torch.zeros(shape, dtype=dtype, device=self._device)
        self._mean = torch.zeros_like(self._actions)

    def _forget(self, row: int) -> None:
        self._mean[row] = 0

    def _plan(self, rows: NDArray[np.int64], latents: Tensor, generators: list[torch.Generator]) -> None:
        index = torch.from_numpy(rows).to(self._device)
        shot = self._shoot(self._fns, latents, self._planner, generators, self._mean[index])
        self._actions[index] = shot.actions
        self._mean[index] = shift_mean(shot.mean, self._planner.replan_every)

    def _follow(self, latents: Tensor) -> Tensor:
        step = torch.from_numpy(self._age).to(self._device)
        return self._actions[torch.arange(len(latents), device=self._device), step]
