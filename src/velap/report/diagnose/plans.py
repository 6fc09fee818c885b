"""What `velap diagnose` measures of plans: trees from several starts, and distances of their nodes to real states.

B starts, N stacked frames, H x W pixels, D latent dimensions, M nodes of a tree, L waypoints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from velap.config import Config
from velap.methods.provenance import search_of
from velap.models.horizon import q_from_steps
from velap.models.velap import LatentModel
from velap.report.figures import FilmStrip, RealStates, planned
from velap.search.types import Plan


@dataclass(frozen=True)
class Starts:
    """Where plans begin."""

    labels: tuple[str, ...]
    """[B]."""
    stacks: NDArray[np.uint8]
    """[B, N, H, W, 3]."""


@dataclass(frozen=True, kw_only=True)
class TreeNumbers:
    """One plan in numbers."""

    start: str
    nodes: int
    rejected: dict[str, int]
    """Rejected candidates by reason, a field of `velap.search.types.Rejections`."""
    start_value: float
    """Q^g at the root [Q-value]."""
    best_value: float
    """Highest Q^g in the tree [Q-value]."""
    reached_goal: bool
    waypoints: int
    """Of the chosen path, without the root."""
    cost: float
    """[steps]"""
    distance: float
    """Mean distance of the nodes to the nearest real state [one-step lengths]."""


@dataclass(frozen=True, kw_only=True)
class Trees:
    """Plans from all starts."""

    numbers: tuple[TreeNumbers, ...]
    held_out_distance: float
    """Mean distance of held-out states to the real states: the value of a real state [one-step lengths]."""
    scene_distance: float | None
    """Mean distance of the first tree's nodes to real states of their own scene [one-step lengths]; None if these are
    unknown."""
    scene_spacing: float | None
    """Mean distance of those real states to the nearest other one [one-step lengths]."""
    goal_value: float
    """τ_goal [Q-value]."""
    strip: FilmStrip
    """The plan from the first start."""


def tree_numbers(starts: Starts, result: Plan, real_states: RealStates, one_step: float) -> tuple[TreeNumbers, ...]:
    """One entry a start."""
    found = []
    for row, label in enumerate(starts.labels):
        found_plan = planned(result, row)
        values = result.tree.goal_values[row, : len(found_plan.latents)]
        found.append(TreeNumbers(
            start=label, nodes=len(values), start_value=float(values[0]), best_value=float(values.max()),
            rejected={name: int(count[row]) for name, count in result.rejections._asdict().items()},
            reached_goal=bool(result.reached_goal[row]), waypoints=len(found_plan.path) - 1, cost=float(result.cost[row]),
            distance=float(real_states.nearest(found_plan.latents)[1].mean()) / one_step))
    return tuple(found)


def plan_strip(starts: Starts, result: Plan, real_states: RealStates, one_step: float, row: int = 0) -> FilmStrip:
    """The chosen path from one start: the start frame, then the frame nearest to each waypoint."""
    chosen = planned(result, row)
    values = result.tree.goal_values[row, chosen.path].double().cpu().numpy()
    numbers, distances = real_states.nearest(chosen.waypoints)
    frames = real_states.frames[numbers]
    frames[0] = starts.stacks[row, -1]
    captions = [f"start\n$Q^g$ {values[0]:.2g}"]
    captions += [f"{number}: {distance / one_step:.1f} off\n$Q^g$ {value:.2g}"
                 for number, (distance, value) in enumerate(zip(distances[1:], values[1:], strict=True), 1)]
    return FilmStrip(title=f"Plan from {starts.labels[row]}: nearest frames of {real_states.source}, how far off they are "
                 "[one-step lengths]", frames=frames, captions=tuple(captions))


def diagnose_trees(model: LatentModel, config: Config, starts: Starts, *, seeds: Sequence[int], real_states: RealStates,
                   scenery: RealStates | None, held_out: NDArray[np.float32], one_step: float) -> Trees:
    """Plan from all starts and compare the nodes with real states.

    Args:
        model: what plans.
        config: its planner.
        starts: where from.
        seeds: [B] randomness of each plan.
        real_states: states of the dataset.
        scenery: states of the first start's own scene if known; the film strip then shows these.
        held_out: [R, D] recorded states that are not among `real_states`.
        one_step: mean distance of subsequent encodings [latent distance].
    """
    with torch.inference_mode():
        latents = model.encode(torch.from_numpy(starts.stacks).to(next(model.parameters()).device)).float()
    result = search_of(model, config)(latents, [torch.Generator().manual_seed(seed) for seed in seeds])
    scene_distance = spacing = None
    if scenery is not None:
        distances = scenery.nearest(planned(result, 0).latents)[1]
        scene_distance, spacing = float(distances.mean()) / one_step, scenery.spacing() / one_step
    return Trees(
        numbers=tree_numbers(starts, result, real_states, one_step),
        held_out_distance=float(real_states.nearest(held_out)[1].mean()) / one_step,
        scene_distance=scene_distance,
        scene_spacing=spacing,
        goal_value=q_from_steps(config.planner.goal_exponent, model.discount),
        strip=plan_strip(starts, result, scenery or real_states, one_step))
