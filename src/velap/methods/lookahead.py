"""How a row gets to its next waypoint: π^l, or the best of it and of sampled actions under the dynamics (ours).

P rows, S sampled actions, D latent, A action dimension, m noise dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.models.velap import LatentModel
from velap.search.simulation import snaps
from velap.search.types import SearchFns

LocalPolicy = Callable[[SearchFns, Tensor, Tensor, Sequence[torch.Generator]], Tensor]
"""The model, latents [P, D], waypoints [P, D], a generator a row → actions [P, A] in [-1, 1]."""
SAMPLES = 32
"""S, actions drawn from g. ours."""
HELD = 3
"""How long an action is held in simulation [steps]. ours."""
GAIN = 2.0
"""How much stronger the actions are that compete besides. ours."""


def local_policy_of(config: PlannerConfig, model: LatentModel, fns: SearchFns) -> LocalPolicy:
    """π^l, with lookahead where the search snaps: h leads nowhere there that is not real."""
    if not snaps(fns, config):
        return lambda fns, latents, waypoints, generators: model.act_local(latents, waypoints)
    return Lookahead(model)


class Lookahead:
    """Every action is held for a few steps of h; the one whose end reaches the waypoint with the highest Q_min wins.

    π^l pushes into walls at corners that h knows of. g and π^l are as slow as the data: each action competes at `GAIN` times
    its size as well, clipped to the limits.
    """

    def __init__(self, model: LatentModel) -> None:
        self._act_local = model.act_local

    def __call__(
        self, fns: SearchFns, latents: Tensor, waypoints: Tensor, generators: Sequence[torch.Generator]
    ) -> Tensor:
        """The best actions [P, A]."""
        drawn = [torch.randn((SAMPLES, fns.noise_dim), generator=generator) for generator in generators]
        sampled = fns.propose(latents.unsqueeze(1).expand(-1, SAMPLES, -1), torch.stack(drawn).to(latents))
        actions = torch.cat([self._act_local(latents, waypoints).unsqueeze(1), sampled], 1)
        actions = torch.cat([actions, (GAIN * actions).clamp(-1, 1)], 1)
        ends = simulate_held(fns, latents, actions, HELD)
        q_min, _ = fns.reach(ends, waypoints.unsqueeze(1).expand_as(ends))
        return actions[torch.arange(len(actions), device=actions.device), q_min.argmax(1)]


def simulate_held(fns: SearchFns, latents: Tensor, actions: Tensor, count: int) -> Tensor:
    """Where `count` steps of each of `actions` [B, S, A] lead from latents [B, D]: [B, S, D]."""
    ends = latents.unsqueeze(1).expand(-1, actions.shape[1], -1)
    for _ in range(count):
        ends = fns.step(ends, actions)
    return ends
