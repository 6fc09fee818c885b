"""The page of `velap view`: one HTML file with everything in it, which asks the network for nothing.

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
from sklearn.manifold import Isomap

from velap.errors import ConfigError
from velap.evaluation.records import Record
from velap.methods.tree_agent import IN_WORDS
from velap.models.horizon import q_from_steps
from velap.report.figures import NEIGHBOURS
from velap.report.viewer import SIDE, Backdrop, Planned, Subject, Trace
from velap.search.types import SearchFns

Projection = Literal["isomap", "pca"]
TEMPLATE, MARK = "viewer.html", "{{DATA}}"
LARGEST = 10_000_000
"""Size of a page at most [bytes]."""
SIDES = (SIDE, 128, 64)
"""Sides of the pictures that are tried until the page is small enough [px]."""
QUALITY = 80
"""Of WebP pictures of the world."""
GRID = 1000
"""Coordinates of the latent map go from 0 to this."""
DIGITS = 4
"""Of values [Q-value]."""


def page(subject: Subject, trace: Trace, backdrop: Backdrop | None, projection: Projection = "isomap") -> str:
    """The HTML text; raises ConfigError where the episode is too long for a page of LARGEST bytes."""
    template = files("velap.report").joinpath(TEMPLATE).read_text(encoding="utf-8")
    data = episode_data(subject, trace, backdrop, projection)
    for side in SIDES:
        data["frames"] = [_webp(image, side) for image in (*(step.picture for step in trace.steps), trace.last_picture)]
        text = template.replace(MARK, json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"))
        if len(text.encode()) <= LARGEST:
            return text
    raise ConfigError(f"the page of {len(trace.steps)} steps and {len(trace.plans)} plans takes {len(text.encode()):,} "
                      f"bytes; expected at most {LARGEST:,}. View a shorter episode, with --max-steps.")


def episode_data(subject: Subject, trace: Trace, backdrop: Backdrop | None, projection: Projection) -> dict[str, Any]:
    """What the page shows, but the pictures of the world."""
    player, outcome = subject.player, trace.outcome
    config, key = player.config, player.key
    flat = _Plane(trace, backdrop, projection)
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
        "trail": flat.trail,
        "backdrop": None if backdrop is None else {"source": backdrop.source, "points": flat.backdrop,
                                                   "values": _values(subject, backdrop.latents)},
        "projection": flat.name,
        "plans": [_plan_data(subject, plan, points, backdrop) for plan, points in zip(trace.plans, flat.plans, strict=True)],
        "tiles": _tiles(trace.plans, backdrop),
        "records": [_record_data(record) for record in subject.records],
        "seed": outcome.seed,
    }


def _plan_data(subject: Subject, plan: Planned, points: list[list[int]], backdrop: Backdrop | None) -> dict[str, Any]:
    values = _values(subject, plan.latents)
    strip: list[dict[str, Any]] = []
    if backdrop is not None and backdrop.frames is not None:
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


def _record_data(record: Record) -> dict[str, Any]:
    return {"seed": record.episode_seed, "success": record.success, "steps": record.steps}


def _tiles(plans: Sequence[Planned], backdrop: Backdrop | None) -> dict[int, str]:
    """Frames of the backdrop that some film strip shows, as data URIs by number."""
    if backdrop is None or backdrop.frames is None:
        return {}
    shown = {int(number) for plan in plans for number in backdrop.nearest(plan.waypoints)[0]}
    return {number: _webp(backdrop.frames[number], backdrop.frames.shape[1], lossless=True) for number in sorted(shown)}


def _webp(image: NDArray[np.uint8], side: int, lossless: bool = False) -> str:
    """A picture as a data URI."""
    content, picture = io.BytesIO(), Image.fromarray(image)
    if picture.size != (side, side):
        picture = picture.resize((side, side), Image.Resampling.BOX)
    picture.save(content, "WEBP", quality=QUALITY, lossless=lossless)
    return "data:image/webp;base64," + base64.b64encode(content.getvalue()).decode()


class _Plane:
    """All latents of the page in one plane, as whole coordinates from 0 to GRID."""

    def __init__(self, trace: Trace, backdrop: Backdrop | None, projection: Projection) -> None:
        latents = [step.latent for step in trace.steps if step.latent is not None]
        trail = np.stack(latents) if latents else np.zeros((0, 2), np.float32)
        nodes = [plan.latents for plan in trace.plans]
        everything = np.concatenate([trail, *nodes])
        fitted = everything if backdrop is None else backdrop.latents
        if projection == "isomap" and backdrop is not None and len(fitted) > 10 * NEIGHBOURS:
            self.name, transform = "Isomap", _isomap(fitted)
        else:
            self.name, transform = "principal components", _pca(fitted)
        groups = [trail, np.zeros((0, trail.shape[1]), np.float32) if backdrop is None else backdrop.latents, *nodes]
        placed = [transform(group) for group in groups]
        whole = _whole(np.concatenate(placed))
        split = np.split(whole, np.cumsum([len(group) for group in placed])[:-1])
        self.trail, self.backdrop, *self.plans = (part.tolist() for part in split)


def _isomap(fitted: NDArray[np.float32]) -> Any:
    isomap = Isomap(n_neighbors=NEIGHBOURS, n_components=2).fit(fitted.astype(np.float64))
    return lambda latents: isomap.transform(latents.astype(np.float64)) if len(latents) else np.zeros((0, 2))


def _pca(fitted: NDArray[np.float32]) -> Any:
    if len(fitted) < 2:
        return lambda latents: np.zeros((len(latents), 2))
    pca = PCA(2).fit(fitted.astype(np.float64))
    return lambda latents: pca.transform(latents.astype(np.float64)) if len(latents) else np.zeros((0, 2))


def _whole(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Both axes by one scale, so that distances keep their proportions."""
    if len(points) == 0:
        return np.zeros((0, 2), np.int64)
    low, span = points.min(axis=0), max(float(np.ptp(points, axis=0).max()), 1e-9)
    shift = (GRID - np.ptp(points, axis=0) / span * GRID) / 2
    return ((points - low) / span * GRID + shift).round().astype(np.int64)
