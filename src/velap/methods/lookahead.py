"""How a row gets to its next waypoint: π^l, or the best of it and of sampled actions under the dynamics (ours).

P rows, S sampled actions, D latent, A action dimension, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from velap.config.planning import ControllerConfig
from velap.models.velap import LatentModel
from velap.search.types import SearchFns

LocalPolicy = Callable[[SearchFns, Tensor, Tensor, Sequence[torch.Generator]], Tensor]
"""The model, latents [P, D], waypoints [P, D], a generator a row → actions [P, A] in [-1, 1]."""
SAMPLES = 32
"""S, actions drawn from g. ours."""


def local_policy_of(config: ControllerConfig, model: LatentModel) -> LocalPolicy:
    """π^l, with lookahead where the config asks for it."""
    if config.lookahead == 0:
        return lambda fns, latents, waypoints, generators: model.act_local(latents, waypoints)
    return Lookahead(model, config.lookahead, config.lookahead_gain)


class Lookahead:
    """Every action is held for a few steps of h; the one whose end reaches the waypoint with the highest Q_min wins.

    π^l pushes into walls at corners that h knows of.
    """

    def __init__(self, model: LatentModel, count: int, gain: float) -> None:
        """`count` [steps] is as long as an action is held; with a `gain` above 1 stronger actions compete as well."""
        self._act_local, self._count, self._gain = model.act_local, count, gain

    def __call__(
        self, fns: SearchFns, latents: Tensor, waypoints: Tensor, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """The best actions [P, A]."""
        drawn = [torch.randn((SAMPLES, fns.noise_dim), generator=generator) for generator in generators]
        sampled = fns.propose(latents.unsqueeze(1).expand(-1, SAMPLES, -1), torch.stack(drawn).to(latents))
        actions = torch.cat([self._act_local(latents, waypoints).unsqueeze(1), sampled], 1)
        if self._gain != 1:
            actions = torch.cat([actions, (self._gain * actions).clamp(-1, 1)], 1)
        ends = simulate_held(fns, latents, actions, self._count)
        q_min, _ = fns.reach(ends, waypoints.unsqueeze(1).expand_as(ends))
        return actions[torch.arange(len(actions), device=actions.device), q_min.argmax(1)]


def simulate_held(fns: SearchFns, latents: Tensor, actions: Tensor, count: int) -> Tensor:
    """Where `count` steps of each of `actions` [B, S, A] lead from latents [B, D]: [B, S, D]."""
    ends = latents.unsqueeze(1).expand(-1, actions.shape[1], -1)
    for _ in range(count):
        ends = fns.step(ends, actions)
    return ends
