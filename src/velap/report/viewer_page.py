"""The page of `velap view`: one self-contained HTML file that makes no network request.

P states of a backdrop, D latent dimensions, M nodes of a tree, L waypoints, T steps.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from sklearn.decomposition import PCA

from velap.errors import ConfigError
from velap.methods.tree_agent import IN_WORDS
from velap.models.horizon import q_from_steps
from velap.report.figures import NEIGHBOURS, RealStates, fit_isomap
from velap.report.viewer import SIDE, MadePlan, Subject, Trace
from velap.search.types import SearchFns

Projection = Literal["isomap", "pca"]
TEMPLATE, MARK = "viewer.html", "{{DATA}}"
LARGEST = 10_000_000
"""Largest size of a page [bytes]."""
SIDES = (SIDE, 128, 64)
"""Sides of the pictures, tried in turn until the page is small enough [px]."""
QUALITY = 80
"""WebP quality of pictures of the world."""
GRID = 1000
"""Largest coordinate of the latent map."""
DIGITS = 4
"""Decimal places of Q-values."""


def page(subject: Subject, trace: Trace, backdrop: RealStates | None, projection: Projection = "isomap") -> str:
    """The HTML text; raises ConfigError for an episode that does not fit into LARGEST bytes."""
    template = files("velap.report").joinpath(TEMPLATE).read_text(encoding="utf-8")
    data = episode_data(subject, trace, backdrop, projection)
    for side in SIDES:
        data["frames"] = [_webp(image, side) for image in (*(step.picture for step in trace.steps), trace.last_picture)]
        text = template.replace(MARK, json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))
        if len(text.encode()) <= LARGEST:
            return text
    raise ConfigError(f"the page of {len(trace.steps)} steps and {len(trace.plans)} plans takes {len(text.encode()):,} "
                      f"bytes; expected at most {LARGEST:,}. View a shorter episode, with --max-steps.")


def episode_data(subject: Subject, trace: Trace, backdrop: RealStates | None, projection: Projection) -> dict[str, Any]:
    """All data of the page except the pictures of the world."""
    player, outcome = subject.player, trace.outcome
    config, key = player.config, player.key
    trail = [step.latent for step in trace.steps if step.latent is not None]
    around = np.empty(0, np.float32) if backdrop is None else backdrop.latents
    groups = [np.array(trail), around, *(plan.latents for plan in trace.plans)]
    plane, (trail_points, around_points, *plan_points) = _in_one_plane(groups, backdrop, projection)
    ended = "solved" if outcome.success else "not solved"
    discount = None if player.model is None else _functions(subject).discount
    return {
        "title": f"{key.task}, episode of seed {outcome.seed}: {ended} in {outcome.steps} steps",
        "about": f"method {key.method}, preset {key.preset}, training seed {key.train_seed}, weights "
                 f"{key.checkpoint[:12] or 'none'}, velap {key.code_version}",
        "success": outcome.success,
        "values": [None if step.value is None else round(step.value, DIGITS) for step in trace.steps],
        "actors": [step.actor for step in trace.steps],
        "waypoints": [step.waypoint for step in trace.steps],
        "plan_of": [step.plan for step in trace.steps],
        "in_words": IN_WORDS,
        "stop_value": None if discount is None else q_from_steps(config.controller.stop_exponent, discount),
        "discount": discount,
        "trail": trail_points,
        "backdrop": None if backdrop is None else {"source": backdrop.source, "points": around_points,
                                                   "values": _values(subject, backdrop.latents)},
        "projection": plane,
        "plans": [_plan_data(subject, *each, backdrop) for each in zip(trace.plans, plan_points, strict=True)],
        "tiles": _tiles(trace.plans, backdrop),
        "records": [{"seed": record.episode_seed, "success": record.success, "steps": record.steps}
                    for record in subject.records],
        "seed": outcome.seed,
    }


def _plan_data(subject: Subject, plan: MadePlan, points: list[list[int]], backdrop: RealStates | None) -> dict[str, Any]:
    values = _values(subject, plan.latents)
    strip: list[dict[str, Any]] = []
    if backdrop is not None and len(backdrop.frames):
        found, away = backdrop.nearest(plan.waypoints)
        unit = _functions(subject).step_distance or 1.0
        # one-step distances are the planner's: the upper 5-percentile in the data
        strip = [{"tile": int(number), "away": round(float(distance) / unit, 1)}
                 for number, distance in zip(found, away, strict=True)]
    return {"step": plan.step, "points": points, "parents": plan.parents.tolist(), "values": values,
            "path": plan.path.tolist(), "reached": plan.reached_goal, "ms": round(plan.milliseconds, 2),
            "cost": None if plan.cost is None or not np.isfinite(plan.cost) else round(plan.cost, 1), "strip": strip}


def _functions(subject: Subject) -> SearchFns:
    """The model as the planner sees it."""
    assert subject.player.model is not None
    return subject.player.model.search_fns()


@torch.inference_mode()
def _values(subject: Subject, latents: NDArray[np.float32]) -> list[float]:
    """Q^g of latents [*, D]."""
    assert subject.player.model is not None
    weight = next(subject.player.model.parameters())
    values = _functions(subject).value(torch.from_numpy(latents).to(weight.device, weight.dtype))
    return [round(float(value), DIGITS) for value in values.double().cpu().numpy()]


def _tiles(plans: Sequence[MadePlan], backdrop: RealStates | None) -> dict[int, str]:
    """Frames of the backdrop that appear in film strips, as data URIs by number."""
    if backdrop is None or not len(backdrop.frames):
        return {}
    shown = {int(number) for plan in plans for number in backdrop.nearest(plan.waypoints)[0]}
    return {number: _webp(backdrop.frames[number], backdrop.frames.shape[1], lossless=True) for number in sorted(shown)}


def _webp(image: NDArray[np.uint8], side: int, lossless: bool = False) -> str:
    """A picture of that height as a data URI."""
    content, picture = io.BytesIO(), Image.fromarray(image)
    size = (round(side * image.shape[1] / image.shape[0]), side)
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BOX)
    picture.save(content, "WEBP", quality=QUALITY, lossless=lossless)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


def _in_one_plane(groups: Sequence[NDArray[np.float32]], backdrop: RealStates | None,
                  projection: Projection) -> tuple[str, list[list[list[int]]]]:
    """Groups of latents [*, D] as whole coordinates from 0 to GRID of one plane, and its name. The plane fits the backdrop,
    or without one all latents.

    Both axes have one scale, so that distances keep their proportions.
    """
    isomap = projection == "isomap" and backdrop is not None and len(backdrop.latents) > 10 * NEIGHBOURS
    everything = np.concatenate([group for group in groups if len(group)] or [np.zeros((1, 2), np.float32)])
    fitted, points = everything if backdrop is None else backdrop.latents, np.zeros((len(everything), 2))
    if len(fitted) > 1:
        plane = fit_isomap(fitted) if isomap else PCA(2).fit(fitted)
        points = plane.transform(everything)
    size = np.ptp(points, axis=0)
    scale = GRID / max(float(size.max()), 1e-9)
    whole = ((points - points.min(axis=0)) * scale + (GRID - size * scale) / 2).round().astype(np.int64)
    split = np.split(whole, np.cumsum([len(group) for group in groups])[:-1])
    return "Isomap" if isomap else "principal components", [part.tolist() for part in split]
