"""A planner of another package: no tree, but the way that π^g takes under the model."""

import torch

import velap
from velap.search.types import Path


@velap.register_planner("greedy")
def plan(fns, z_root, cfg, generator):
    z, waypoints = z_root, [z_root]
    for _ in range(5):
        for _ in range(cfg.n_sim):
            z = fns.step(z, fns.act_global(z))
        waypoints.append(z)
    return Path(torch.stack(waypoints, 1), torch.full((len(z_root),), len(waypoints), device=z.device))
