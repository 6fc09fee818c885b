"""Figures 7 and 8: success against the time of one plan (App. E.4), VELAP and MPPI by the same checkpoint.

A point is an evaluation with settings of its own. Its records lie in
`results/planning_time/<settings>/<task>/<method>-<preset>/train<seed>.jsonl`; table and picture come from them alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from velap.errors import ConfigError
from velap.evaluation.evaluate import Evaluation, evaluate
from velap.evaluation.records import read_records, record_path
from velap.evaluation.summary import Summary, markdown_rows, summarise, write_into
from velap.models.checkpoint import released_checkpoint
from velap.report.figures import new_figure, save_figure

RECORDS = Path("results/planning_time")
FIRST_SEED = 1000
"""Seed of the first episode. ours: validation seeds; their test starts are none of Table 1's."""
ROUND = 5
"""Episodes that every point runs before any runs more: an interruption leaves points of equal weight."""
FIGURES = {"7": "SpiralMaze", "8": "ObstacleMaze"}
N_REPLAN = {"SpiralMaze": 25, "ObstacleMaze": 15}
"""Environment steps between VELAP's plans, App. E.4; MPPI replans every 5 steps."""
VELAP_POINTS = {
    "SpiralMaze": ((250, 10, 10), (500, 5, 10), (500, 10, 10), (1000, 10, 10), (1000, 5, 10), (500, 10, 50), (1000, 10, 50),
                   (2000, 10, 50)),
    "ObstacleMaze": ((25, 5, 5), (50, 5, 5), (50, 5, 10), (100, 5, 10), (250, 5, 10), (500, 5, 10), (100, 10, 10),
                     (250, 5, 50), (500, 5, 50)),
}
"""(n_iter, n_sim, K). ours: the paper does not name its points."""
MPPI_POINTS = ((2, 10, 100), (2, 25, 100), (2, 25, 250), (5, 25, 250), (5, 50, 250), (5, 25, 500), (5, 50, 500),
               (5, 50, 1000))
"""(iterations, horizon, samples), the last one App. D.4's. ours: the paper does not name its points."""
LABELS = {"velap": "VELAP (n_iter, n_sim, K)", "mppi": "MPPI (iterations, horizon, samples)"}


@dataclass(frozen=True)
class Point:
    """One setting of a planner."""

    task: str
    method: str
    """`velap` or `mppi`."""
    settings: tuple[int, int, int]
    """In the order of `LABELS`."""

    @property
    def name(self) -> str:
        """`250-5-10`."""
        return "-".join(map(str, self.settings))

    def changes(self) -> dict[str, dict[str, Any]]:
        """Fields of the checkpoint's config to replace. VELAP runs as Algorithms 1 and 2 have it: no proposers. τ_low
        grows with n_sim as in the mazes' presets; MPPI keeps a quarter of its samples, 64 at most
        (D.4)."""
        first, second, third = self.settings
        if self.method == "mppi":
            return {"mppi": {"iterations": first, "horizon": second, "samples": third, "elites": min(64, third // 4)}}
        return {"planner": {"provenance": False, "n_iter": first, "n_sim": second, "candidates": third,
                            "discard_low_exponent": 2.0 * second},
                "controller": {"n_replan": N_REPLAN[self.task]}}

    def run(self, checkpoint: Path, records: Path, seeds: range, fresh: bool) -> None:
        """Run the missing episodes one at a time, so that a plan has the machine to itself."""
        what = Evaluation(self.task, method=self.method, checkpoint=checkpoint, changes=self.changes())
        evaluate(what, seeds, records / self.name, batch=1, fresh=fresh)


@dataclass(frozen=True)
class Measured:
    """A point and the statistics of its records."""

    point: Point
    summary: Summary
    fastest: float
    """Fastest of all plans [ms]: on a busy machine, closer to the cost of a plan than the median."""

    @property
    def ms(self) -> float:
        """Median time of a plan [ms]."""
        return self.summary.plan_ms_p50

    @property
    def rate(self) -> float:
        """Success rate [fraction]."""
        return self.summary.success_rate


def points_of(task: str) -> list[Point]:
    """All points of a task, alternating between the methods."""
    velap = [Point(task, "velap", settings) for settings in VELAP_POINTS[task]]
    mppi = [Point(task, "mppi", settings) for settings in MPPI_POINTS]
    return [point for pair in zip(velap, mppi, strict=False) for point in pair] + velap[len(mppi):]


def measured(task: str, records: Path, preset: str = "default", seed: int = 0) -> list[Measured]:
    """The points that have records."""
    found = []
    for point in points_of(task):
        path = record_path(records / point.name, task, point.method, preset, seed)
        if path.exists() and (episodes := read_records(path)):
            times = [value for episode in episodes for value in episode.plan_ms]
            found.append(Measured(point, summarise(episodes), min(times, default=math.nan)))
    return found


def pareto_front(points: Sequence[Measured]) -> list[Measured]:
    """The points with more success than every faster one, the fastest first."""
    front: list[Measured] = []
    for each in sorted(points, key=lambda each: (each.ms, -each.rate)):
        if not front or each.rate > front[-1].rate:
            front.append(each)
    return front


def of(method: str, points: Sequence[Measured]) -> list[Measured]:
    """The points of one method."""
    return [each for each in points if each.point.method == method and not math.isnan(each.ms)]


def ratio_text(points: Sequence[Measured]) -> str:
    """How much faster VELAP is at MPPI's best success."""
    velap, mppi = pareto_front(of("velap", points)), pareto_front(of("mppi", points))
    if not velap or not mppi:
        return "Only one method is measured: no ratio."
    best = mppi[-1]
    enough = [each for each in velap if each.rate >= best.rate]
    asked = f"MPPI's best success, {100 * best.rate:.0f} % in {best.ms:.1f} ms a plan ({best.point.name})"
    if best.rate == 0:
        return f"MPPI solves no episode at any point; VELAP's best is {100 * velap[-1].rate:.0f} % in {velap[-1].ms:.1f} ms."
    if not enough:
        return f"VELAP does not reach {asked}: {100 * velap[-1].rate:.0f} % at best."
    return (f"VELAP reaches {asked}, in {enough[0].ms:.1f} ms ({enough[0].point.name}): MPPI takes "
            f"{best.ms / enough[0].ms:.1f} times as long.")


def table(points: Sequence[Measured]) -> str:
    """Every point, and the ratio at equal success."""
    front = [each.point for method in LABELS for each in pareto_front(of(method, points))]
    rows = []
    for each in sorted(points, key=lambda each: (each.point.method != "velap", each.ms)):
        summary = each.summary
        rows.append((summary.method, each.point.name, str(summary.episodes),
                     f"{100 * each.rate:.0f} ({100 * summary.wilson_low:.0f} to {100 * summary.wilson_high:.0f})",
                     "-" if math.isnan(each.ms) else f"{each.fastest:.1f} / {each.ms:.1f} / {summary.plan_ms_p95:.1f}",
                     f"{summary.mean_plans:.1f}", "yes" if each.point in front else ""))
    columns = ("method", "settings", "episodes", "success [%] (95 % interval)", "plan min / p50 / p95 [ms]",
               "plans an episode", "Pareto front")
    return f"{markdown_rows(columns, rows)}\n\n{ratio_text(points)}"


def draw(task: str, points: Sequence[Measured], *paths: Path) -> None:
    """Success against time: the points with 95 % intervals, and the front of each method as a line."""
    from matplotlib.ticker import LogLocator

    figure = new_figure(8, 5, f"Success against planning time, {task}")
    axes = figure.subplots()
    styles = {"velap": ("o", "-", "#0072B2"), "mppi": ("s", "--", "#D55E00")}
    for method, (marker, line, colour) in styles.items():
        own = of(method, points)
        if not own:
            continue
        for each in own:
            low, high = each.summary.wilson_low, each.summary.wilson_high
            axes.plot([each.ms] * 2, [100 * low, 100 * high], "-", color=colour, linewidth=1, alpha=0.5)
        front = pareto_front(own)
        axes.plot([each.ms for each in front], [100 * each.rate for each in front], line, color=colour, linewidth=1.2,
                  drawstyle="steps-post")
        axes.plot([each.ms for each in own], [100 * each.rate for each in own], marker, color=colour, label=LABELS[method],
                  markeredgewidth=1.8,
                  markersize=6 if method == "velap" else 9, markerfacecolor=colour if method == "velap" else "none")
        side = 1 if method == "velap" else -1
        for each in front:
            axes.annotate(each.point.name, (each.ms, 100 * each.rate), color=colour, fontsize=8, xytext=(4, 7 * side),
                          textcoords="offset points", va="bottom" if side > 0 else "top")
    episodes = sorted({each.summary.episodes for each in points})
    axes.set(xscale="log", xlabel="median time of one plan [ms]", ylim=(-6, 108),
             ylabel=f"success [%], {'-'.join(map(str, dict.fromkeys((episodes[0], episodes[-1]))))} episodes a point")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_locator(LogLocator(subs=(2, 5)))
    axes.xaxis.set_minor_formatter("{x:g}")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False)
    for path in paths:
        save_figure(figure, path)


def show_planning_time(console: Console, number: str, path: Path, *, checkpoint: Path | None = None, episodes: int = 50,
                       no_run: bool = False, fresh: bool = False, records: Path = RECORDS) -> None:
    """Run what is missing, print the table, and draw the picture; a page beside the picture gets the table too."""
    if episodes < 1:
        raise ConfigError(f"got {episodes} episodes a point; expected at least 1.")
    task = FIGURES[number]
    if not no_run:
        weights = checkpoint or released_checkpoint(task)
        for done in range(0, episodes, ROUND):
            seeds = range(FIRST_SEED, FIRST_SEED + min(episodes, done + ROUND))
            for point in points_of(task):
                with console.status(f"{task}, {point.method} {point.name}, {len(seeds)} of {episodes} episodes"):
                    point.run(weights, records, seeds, fresh and done == 0)
    points = measured(task, records)
    if not points:
        raise ConfigError(f"found no records of {task} below {records}; expected those of one point at least. Leave "
                          "--no-run out.")
    console.print(table(points), markup=False, soft_wrap=True)
    draw(task, points, path, path.with_suffix(".pdf"))
    console.print(f"pictures {path} and {path.with_suffix('.pdf').name}", markup=False)
    if (page := path.with_suffix(".md")).is_file():
        write_into(page, table(points))
