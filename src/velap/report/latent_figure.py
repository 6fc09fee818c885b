"""Figure 3 (Sec. 5.1): a latent space in the plane, Q^g in it and over the world, and planned paths.

`of_env` and `of_data` compute a row of the figure, `save` writes rows into one small file, and `draw` draws them.

P states, D latent dimensions, R paths, L nodes of the longest one, M nodes of a tree, C landmarks, S frame size [px].
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from velap.data.sampling import WindowSampler
from velap.envs.protocol import Mapped
from velap.errors import DatasetError
from velap.evaluation.evaluate import Evaluation, load_player, make_env
from velap.methods.provenance import search_of
from velap.methods.states import StateEncoder
from velap.models.checkpoint import load_checkpoint, released_checkpoint
from velap.report.diagnose.model import load_as_trained
from velap.report.figures import (
    PROBES,
    draw_path,
    draw_tree,
    embed,
    new_figure,
    planned,
    probe,
    save_figure,
    value_colours,
)
from velap.runs import write_atomic
from velap.tasks import TASKS
from velap.training.encoding import encode_rows
from velap.training.loop import pick_device

if TYPE_CHECKING:
    from rich.console import Console

    from velap.config import Config
    from velap.data.frames import FrameStore
    from velap.evaluation.evaluate import Player
    from velap.models.velap import LatentModel

PAPER_TASKS = ("SpiralMaze", "ObstacleMaze")
"""Rows of the paper's figure."""
LAYOUTS = {"ObstacleMaze": (1, 2)}
"""Test contexts with a row each. ours: the first two whose ways are open on opposite sides."""
OWN_DATA, SHIPPED_DATA = Path("runs/figures"), Path("results/figures")
"""Folders for the data of users' figures and of the published one."""
FIRST_SEED = 1000
"""Seed of the first test start that is planned from. ours: validation seeds."""
PATHS = 3
"""R, planned paths from different starts. ours."""
LANDMARKS = 9
"""States that are numbered in panels a to d and shown in panel e. ours: numbers survive a grey print."""
CORNERS = np.array([[(8, 48, 107), (127, 39, 4)], [(158, 202, 225), (253, 190, 133)]]) / 255
"""Colours of the corners [bottom or top, left or right]. ours: blue to orange, dark to light, for colour-blind readers."""


@dataclass(frozen=True, kw_only=True)
class LatentSpace:
    """A row of the figure. Isomap coordinates have no unit."""

    title: str
    plane: NDArray[np.float32]
    """[P, 2] the states in the Isomap."""
    values: NDArray[np.float32]
    """[P] Q^g [Q-value]."""
    positions: NDArray[np.float32]
    """[P, 2] [m]; [0, 2] if unknown."""
    times: NDArray[np.int32]
    """[P] time of each state in its episode [steps]; [0] if positions are known."""
    landmarks: NDArray[np.int64]
    """[C] numbered states, in the order of increasing Q^g."""
    frames: NDArray[np.uint8]
    """[C, S, S, 3] their newest frames."""
    background: NDArray[np.uint8]
    """[S, S, 3] the scene without the robot; [0, 0, 3] if positions are unknown."""
    extent: NDArray[np.float64]
    """Left, right, bottom, top of the frame [m]; [0] if positions are unknown."""
    paths: NDArray[np.float32]
    """[R, L, 2] planned paths in the Isomap, NaN behind their ends."""
    tree: NDArray[np.float32]
    """[M, 2] nodes of the first path's tree in the Isomap."""
    parents: NDArray[np.int64]
    """[M] parents of the nodes."""


def of_env(player: Player, title: str, options: dict[str, Any] | None = None, count: int = PROBES) -> LatentSpace:
    """`count` states at uniform positions of a scene, and plans from test starts; `options` of `reset` choose the scene."""
    model, stack = player.model, player.config.model.frame_stack
    assert model is not None
    env = player.make_env()
    try:
        read = player.frames_of(env)
        seen = probe(model, env, read, frame_stack=stack, rng=np.random.default_rng(0), count=count, seed=FIRST_SEED,
                     options=options)
        starts = [read(env.reset(seed=FIRST_SEED + path, options=options)[0]) for path in range(PATHS)]
    finally:
        env.close()
    states = StateEncoder(model)
    states.forget(np.ones(PATHS, bool))
    with torch.inference_mode():
        roots = states(np.repeat(np.stack(starts)[:, None], stack, 1))
    return _space(model, player.config, title, seen.latents, seen.values, roots, seen.frames,
                  positions=seen.positions.astype(np.float32), times=np.empty(0, np.int32), extent=np.array(seen.extent),
                  background=np.median(seen.frames[:: max(1, count // 60)], 0).astype(np.uint8))


def of_data(model: LatentModel, config: Config, title: str, store: FrameStore, count: int = PROBES) -> LatentSpace:
    """`count` states of a dataset, and plans from the first states of some episodes; positions are unknown."""
    if store.n_episodes < PATHS:
        raise DatasetError(f"{store.dataset_id} has {store.n_episodes} episodes; expected {PATHS} at least, one a planned "
                           "path. Take a larger dataset.")
    rng, device = np.random.default_rng(0), next(model.parameters()).device
    sampler = WindowSampler(store, config.train, config.model.frame_stack, device, np.empty(0, np.int64))
    rows = np.sort(rng.choice(len(store.frames), min(count, len(store.frames)), replace=False))
    firsts = store.episode_start[np.sort(rng.choice(store.n_episodes, PATHS, replace=False))]
    with torch.inference_mode():
        latents = encode_rows(model, sampler, torch.from_numpy(rows).to(device), 256)
        roots = encode_rows(model, sampler, torch.from_numpy(firsts).to(device))
        values = model.value(latents)
    return _space(model, config, title, latents.float().cpu().numpy(), values.float().cpu().numpy(), roots,
                  store.frames[rows], positions=np.empty((0, 2), np.float32),
                  times=(rows - store.first[rows]).astype(np.int32), extent=np.empty(0),
                  background=np.empty((0, 0, 3), np.uint8))


def _space(model: LatentModel, config: Config, title: str, latents: NDArray[np.float32], values: NDArray[np.float32],
           roots: torch.Tensor, frames: NDArray[np.uint8], **world: NDArray[Any]) -> LatentSpace:
    """Plan from the roots [R, D], and embed states, tree and paths in one plane."""
    generators = [torch.Generator().manual_seed(FIRST_SEED + row) for row in range(len(roots))]
    with torch.inference_mode():
        found = search_of(model, config)(roots, generators)
    plans = [planned(found, row) for row in range(len(roots))]
    plane, tree, *paths = embed(latents, plans[0].latents, *(each.waypoints for each in plans))
    padded = np.full((len(paths), max(map(len, paths)), 2), np.nan, np.float32)
    for row, path in enumerate(paths):
        padded[row, : len(path)] = path
    chosen = spread(world["positions"] if len(world["positions"]) else plane, LANDMARKS)
    landmarks = chosen[np.argsort(values[chosen], kind="stable")]
    return LatentSpace(title=title, plane=plane.astype(np.float32), values=values, landmarks=landmarks,
                       frames=frames[landmarks], paths=padded, tree=tree.astype(np.float32),
                       parents=plans[0].parents, **world)


def spread(places: NDArray[np.floating[Any]], count: int) -> NDArray[np.int64]:
    """Numbers of up to `count` of the places [P, 2], each the farthest from those before it."""
    chosen = [int(((places - places.mean(0)) ** 2).sum(-1).argmax())]
    nearest = np.full(len(places), np.inf)
    while len(chosen) < min(count, len(places)):
        nearest = np.minimum(nearest, ((places - places[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(nearest.argmax()))
    return np.array(chosen)


def save(path: Path, rows: Sequence[LatentSpace]) -> None:
    """Write the rows of one task into an npz file."""
    arrays = {f"{number}_{field.name}": np.asarray(getattr(row, field.name))
              for number, row in enumerate(rows) for field in fields(LatentSpace)}
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)  # type: ignore[arg-type]
    write_atomic(path, content.getvalue())


def load(path: Path) -> list[LatentSpace]:
    """Rows from a file of `save`."""
    if not path.is_file():
        raise DatasetError(f"no data of the figure at {path}; expected a file that `velap figure 3` writes. Leave --no-run "
                           "out to make it.")
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    rows = []
    for number in range(sum(name.endswith("_title") for name in arrays)):
        values: dict[str, Any] = {field.name: arrays[f"{number}_{field.name}"] for field in fields(LatentSpace)}
        rows.append(LatentSpace(**values | {"title": str(values["title"])}))
    return rows


def draw(rows: Sequence[LatentSpace], *paths: Path) -> None:
    """Draw the rows into each of the files, PNG or vector by their names; panels a and c stay empty without positions."""
    figure = new_figure(17, 2.95 * len(rows) + 0.6, "")
    grid = figure.subplots(len(rows), 6, squeeze=False)
    for number, (row, axes) in enumerate(zip(rows, grid, strict=True)):
        _draw_row(figure, row, axes)
        axes[0].text(-0.42, 0.5, row.title, transform=axes[0].transAxes, rotation=90, va="center", ha="center", fontsize=11)
        if number == 0:
            colours = "colours of (a)" if len(row.positions) else "time in episode"
            titles = ("(a) robot positions", f"(b) Isomap, {colours}", "(c) $Q^g$ over positions",
                      "(d) $Q^g$ over the Isomap", "(e) input frames", "(f) planned latent paths")
            for each, title in zip(axes, titles, strict=True):
                each.set_title(title, fontsize=11)
    handles, labels = grid[0, 5].get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    figure.legend(unique.values(), unique.keys(), loc="outside lower right", ncols=len(unique), frameon=False)
    for path in paths:
        save_figure(figure, path)


def _draw_row(figure: Any, row: LatentSpace, axes: Any) -> None:
    """The six panels of one latent space."""
    positions, isomap, values_there, values_here, frames, planned = axes
    colours, known = value_colours(row.values), len(row.positions) > 0
    tints: dict[str, Any] = {"c": row.times, "cmap": "cividis"}
    if known:
        tints = {"c": position_colours(row.positions, row.extent)}
    if known:
        _draw_world(positions, row, s=7, **tints)
        _number(positions, row.positions[row.landmarks])
        _draw_world(values_there, row, s=7, **colours)
        _number(values_there, row.positions[row.landmarks])
    else:
        for empty in (positions, values_there):
            empty.axis("off")
            empty.set_box_aspect(1)
            empty.text(0.5, 0.5, "positions unknown", ha="center", va="center", transform=empty.transAxes, color="0.4")
    points = isomap.scatter(*row.plane.T, s=7, **tints)
    if not known:
        figure.colorbar(points, ax=isomap, label="time [steps]", shrink=0.9)
    _number(isomap, row.plane[row.landmarks])
    figure.colorbar(values_here.scatter(*row.plane.T, s=7, **colours), ax=values_here, label="$Q^g$", shrink=0.9)
    _number(values_here, row.plane[row.landmarks])
    _draw_frames(frames, row.frames)
    planned.scatter(*row.plane.T, s=7, color="0.8", label="states")
    draw_tree(planned, row.tree, row.parents, label="tree of the first path")
    for path in row.paths:
        draw_path(planned, path[np.isfinite(path[:, 0])], label="planned path", start="start")
    for each in (isomap, values_here, planned):
        each.set(xticks=[], yticks=[], xlabel="Isomap 1", ylabel="Isomap 2", box_aspect=1)


def position_colours(positions: NDArray[np.floating[Any]], extent: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions [P, 2] [m] -> RGB [P, 3] between those of `CORNERS`."""
    left, right, bottom, top = extent
    x = ((positions[:, 0] - left) / (right - left)).clip(0, 1)[:, None]
    y = ((positions[:, 1] - bottom) / (top - bottom)).clip(0, 1)[:, None]
    (dark_left, dark_right), (light_left, light_right) = CORNERS
    return (1 - y) * ((1 - x) * dark_left + x * dark_right) + y * ((1 - x) * light_left + x * light_right)


def _draw_world(axes: Any, row: LatentSpace, **points: Any) -> None:
    """The positions over the scene."""
    axes.imshow(row.background, extent=tuple(row.extent), interpolation="nearest", alpha=0.45)
    axes.scatter(*row.positions.T, **points)
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", box_aspect=1,
             xlim=row.extent[:2], ylim=row.extent[2:])


def _number(axes: Any, places: NDArray[np.floating[Any]]) -> None:
    """1, 2, ... at places [C, 2]."""
    from matplotlib.patheffects import withStroke

    for number, place in enumerate(places, start=1):
        axes.text(*place, str(number), fontsize=10, fontweight="bold", ha="center", va="center", color="black",
                  path_effects=[withStroke(linewidth=2.5, foreground="white")])


def _draw_frames(axes: Any, frames: NDArray[np.uint8]) -> None:
    """Frames [C, H, W, 3] in three columns, with their numbers."""
    (height, width), gap = frames.shape[1:3], max(2, frames.shape[1] // 20)
    lines = -(-len(frames) // 3)
    sheet = np.full((lines * (height + gap) - gap, 3 * (width + gap) - gap, 3), 255, np.uint8)
    corners = [(number // 3 * (height + gap), number % 3 * (width + gap)) for number in range(len(frames))]
    for (top, left), frame in zip(corners, frames, strict=True):
        sheet[top : top + height, left : left + width] = frame
    axes.imshow(sheet, interpolation="nearest")
    _number(axes, np.array([(left + 0.88 * width, top + 0.12 * height) for top, left in corners]))
    axes.axis("off")


def spaces_of(task: str, checkpoint: Path | None, dataset: str | None, image_key: str | None, device: str,
              ) -> list[LatentSpace]:
    """The rows of a task: its scenes if the robot can be placed anywhere, else states of the dataset."""
    path = checkpoint or released_checkpoint(task)
    if dataset is None and task in TASKS and isinstance(make_env(TASKS[task].env_id).unwrapped, Mapped):
        player = load_player(Evaluation(task, checkpoint=path, image_key=image_key, device=device))
        layouts = LAYOUTS.get(task)
        if layouts is None:
            return [of_env(player, task)]
        return [of_env(player, f"{task}, layout {number}", {"split": "test", "context": context})
                for number, context in enumerate(layouts, start=1)]
    model, config, metadata = load_checkpoint(path, pick_device(device))
    source = dataset or (TASKS[task].dataset_id if task in TASKS else task)
    return [of_data(model, config, task, load_as_trained(source, image_key, model, metadata))]


def show(console: Console, task: str | None, *, checkpoint: Path | None = None, dataset: str | None = None,
         image_key: str | None = None, device: str = "auto", no_run: bool = False, write: Path | None = None) -> None:
    """Compute the data of the figure, one file a task, and draw them as PNG and PDF; `no_run` only draws."""
    own = checkpoint is not None or dataset is not None
    tasks = PAPER_TASKS if task is None else (task,)
    data = OWN_DATA if own else SHIPPED_DATA
    files = [data / f"fig3-{name.replace('/', '_')}.npz" for name in tasks]
    for name, file in zip(tasks, files, strict=True):
        if not no_run:
            with console.status(f"looking at {name} through the encoder, and planning"):
                save(file, spaces_of(name, checkpoint, dataset, image_key, device))
            console.print(f"data {file}", markup=False)
    suffix = "" if task is None else f"-{task.replace('/', '_')}"
    picture = write or (OWN_DATA if own else Path("docs/figures")) / f"fig3{suffix}.png"
    draw([row for file in files for row in load(file)], picture, picture.with_suffix(".pdf"))
    console.print(f"pictures {picture} and {picture.with_suffix('.pdf').name}", markup=False)
