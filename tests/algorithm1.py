"""Algorithm 1, Eq. 6-8 in plain Python, one candidate at a time, as the paper states them: the search's reference.

With `candidates` above 1 it is the batch processing of App. B.6: the distribution of Eq. 6-7 is renewed once a round.
"""

from __future__ import annotations

import math

import torch

from velap.config.planning import PlannerConfig
from velap.search.sampling import TEMPERATURE_SPARSE, TEMPERATURE_VALUE, Noise
from velap.search.types import SearchFns


def reference_plan(fns: SearchFns, root: torch.Tensor, cfg: PlannerConfig, noise: Noise) -> dict[str, list]:
    """Tree and path for one root [D] from the first row of the noise."""
    gamma, low = fns.discount, cfg.n_sim if cfg.discard_low_exponent is None else cfg.discard_low_exponent
    tau_std = 1 - gamma
    q_min = lambda start, end: float(fns.reach(start, end)[0])  # noqa: E731
    nodes, parents, values, steps, counts, expansions = [root], [-1], [float(fns.value(root))], [0.0], [0], [0]
    for i in range(cfg.n_iter):
        if i % cfg.candidates == 0:
            crowding = [n + e * (cfg.anchor == "snap") for n, e in zip(counts, expansions, strict=True)]
            sparse = [math.exp(-n / TEMPERATURE_SPARSE) for n in crowding]
            value = [math.exp(q / TEMPERATURE_VALUE) for q in values]
            uniform = 1 - cfg.p_sparse - cfg.p_value
            weights = [cfg.p_sparse * s / sum(sparse) + cfg.p_value * v / sum(value) + uniform / len(nodes)
                       for s, v in zip(sparse, value, strict=True)]
        target, exp = float(noise.node[0, i]) * sum(weights), 0
        while exp < len(weights) - 1 and sum(weights[: exp + 1]) <= target:
            exp += 1
        expansions[exp] += 1
        new = nodes[exp]
        for step in range(cfg.n_sim):
            by_policy = float(noise.policy[0, i]) < cfg.p_policy
            draw = noise.action[0, i, 0 if cfg.coherent_noise else step]
            new = fns.step(new, fns.act_global(new) if by_policy else fns.propose(new, draw))
        edge, std = (float(x) for x in fns.reach(nodes[exp], new))
        near = [j for j, node in enumerate(nodes) if float((node - new).norm()) <= fns.d_neigh]
        if not (edge > gamma**low and std < tau_std):
            continue
        if max([edge] + [q_min(nodes[j], new) for j in near]) >= gamma**cfg.discard_high_exponent:
            continue
        for j in near:
            counts[j] += q_min(new, nodes[j]) > gamma**cfg.neighbour_exponent
        counts.append(sum(q_min(nodes[j], new) > gamma**cfg.neighbour_exponent for j in near))
        nodes.append(new)
        parents.append(exp)
        expansions.append(0)
        values.append(float(fns.value(new)))
        steps.append(steps[exp] + math.log(edge) / math.log(gamma))
    goals = [i for i, q in enumerate(values) if q > gamma**cfg.goal_exponent]
    leaf = min(goals, key=steps.__getitem__) if goals else max(range(len(nodes)), key=values.__getitem__)
    path = [leaf]
    while path[-1]:
        path.append(parents[path[-1]])
    return {"nodes": nodes, "parents": parents, "values": values, "steps": steps, "counts": counts, "path": path[::-1],
            "goals": goals, "expansions": expansions}
