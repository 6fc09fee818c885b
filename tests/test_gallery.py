"""Pictures of the tasks."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from studies import gallery
from velap.envs.mazes.obstacle import ObstacleMaze
from velap.errors import VelapError
from velap.tasks import get_task


def check_frame(sheet: np.ndarray, row: int, column: int, shot: gallery.Shot) -> None:
    """The sheet holds the frame there, each pixel as a square, and some text below."""
    top, left = gallery.GAP + row * (256 + gallery.CAPTION + gallery.GAP), gallery.GAP + column * (256 + gallery.GAP)
    for offset in (0, 3):
        np.testing.assert_array_equal(sheet[top + offset : top + 256 : 4, left + offset : left + 256 : 4], shot[0])
    assert sheet[top + 256 : top + 256 + gallery.CAPTION, left : left + 256].min() < 100


def test_the_picture_shows_start_and_success_of_every_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    names = ("SpiralMaze", "ObstacleMaze")
    monkeypatch.setattr(gallery, "TASKS", {name: get_task(name) for name in names})
    gallery.show_tasks(Console(), tmp_path / "docs" / "tasks.png", seed=2)
    sheet = np.asarray(Image.open(tmp_path / "docs" / "tasks.png"))
    for column, name in enumerate(names):
        for row, shot in enumerate(gallery.film(get_task(name), 2, 2)):
            check_frame(sheet, row, column, shot)


def test_episodes_lead_from_test_start_to_success(tmp_path: Path):
    gallery.show_episodes(Console(), tmp_path / "docs" / "tasks_widowx.png", seed=3)
    sheet = np.asarray(Image.open(tmp_path / "docs" / "tasks_widowx.png"))
    for row, name in enumerate(("Sponge", "Rope")):
        for column, shot in enumerate(gallery.film(get_task(name), 3, 6)):
            check_frame(sheet, row, column, shot)


def test_frames_are_those_of_an_episode_and_the_last_one_is_a_success(monkeypatch: pytest.MonkeyPatch):
    env = ObstacleMaze()
    frames = [env.reset(seed=0)[0]]
    while not env.succeeded():
        frames.append(env.step(env.expert_action())[0])
    steps = len(frames) - 1
    start, middle, success = gallery.film(get_task("ObstacleMaze"), 0, 3)
    for (frame, caption), step, text in ((start, 0, "ObstacleMaze, test start"), (middle, round(steps / 2), "step"),
                                         (success, steps, f"success after {steps} steps")):
        np.testing.assert_array_equal(frame, frames[step])
        assert caption.startswith(text)
    monkeypatch.setattr(ObstacleMaze, "expert_action", lambda self: np.zeros(2, np.float32))
    with pytest.raises(VelapError, match=r"expert of ObstacleMaze does not solve test seed 0.*velap study experts"):
        gallery.film(get_task("ObstacleMaze"), 0, 2)
