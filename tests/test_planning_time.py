"""Figures 7 and 8: fronts and ratios by hand, resuming, and pictures from the committed records."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
from rich.console import Console

from studies import planning_time
from studies.planning_time import (
    FIGURES,
    LABELS,
    Measured,
    Point,
    draw,
    measured,
    pareto_front,
    points_of,
    ratio_text,
    table,
)
from test_records import record
from velap import cli
from velap.errors import ConfigError
from velap.evaluation.records import read_records
from velap.evaluation.summary import summarise
from velap.models.checkpoint import released_checkpoint

SHIPPED = Path(__file__).parent.parent / planning_time.RECORDS


def point(method: str, ms: float, solved: int, number: int = 1) -> Measured:
    """Solves `solved` of 10 episodes, `ms` a plan."""
    episodes = [dataclasses.replace(record(seed, success=seed < solved), method=method, plan_ms=(ms,)) for seed in range(10)]
    return Measured(Point("ObstacleMaze", method, (number, 5, 10)), summarise(episodes), ms)


def test_a_front_is_what_no_faster_point_equals() -> None:
    points = [point("velap", 4, 5), point("velap", 2, 5), point("velap", 1, 2), point("velap", 8, 4), point("velap", 9, 10)]
    assert [(each.ms, each.rate) for each in pareto_front(points)] == [(1, 0.2), (2, 0.5), (9, 1.0)]


def test_the_ratio_is_taken_at_equal_success() -> None:
    mppi = [point("mppi", 100, 7, 2), point("mppi", 400, 7, 3), point("mppi", 10, 3, 4)]
    text = ratio_text([*mppi, point("velap", 1, 5), point("velap", 4, 8), point("velap", 9, 10)])
    assert "70 % in 100.0 ms a plan (2-5-10), in 4.0 ms (1-5-10): MPPI takes 25.0 times as long." in text
    assert "does not reach MPPI's best success" in ratio_text([*mppi, point("velap", 1, 5)])
    assert "no episode at any point; VELAP's best is 50 %" in ratio_text([point("mppi", 3, 0), point("velap", 1, 5)])
    assert "no ratio" in ratio_text([point("velap", 1, 5)])


@pytest.mark.parametrize("task", FIGURES.values())
def test_each_method_has_eight_points_at_least(task: str) -> None:
    for method in LABELS:
        own = [each for each in points_of(task) if each.method == method]
        assert len({each.settings for each in own}) == len(own) >= 8


def test_an_interrupted_point_goes_on(tmp_path: Path) -> None:
    small, weights = Point("ObstacleMaze", "velap", (25, 5, 5)), released_checkpoint("ObstacleMaze")
    small.run(weights, tmp_path, range(1000, 1001), fresh=False)
    (path,) = tmp_path.rglob("*.jsonl")
    before = path.read_bytes()
    small.run(weights, tmp_path, range(1000, 1002), fresh=False)
    assert path.read_bytes().startswith(before)
    assert [each.episode_seed for each in read_records(path)] == [1000, 1001]
    assert {each.batch for each in read_records(path)} == {1}


def test_settings_reach_the_planners(tmp_path: Path) -> None:
    changes = Point("SpiralMaze", "velap", (250, 10, 20)).changes()
    assert changes["planner"] == {"provenance": False, "n_iter": 250, "n_sim": 10, "candidates": 20,
                                  "discard_low_exponent": 20.0}
    assert changes["controller"]["n_replan"] == 25
    assert Point("SpiralMaze", "mppi", (2, 10, 100)).changes()["mppi"] == {
        "iterations": 2, "horizon": 10, "samples": 100, "elites": 25}


@pytest.mark.parametrize("number", [number for number, task in FIGURES.items() if measured(task, SHIPPED)])
def test_the_pictures_are_made_of_the_shipped_records(number: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "results").symlink_to(SHIPPED.parent)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figure", number, "--no-run", "--write", "small.png"]) == 0
    picture = imageio.imread(tmp_path / "small.png")[:, :, :3].astype(int)
    assert picture.shape[:2] == (550, 880)
    for colour in ((0, 114, 178), (213, 94, 0)):
        assert (np.abs(picture - colour).sum(-1) < 60).sum() > 100, "both methods are drawn"
    assert (tmp_path / "small.pdf").read_bytes().startswith(b"%PDF")
    page = (Path(__file__).parent.parent / f"docs/figures/fig{number}.md").read_text()
    assert table(measured(FIGURES[number], SHIPPED)) in page, f"repeat `velap figure {number} --no-run`"


def test_without_records_there_is_no_picture(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="found no records of SpiralMaze"):
        planning_time.show_planning_time(Console(quiet=True), "7", tmp_path / "a.png", no_run=True, records=tmp_path)
    with pytest.raises(ConfigError, match="got 0 episodes"):
        planning_time.show_planning_time(Console(quiet=True), "7", tmp_path / "a.png", episodes=0, records=tmp_path)


def test_labels_do_not_hide_a_method(tmp_path: Path) -> None:
    draw("ObstacleMaze", [point("velap", 5, 9), point("mppi", 50, 4)], tmp_path / "two.png")
    picture = imageio.imread(tmp_path / "two.png")[:, :, :3].astype(int)
    blue = (np.abs(picture - (0, 114, 178)).sum(-1) < 12).nonzero()[1]
    orange = (np.abs(picture - (213, 94, 0)).sum(-1) < 60).nonzero()[1]
    assert np.median(blue) < np.median(orange), "the faster method is on the left"
