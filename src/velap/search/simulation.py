"""The model ahead of a tree: simulated expansions (Alg. 1, l. 5-10), anchors, and Q^g where it is needed.

K candidates of B trees, D latent, m noise dimension.
"""

from __future__ import annotations

import torch
from torch import Tensor

from velap.config.planning import PlannerConfig
from velap.errors import ConfigError
from velap.search.sampling import Noise
from velap.search.types import SearchFns

ANCHOR_FACTOR = 1.0
"""Largest distance of a candidate to a dataset latent, in upper 5-percentiles of one-step distances. ours."""


def packs(z: Tensor) -> bool:
    """Whether shapes may depend on data: on a CPU outside of a compiled graph.

    The networks then see only the rows that matter, trees are looked at as far as they are filled, and loops stop when they
    are done. That changes no result, costs nothing there, and saves most of the critics' work.
    """
    return z.device.type == "cpu" and not torch.compiler.is_compiling()


def simulate(fns: SearchFns, z: Tensor, noise: Noise, cfg: PlannerConfig) -> Tensor:
    """Latents [B, K, D] n_sim steps after z [B, K, D], by π^g where the noise says so, else by g (Alg. 1, l. 5-10)."""
    by_policy = noise.policy < cfg.p_policy
    if packs(z):
        return _simulate_packed(fns, z, noise.action, by_policy, cfg.n_sim)
    for step in range(cfg.n_sim):  # l. 7
        proposed = fns.propose(z, noise.action[:, :, min(step, noise.action.shape[2] - 1)])  # l. 8
        z = fns.step(z, torch.where(by_policy.unsqueeze(-1), fns.act_global(z), proposed))  # l. 9
    return z


def _simulate_packed(fns: SearchFns, z: Tensor, noise: Tensor, by_policy: Tensor, n_sim: int) -> Tensor:
    """`simulate` with the rows of π^g moved to the front, so that each model sees its own rows only."""
    order = by_policy.flatten().argsort(descending=True)
    split, steps = int(by_policy.sum()), noise.shape[2]
    rows = z.flatten(0, 1).index_select(0, order)
    noise = noise.flatten(0, 1).index_select(0, order[split:])
    for step in range(0 if fns.rollout is not None else n_sim):
        actions = []
        if split > 0:
            actions.append(fns.act_global(rows[:split]))
        if split < len(rows):
            actions.append(fns.propose(rows[split:], noise[:, min(step, steps - 1)]))
        rows = fns.step(rows, torch.cat(actions))
    if fns.rollout is not None:
        parts = (rows[:split], None), (rows[split:], noise)
        rows = torch.cat([fns.rollout(part, drawn, n_sim) for part, drawn in parts if len(part)])
    return torch.empty_like(rows).index_copy_(0, order, rows).view_as(z)


def snaps(fns: SearchFns, cfg: PlannerConfig) -> bool:
    """Whether candidates move to the dataset's latents (ours)."""
    return cfg.anchor == "snap" or (cfg.anchor == "auto" and fns.snaps)


def anchored(fns: SearchFns, z: Tensor, cfg: PlannerConfig) -> tuple[Tensor, Tensor]:
    """Candidates [B, K, D] after anchoring to the dataset's latents, and which of them [B, K] bool are supported (ours)."""
    if not snaps(fns, cfg):
        return z, torch.ones(z.shape[:-1], dtype=torch.bool, device=z.device)
    if fns.project is None:
        raise ConfigError(f"config field `anchor` is {cfg.anchor!r}, but the model keeps no dataset latents; "
                          "expected 'none'. Train with `bank_size` above 0 or set `anchor` to 'none'.")
    nearest, distance = fns.project(z)
    return nearest, distance <= ANCHOR_FACTOR * fns.step_distance


def value_where(fns: SearchFns, z: Tensor, mask: Tensor) -> Tensor:
    """Q^g [B, K] of z [B, K, D]; where rows can be picked, -inf outside the mask [B, K]."""
    if not packs(z):
        return fns.value(z)
    values = z.new_full(mask.shape, -torch.inf)
    chosen = mask.flatten().nonzero().squeeze(1)
    if len(chosen):
        values.view(-1).index_copy_(0, chosen, fns.value(z.flatten(0, 1).index_select(0, chosen)).to(values.dtype))
    return values
