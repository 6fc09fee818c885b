"""`velap study experts`: what it counts and what it writes."""

import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from studies import experts
from velap.envs.mazes.env import SpiralMaze
from velap.envs.mazes.obstacle import ObstacleMaze
from velap.errors import UnknownTaskError
from velap.tasks import get_task


def test_successes_and_steps_are_counted():
    trials = experts.try_task(get_task("ObstacleMaze"), range(2, 4))
    assert (trials.first_seed, trials.episodes, trials.max_steps) == (2, 2, 100)
    assert (trials.expert, trials.random) == (2, 0)
    maze = ObstacleMaze()
    steps = []
    for seed in (2, 3):
        maze.start({"split": "test"}, seed)
        steps.append(float(maze.geodesic_steps(maze.agent_position())))
    assert trials.expert_steps == pytest.approx(np.mean(steps), abs=3)
    assert trials.longest == pytest.approx(max(steps), abs=3)


def test_lucky_actions_are_counted(monkeypatch: pytest.MonkeyPatch):
    """The block starts right before SpiralMaze's goal."""
    def near(self, rng, split, context):
        self.set_agent_position(np.array([-0.06, rng.uniform(-0.02, 0.02)]))

    monkeypatch.setattr(SpiralMaze, "_start", near)
    trials = experts.try_task(get_task("SpiralMaze"), range(2))
    assert (trials.expert, trials.random) == (2, 2)
    assert trials.expert_steps < 5


def test_an_expert_that_fails_is_counted_as_such(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(ObstacleMaze, "expert_action", lambda self: np.zeros(2, np.float32))
    trials = experts.try_task(get_task("ObstacleMaze"), range(2))
    assert (trials.expert, trials.longest, trials.expert_steps) == (0, 0, None)
    assert "| 0 of 2 | - | 0 |" in " ".join(experts.table([trials]).split())


def test_the_report_and_the_figures_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    trials = experts.Trials(
        task="ObstacleMaze",
        first_seed=5,
        episodes=10,
        max_steps=100,
        expert=9,
        expert_steps=51.25,
        longest=69,
        random=1)
    arm = experts.Trials(
        task="WindowClose",
        first_seed=5,
        episodes=10,
        max_steps=150,
        expert=10,
        expert_steps=90.0,
        longest=99,
        random=0)
    made = iter((trials, arm))
    monkeypatch.setattr(experts, "try_task", lambda task, seeds, on_episode: next(made))
    experts.study_experts(Console(), True, 5, tmp_path / "a.md", tmp_path / "a.json", ("ObstacleMaze", "WindowClose"))
    text = " ".join((tmp_path / "a.md").read_text().split())
    assert "`velap study experts --quick --seed 5 --write" in text
    assert "seeds 5 to 14 of the test split" in text
    assert "| ObstacleMaze | 100 | 9 of 10 | 51.2 | 69 | 1 of 10 |" in text
    assert "| WindowClose | 150 | 10 of 10 | 90.0 | 99 | 0 of 10 |" in text
    rows = json.loads((tmp_path / "a.json").read_bytes())
    assert [row["expert_steps"] for row in rows] == [51.25, 90.0]
    with pytest.raises(UnknownTaskError):
        experts.study_experts(Console(), tasks=("Nowhere",))
