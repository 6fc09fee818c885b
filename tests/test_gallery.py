"""The picture of all tasks."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from studies import gallery
from velap.envs.mazes.obstacle import ObstacleMaze
from velap.errors import VelapError
from velap.tasks import get_task


def test_the_picture_shows_start_and_goal_of_every_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    names = ("SpiralMaze", "ObstacleMaze")
    monkeypatch.setattr(gallery, "TASKS", {name: get_task(name) for name in names})
    gallery.show_tasks(Console(), tmp_path / "docs" / "tasks.png", seed=2)
    sheet = np.asarray(Image.open(tmp_path / "docs" / "tasks.png"))
    for column, name in enumerate(names):
        shots = gallery.shoot(get_task(name), 2)
        left, row = gallery.GAP + column * (256 + gallery.GAP), 256 + gallery.CAPTION + gallery.GAP
        for number, frame in enumerate((shots.start, shots.goal)):
            top = gallery.CAPTION + number * row
            np.testing.assert_array_equal(sheet[top : top + 256 : 4, left : left + 256 : 4], frame)
            np.testing.assert_array_equal(sheet[top + 3 : top + 256 : 4, left + 3 : left + 256 : 4], frame)
        caption = sheet[2 * row - gallery.GAP : 2 * row + gallery.CAPTION - gallery.GAP, left : left + 256]
        assert caption.min() < 100  # there is text


def test_films_lead_from_test_start_to_success(tmp_path: Path):
    gallery.show_episodes(Console(), tmp_path / "docs" / "tasks_widowx.png", seed=3)
    sheet = np.asarray(Image.open(tmp_path / "docs" / "tasks_widowx.png"))
    for row, name in enumerate(("Sponge", "Rope")):
        shots = gallery.shoot(get_task(name), 3)
        frames, times = gallery.film(get_task(name), 3)
        assert times[-1] == shots.steps
        np.testing.assert_array_equal(frames[0], shots.start)
        np.testing.assert_array_equal(frames[-1], shots.goal)
        top = gallery.GAP + row * (256 + gallery.CAPTION + gallery.GAP)
        for column, frame in enumerate(frames):
            left = gallery.GAP + column * (256 + gallery.GAP)
            np.testing.assert_array_equal(sheet[top : top + 256 : 4, left : left + 256 : 4], frame)


def test_the_goal_state_is_a_success(monkeypatch: pytest.MonkeyPatch):
    shots = gallery.shoot(get_task("ObstacleMaze"), 0)
    env = ObstacleMaze()
    frames = [env.reset(seed=0)[0]]
    while not env.succeeded():
        frames.append(env.step(env.expert_action())[0])
    np.testing.assert_array_equal(shots.start, frames[0])
    np.testing.assert_array_equal(shots.goal, frames[-1])
    assert shots.steps == len(frames) - 1
    monkeypatch.setattr(ObstacleMaze, "expert_action", lambda self: np.zeros(2, np.float32))
    with pytest.raises(VelapError, match=r"expert of ObstacleMaze does not solve test seed 0.*velap study experts"):
        gallery.shoot(get_task("ObstacleMaze"), 0)
