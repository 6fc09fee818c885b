"""VELAP. Its controller follows Algorithm 2 with the settings of Table 9 (App. B.7), vectorised over environments.

Where the config's edges remember their proposers, `velap.methods.provenance` searches and acts. Here is Algorithm 2 as it is
printed, with lookahead in place of π^l alone where the search snaps.

B environments, N stacked frames, D latent dimensions, A action dimension.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.config.planning import has_provenance
from velap.methods.base import Agent, Learnt, Method, Parts, State
from velap.methods.provenance import ProvenanceAgent
from velap.methods.tree_agent import Actor, TreeAgent
from velap.registry import PLANNERS, register_method
from velap.search.est import plan
from velap.search.types import Path, Planner

if TYPE_CHECKING:
    from velap.config import Config
    from velap.models.velap import LatentModel

OWN_PLANNER = "est"
"""The planner of the paper; where edges remember their proposers, the search that does so."""


class VelapAgent(TreeAgent):
    """Plans every `n_replan` steps of a row, follows the waypoints by π^l, and hands over to π^g near the goal. The lines of
    Algorithm 2 are numbered from its "Given"."""

    def __init__(self, model: LatentModel, config: Config, planner: Planner = plan) -> None:
        super().__init__(model, config)
        self._planner, self._planner_config = planner, config.planner

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """One step of Algorithm 2: frames [B, N, H, W, 3] -> actions [B, A]."""
        z = self._observe(frames, state)  # Alg. 2, l. 2 and 12; l. 4: "goal not achieved", by B.7's proximity
        self._replan(z, (self._age >= self._n_replan) & ~self._near_goal)  # l. 5-8
        self._age += 1  # l. 13
        self.plans.advance(self._fns, z, self._reached_value)  # l. 9
        actions = self._fns.act_global(z)  # l. 10, in proximity to the goal, or where a plan of the root alone leads nowhere
        following = ~self._near_goal & (self.plans.length > 1)
        rows = torch.nonzero(following).flatten()
        if len(rows):
            actions = actions.index_copy(0, rows, self._towards_waypoints(z, rows).to(actions))  # l. 10
        self._actors = [Actor.GOAL if near else Actor.LOCAL if follows else Actor.NOWHERE
                        for near, follows in zip(self._near_goal.tolist(), following.tolist(), strict=True)]
        return self._states.act(actions)  # l. 11

    def _search(self, z: Tensor, generators: list[torch.Generator]) -> Path:
        return self._planner(self._fns, z, self._planner_config, generators)  # l. 6-7


@dataclass(frozen=True)
class VelapSettings:
    """What is chosen beside the checkpoint's `planner` and `controller`."""

    planner: str = OWN_PLANNER
    """Registered planner. Any but `est` is followed by Algorithm 2."""


@register_method("velap")
class Velap(Method):
    """One search over edges that remember their proposers, or Algorithms 1 and 2, as the config says."""

    label = "VELAP"
    settings = VelapSettings()
    whole_checkpoint = True

    def agent(self, parts: Parts) -> Agent:
        """The MPC loop around the search."""
        share = float(parts.model.success_share)
        if has_provenance(parts.config.planner, share) and parts.settings.planner == OWN_PLANNER:
            return ProvenanceAgent(parts.model, parts.config)
        return VelapAgent(parts.model, parts.config, PLANNERS[parts.settings.planner])

    def config_hash(self, config: Config, head: Learnt | None = None, settings: Any = None) -> str:
        """The config's own hash; with another planner, of that as well."""
        own = settings in (None, self.settings)
        return config.hash() if own else super().config_hash(config, head, settings)
