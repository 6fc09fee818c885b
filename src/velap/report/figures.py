"""What pictures consist of: real states, the 2-D Isomap, a plan and its tree, film strips; and the picture of one plan.

P real states, D latent dimensions, L waypoints, M nodes of a tree, S frame size [px], F frames of a strip.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from sklearn.manifold import Isomap
from sklearn.neighbors import kneighbors_graph

from velap.data.frames import stack_indices
from velap.envs.protocol import Mapped
from velap.evaluation.rollout import FrameReader
from velap.models.velap import LatentModel
from velap.runs import write_atomic
from velap.search import types as search

PROBES = 1200
"""States a latent map is made of. ours: about one per hundredth of SpiralMaze's corridor."""
NEIGHBOURS = 5
"""Fewest neighbours of the Isomap graph. ours; more only where the graph would fall apart: in SpiralMaze, further ones are
across a wall."""
COLUMNS = 10
"""Frames of a strip side by side."""
MOST_FRAMES = 30
"""Frames of a strip in all; of longer chains some are left out."""
SMALLEST_SHOWN = 1e-3
"""Lower end of the logarithmic colours [Q-value]. ours: γ^169."""


@dataclass(frozen=True, kw_only=True)
class RealStates:
    """Real states: what they look like, and where they are in the latent space."""

    source: str
    """Where they come from, in words."""
    latents: NDArray[np.float32]
    """[P, D]."""
    frames: NDArray[np.uint8]
    """[P, S, S, 3]; [0, 0, 0, 3] where the latents alone are known."""

    def nearest(self, latents: NDArray[np.floating[Any]]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Numbers [L] of the states nearest to latents [L, D], and how far they are [L] [latent distance]."""
        distances = cdist(latents, self.latents)
        return distances.argmin(1), distances.min(1)

    def spacing(self) -> float:
        """Mean distance of a state to the nearest other one [latent distance]."""
        distances = cdist(self.latents, self.latents)
        np.fill_diagonal(distances, np.inf)
        return float(distances.min(1).mean())


@dataclass(frozen=True, kw_only=True)
class LatentMap(RealStates):
    """Real states of one scene whose positions are known."""

    positions: NDArray[np.float64]
    """[P, 2] [m]."""
    values: NDArray[np.float32]
    """[P] Q^g [Q-value]."""
    extent: tuple[float, float, float, float]
    """Left, right, bottom, top of the frame [m]."""

    def locate(self, latents: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Positions [L, 2] of the states nearest to latents [L, D] [m]."""
        return self.positions[self.nearest(latents)[0]]


@dataclass(frozen=True, kw_only=True)
class Planned:
    """One plan, as arrays."""

    latents: NDArray[np.float32]
    """[M, D] nodes in the order in which they were added, the root first; of a planner without a tree its waypoints."""
    parents: NDArray[np.int64]
    """[M] -1 for the root."""
    path: NDArray[np.int64]
    """[L] nodes of the chosen path, the root first."""

    @property
    def waypoints(self) -> NDArray[np.float32]:
        """[L, D]."""
        return self.latents[self.path]


def planned(plans: search.Path, row: int) -> Planned:
    """The plan of one row of a batch."""
    length = int(plans.length[row])
    if not isinstance(plans, search.Plan):
        latents, path = plans.waypoints[row, :length].float().cpu().numpy(), np.arange(length)
        return Planned(latents=latents, parents=path - 1, path=path)
    size = int(plans.tree.size[row])
    return Planned(latents=plans.tree.latents[row, :size].float().cpu().numpy(),
                   parents=plans.tree.parents[row, :size].cpu().numpy(), path=plans.nodes[row, :length].cpu().numpy())


def can_probe(env: gym.Env[Any, Any]) -> bool:
    """Whether the environment can place its robot anywhere and knows what its camera sees."""
    return isinstance(env.unwrapped, Mapped)


@torch.inference_mode()
def probe(model: LatentModel, env: gym.Env[Any, Any], read: FrameReader, *, frame_stack: int, rng: np.random.Generator,
          count: int = PROBES, seed: int = 0, options: dict[str, Any] | None = None) -> LatentMap:
    """Encode `count` states at uniform free positions, each after a few steps of one random action, as in the data.

    `seed` and `options` are those of the environment's reset: they choose the scene.
    """
    world: Any = env.unwrapped
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    stacks, positions, actions = [], [], []
    env.reset(seed=seed, options=options)
    for start in world.free_positions(rng, count):
        world.set_agent_position(start)
        action = rng.uniform(space.low, space.high).astype(space.dtype)
        frames = [read(world.step(action)[0]) for _ in range(frame_stack)]
        stacks.append(np.stack([frames[row] for row in stack_indices(np.array(frame_stack - 1), np.array(0), frame_stack)]))
        positions.append(world.agent_position()[:2])
        actions.append(action)
    device = next(model.parameters()).device
    everything = np.stack(stacks)
    share = 1 - model.memory**frame_stack  # of the one action in the leaky mean
    commands = share * model.to_unit(torch.from_numpy(np.stack(actions).astype(np.float32)).to(device))
    batches = zip(torch.from_numpy(everything).split(256), commands.split(256), strict=True)
    latents = torch.cat([model.encode(batch.to(device), before) for batch, before in batches])
    values = model.value(latents).float().cpu().numpy()
    return LatentMap(source="the episode's scene", latents=latents.float().cpu().numpy(), frames=everything[:, -1],
                     positions=np.stack(positions), values=values, extent=world.extent)


def to_pixels(positions: NDArray[np.float64], extent: tuple[float, float, float, float], size: int) -> NDArray[np.float64]:
    """Positions [*, 2] [m] -> column and row [*, 2] [px] in a frame of `size` [px]."""
    left, right, bottom, top = extent
    x, y = positions[..., 0], positions[..., 1]
    return np.stack([(x - left) / (right - left) * size, (top - y) / (top - bottom) * size], -1)


def plan_figure(path: Path, plan: Planned, frame: NDArray[np.uint8], latent_map: LatentMap, title: str) -> None:
    """Draw a plan over the frame [S, S, 3] that it was made from, in the Isomap, and beside Q^g over positions."""
    places = latent_map.locate(plan.waypoints)
    embedded, tree = embed(latent_map.latents, plan.latents)
    colours = value_colours(latent_map.values)
    figure = new_figure(15, 5, title)
    in_frame, in_latents, in_world = figure.subplots(1, 3)
    in_frame.imshow(frame, extent=latent_map.extent, interpolation="nearest")
    in_frame.plot(*places.T, "o-", color="tab:orange", markersize=5, linewidth=1.5)
    in_frame.set(title=f"frame and {len(places) - 1} planned waypoints", xlabel="x [m]", ylabel="y [m]")
    in_latents.scatter(*embedded.T, s=14, **colours)
    draw_tree(in_latents, tree, plan.parents, label=f"tree, {len(tree)} nodes")
    draw_path(in_latents, tree[plan.path], label="chosen path", start="now")
    in_latents.set(title="2-D Isomap of latents", xticks=[], yticks=[])
    in_latents.legend(loc="best", fontsize=8)
    points = in_world.scatter(*latent_map.positions.T, s=14, **colours)
    in_world.set(title="$Q^g$ over the robot's position", xlabel="x [m]", ylabel="y [m]", aspect="equal",
                 xlim=latent_map.extent[:2], ylim=latent_map.extent[2:])
    figure.colorbar(points, ax=(in_latents, in_world), label="$Q^g$", shrink=0.9)
    save_figure(figure, path)


def embed(latents: NDArray[np.float32], *others: NDArray[np.float32]) -> list[NDArray[np.float64]]:
    """The plane [P, 2] that best keeps the distances of latents [P, D] along their manifold (Isomap), and where in it other
    latents [*, D] lie."""
    isomap = fit_isomap(latents)
    return [isomap.embedding_, *(isomap.transform(each) for each in others)]


def fit_isomap(latents: NDArray[np.float32]) -> Isomap:
    """The 2-D Isomap of latents [P, D], by the fewest neighbours, `NEIGHBOURS` or more, that keep its graph in one piece."""
    counts = range(min(NEIGHBOURS, len(latents) - 1), len(latents))
    enough = next(count for count in counts
                  if connected_components(kneighbors_graph(latents, count), directed=False)[0] == 1)
    return Isomap(n_neighbors=enough, n_components=2).fit(latents)


def value_colours(values: NDArray[np.float32]) -> dict[str, Any]:
    """Arguments of matplotlib's `scatter` for Q^g [P]: a logarithmic scale whose lightness grows with the value."""
    from matplotlib.colors import LogNorm

    return {"c": np.clip(values, SMALLEST_SHOWN, 1), "norm": LogNorm(SMALLEST_SHOWN, 1), "cmap": "viridis"}


def draw_tree(axes: Any, tree: NDArray[np.floating[Any]], parents: NDArray[np.int64], label: str) -> None:
    """The edges of a tree, nodes [M, 2], parents [M]."""
    edges = np.stack([tree[1:], tree[parents[1:]], np.full_like(tree[1:], np.nan)], 1).reshape(-1, 2)
    axes.plot(*edges.T, color="0.25", linewidth=0.6, alpha=0.7, label=label)


def draw_path(axes: Any, path: NDArray[np.floating[Any]], label: str, start: str) -> None:
    """A planned path [L, 2] from its start."""
    axes.plot(*path.T, "o-", color="tab:red", markersize=4, linewidth=2, label=label)
    axes.plot(*path[0], "*", color="black", markersize=13, label=start)


@dataclass(frozen=True, kw_only=True)
class FilmStrip:
    """Frames in a row, each with a caption."""

    title: str
    frames: NDArray[np.uint8]
    """[F, H, W, 3]."""
    captions: tuple[str, ...]
    """[F]."""


def strip_figure(path: Path, strip: FilmStrip) -> None:
    """Frames in reading order with their captions below."""
    picked = np.unique(np.linspace(0, len(strip.frames) - 1, min(MOST_FRAMES, len(strip.frames))).astype(int))
    rows = -(-len(picked) // COLUMNS)
    columns = min(COLUMNS, max(len(picked), 6))  # a title needs room
    figure = new_figure(1.5 * columns, 2.05 * rows + 0.5, strip.title)
    cells = figure.subplots(rows, columns, squeeze=False).flatten()
    for axes in cells:
        axes.set_axis_off()
    for axes, number in zip(cells, picked, strict=False):
        axes.set_axis_on()
        axes.imshow(strip.frames[number], interpolation="nearest")
        axes.set(xticks=[], yticks=[])
        axes.set_xlabel(strip.captions[number], fontsize=9)
    save_figure(figure, path)


def new_figure(width: float, height: float, title: str) -> Any:
    """An empty figure of that size [inches] that needs no screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    figure.suptitle(title)
    return figure


def save_figure(figure: Any, path: Path) -> None:
    """A whole file or none, PNG or vector by the name; the same figure gives the same bytes. Raises StorageError."""
    kind, content = path.suffix.removeprefix("."), io.BytesIO()
    figure.savefig(content, dpi=110, format=kind, metadata={"CreationDate": None} if kind == "pdf" else None)
    write_atomic(path, content.getvalue())

