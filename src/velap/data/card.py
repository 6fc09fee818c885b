"""The card of a dataset: what is in it, in words and pictures. Letters: F frames, E episodes, P entries of a position."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from velap.data.frames import FrameStore
from velap.tasks import Task

BAR = 40
"""Longest bar of a histogram [characters]."""
SHEET_COLUMNS = 10
SHEET_ROWS = 8
SHEET_SCALE = 2
"""Enlargement of the frames on the contact sheet."""


def _histogram(values: np.ndarray, edges: Sequence[float], labels: Sequence[str]) -> list[str]:
    """One text bar a bin; the last bin holds its right edge too."""
    counts, _ = np.histogram(values, bins=np.asarray(edges, dtype=np.float64))
    longest = max(1, int(counts.max()))
    width = max(len(label) for label in labels)
    return [f"    {label:>{width}} │{'█' * round(BAR * int(count) / longest) or '▏' * bool(count)} {count}"
            for label, count in zip(labels, counts, strict=True)]


def _length_histogram(lengths: np.ndarray) -> list[str]:
    longest = int(lengths.max())
    step = max(1, -(-longest // 10))
    firsts = list(range(1, longest + 1, step))
    labels = [str(first) if step == 1 else f"{first}-{min(first + step - 1, longest)}" for first in firsts]
    return _histogram(lengths, [*firsts, max(longest, firsts[-1]) + 1], labels)


def episode_returns(store: FrameStore) -> np.ndarray:
    """float64 [E] sum of rewards of each episode."""
    return np.bincount(store.episode_of, weights=store.rewards, minlength=store.n_episodes)


def dataset_card(store: FrameStore, task: Task | None = None, positions: np.ndarray | None = None,
                 provenance: dict[str, Any] | None = None) -> str:
    """Markdown text that says what a dataset holds.

    Args:
        store: the dataset.
        task: the task that it belongs to, for the numbers of Table 10; None for a stranger's.
        positions: float [F, P] position of the agent at each frame [m], for its range.
        provenance: what `collect` kept (`command`, `contexts`, `behaviours`, `from_test`), if it did.
    """
    successes, transitions = int(store.rewards.sum()), store.n_transitions
    share = 100.0 * successes / transitions
    percent = task.recipe.success_percent if task else None
    paper = "" if percent is None else f", the paper's is {percent:.2f} % (Table 10)"
    failures = int((store.terminated & (store.rewards == 0)).sum())
    taken = np.ones(len(store.actions), bool)
    taken[store.episode_start + store.episode_length] = False
    actions = store.actions[taken]
    lines = [
        f"# Dataset {store.dataset_id}", "",
        f"- episodes: {store.n_episodes:,} of {store.episode_length.min()} to {store.episode_length.max()} transitions "
        f"(mean {store.episode_length.mean():.1f})",
        f"- transitions: {transitions:,}; frames: {len(store.frames):,} of "
        f"{store.frames.shape[1]}×{store.frames.shape[2]} px, {store.frames.nbytes / 1e6:,.0f} MB in memory",
        f"- successful transitions: {successes} ({share:.2f} %){paper}",
        f"- episodes ended by success: {successes}, by failure: {failures}, cut off: {int(store.truncated.sum())}",
        f"- actions: {store.actions.shape[1]} entries, from {_numbers(actions.min(axis=0))} to "
        f"{_numbers(actions.max(axis=0))}, "
        f"bounds {_numbers(store.action_low)} to {_numbers(store.action_high)}",
    ]
    if positions is not None:
        lines.append(f"- positions: from {_numbers(positions.min(axis=0))} to {_numbers(positions.max(axis=0))} m")
    lines.append(f"- SHA-256 of the arrays: {store.content_hash}")
    for name, (count, wins) in (provenance or {}).get("behaviours", {}).items():
        lines.append(f"- {name}: {count:,} trajectories, {wins:,} of them successful")
    if provenance and provenance.get("from_test") is not None:
        lines.append(f"- trajectories from where test episodes start to success: {provenance['from_test']}")
    if provenance and provenance.get("command"):
        lines.append(f"- made by: `{provenance['command']}`")
    if task is not None:
        lines += _against_recipe(store, task, share, (provenance or {}).get("contexts"))
    lines += ["", "Episode length [steps]:", "", *_length_histogram(store.episode_length), "", "Episode return:", "",
              *_histogram(episode_returns(store), [-0.5, 0.5, 1.5], ["0", "1"]), ""]
    return "\n".join(lines)


def _against_recipe(store: FrameStore, task: Task, share: float, trajectories: Sequence[int] | None) -> list[str]:
    """A table of what is here and in Table 10 or, where that lacks the task, in its recipe; share of successful transitions
    [%], `trajectories` of each context."""
    each = "-" if not trajectories else "–".join(str(count) for count in sorted({min(trajectories), max(trajectories)}))
    recipe = task.recipe
    source, percent = ("recipe", "-") if recipe.success_percent is None else ("Table 10", f"{recipe.success_percent:.2f}")
    return ["", f"| | here | {source} |", "| --- | --- | --- |",
            f"| contexts | {len(trajectories) if trajectories else '-'} | {recipe.contexts} |",
            f"| trajectories a context | {each} | {recipe.trajectories} |",
            f"| longest trajectory [steps] | {store.episode_length.max()} | {recipe.max_steps} |",
            f"| successful transitions [%] | {share:.2f} | {percent} |"]


def _numbers(values: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in values) + ")"


def _empty_scene(frames: np.ndarray, samples: int = 200) -> np.ndarray:
    """uint8 [H, W, 3] median of evenly spaced frames: the scene without what moves."""
    chosen = np.linspace(0, len(frames) - 1, min(samples, len(frames))).astype(np.int64)
    return np.median(frames[chosen], axis=0).astype(np.uint8)


def draw_coverage(store: FrameStore, positions: np.ndarray, path: Path, provenance: dict[str, Any] | None = None) -> None:
    """Where the agent was: positions [F, P ≥ 2] [m], starts, successes and test starts, over the scene where it is known.

    Three entries are shown from above and from the front.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kept = provenance or {}
    planes = [(0, 1), (0, 2)] if positions.shape[1] > 2 else [(0, 1)]
    figure = Figure(figsize=(7, 7), layout="constrained")
    figure.suptitle(f"{store.dataset_id}: coverage")
    for axes, plane in zip(figure.subplots(len(planes), 1, squeeze=False, sharex=True)[:, 0], planes, strict=True):
        if len(kept.get("extent", ())) == 4:
            axes.imshow(_empty_scene(store.frames), extent=tuple(kept["extent"]), alpha=0.45)
        for points, label, style in _coverage_layers(store, positions, kept):
            axes.scatter(points[:, plane[0]], points[:, plane[1]], label=f"{label} ({len(points):,})", **style)
        axes.set(xlabel=f"{'xyz'[plane[0]]} [m]", ylabel=f"{'xyz'[plane[1]]} [m]", aspect="equal")
    handles = axes.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=4, frameon=False, fontsize="small", markerscale=1.5)
    FigureCanvasAgg(figure).print_png(str(path))


def _coverage_layers(store: FrameStore, positions: np.ndarray,
                     kept: dict[str, Any]) -> list[tuple[np.ndarray, str, dict[str, Any]]]:
    """Points [*, P] of the coverage plot, their name, their style; the lowest layer first."""
    layers: list[tuple[np.ndarray, str, dict[str, Any]]] = [
        (positions, "visited", {"s": 2, "color": "0.25", "alpha": 0.35, "linewidths": 0}),
        (positions[store.episode_start], "starts", {"s": 7, "color": "tab:blue", "linewidths": 0}),
    ]
    tests = np.asarray(kept.get("test_starts", []), dtype=np.float64)
    if tests.ndim == 2 and tests.shape[1] == positions.shape[1]:
        layers.append((tests, "test starts", {"s": 14, "marker": "x", "color": "tab:green", "linewidths": 0.9}))
    stars = {"s": 60, "marker": "*", "color": "gold", "edgecolors": "black", "linewidths": 0.6}
    layers.append((positions[np.flatnonzero(store.rewards > 0) + 1], "successes", stars))
    return layers


def draw_frames(store: FrameStore, path: Path) -> None:
    """Contact sheet: a row shows an episode from start to end, the successful ones first, their last frame framed in red."""
    won = np.flatnonzero(episode_returns(store) > 0)
    lost = np.setdiff1d(np.arange(store.n_episodes), won)
    half = min(len(won), SHEET_ROWS // 2)
    chosen = [*_spread(won, half), *_spread(lost, SHEET_ROWS - half)]
    height, width = (SHEET_SCALE * side for side in store.frames.shape[1:3])
    gap = 4
    sheet = Image.new("RGB", (SHEET_COLUMNS * (width + gap) + gap, len(chosen) * (height + gap) + gap), "white")
    pen = ImageDraw.Draw(sheet)
    for row, episode in enumerate(chosen):
        steps = int(store.episode_length[episode])
        times = np.unique(np.linspace(0, steps, min(SHEET_COLUMNS, steps + 1)).round().astype(np.int64))
        for column, step in enumerate(times):
            frame = Image.fromarray(store.frames[store.episode_start[episode] + step])
            left, top = gap + column * (width + gap), gap + row * (height + gap)
            sheet.paste(frame.resize((width, height), Image.Resampling.NEAREST), (left, top))
            if episode in won and step == steps:
                pen.rectangle((left - 2, top - 2, left + width + 1, top + height + 1), outline="red", width=2)
    sheet.save(path)


def _spread(episodes: np.ndarray, count: int) -> list[int]:
    """`count` of the episodes, or all when there are fewer, evenly spaced."""
    if count == 0 or len(episodes) == 0:
        return []
    places = np.linspace(0, len(episodes) - 1, min(count, len(episodes))).astype(np.int64)
    return [int(episode) for episode in episodes[places]]


def save_card(store: FrameStore, directory: Path, task: Task | None = None, positions: np.ndarray | None = None,
              provenance: dict[str, Any] | None = None) -> list[Path]:
    """Write card.md, frames.png and, where positions [F, P ≥ 2] are known, coverage.png; arguments as for `dataset_card`."""
    directory.mkdir(parents=True, exist_ok=True)
    text = dataset_card(store, task, positions, provenance)
    card, frames, coverage = directory / "card.md", directory / "frames.png", directory / "coverage.png"
    pictures = [frames]
    draw_frames(store, frames)
    if positions is not None and positions.shape[1] >= 2:
        draw_coverage(store, positions, coverage, provenance)
        pictures.append(coverage)
    links = "\n".join(f"![{picture.stem}]({picture.name})" for picture in pictures)
    card.write_text(f"{text}\n{links}\n", encoding="utf-8")
    return [card, *pictures]
