"""An agent that looks at the current state only: what TD3-BC, BC and IQL act by.

B environments, N stacked frames, D latent, A action dimension.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from velap.methods.base import State, checked_starts
from velap.methods.states import StateEncoder

if TYPE_CHECKING:
    from velap.models.velap import LatentModel


class ReactiveAgent:
    """One policy of the latent state at every step: π^g of the joint checkpoint (TD3-BC, D.2), or a head's (D.1, D.3)."""

    def __init__(self, method: str, model: LatentModel, policy: Callable[[Tensor], Tensor]) -> None:
        """`policy` maps latents [B, D] to actions [B, A] in [-1, 1]."""
        self.method = method
        self.frame_stack = model.config.frame_stack
        self.last_plan_ms: NDArray[np.float64] = np.empty(0)
        self._policy = policy
        self._states = StateEncoder(model)

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        """Forget the actions taken, where the state holds them: the policy is a function of the state."""
        mask, _ = checked_starts(mask, seeds)
        self._states.forget(mask)
        self.last_plan_ms = np.full(len(mask), np.nan)

    @torch.inference_mode()
    def act(self, frames: NDArray[np.uint8], state: State = None) -> NDArray[np.float32]:
        """Frames [B, N, H, W, 3] -> actions [B, A]."""
        frames = self._states.checked(frames, state)
        if len(frames) != len(self.last_plan_ms):
            self.reset(np.ones(len(frames), bool))
        return self._states.act(self._policy(self._states(frames, state)))
