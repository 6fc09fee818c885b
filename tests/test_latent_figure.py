"""Figure 3: its data are where they should be, and the picture comes from the committed data alone."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest

from latent_data import joint_checkpoint, noise_store
from toy_env import toy_player
from toy_world import GOAL
from velap import cli
from velap.errors import DatasetError
from velap.models.checkpoint import load_checkpoint
from velap.report import latent_figure
from velap.report.latent_figure import LatentSpace, draw, load, of_data, of_env, position_colours, save, spread

SHIPPED = Path(__file__).parent.parent / "results" / "figures"


def shipped(task: str) -> list[LatentSpace]:
    return load(SHIPPED / f"fig3-{task}.npz")


@pytest.fixture(scope="module")
def toy() -> LatentSpace:
    return of_env(toy_player(n_iter=60), "toy", count=150)


def test_a_scene_gives_positions_values_and_paths(toy: LatentSpace) -> None:
    assert toy.positions.shape == toy.plane.shape == (150, 2) and toy.values.shape == (150,)
    assert len(toy.landmarks) == len(toy.frames) == latent_figure.LANDMARKS
    assert (np.diff(toy.values[toy.landmarks]) >= 0).all(), "numbers grow with Q^g"
    assert len(toy.paths) == latent_figure.PATHS and len(toy.tree) == len(toy.parents)
    # the toy's latents are its positions: the plane keeps their distances, and paths approach the goal
    place = {"plane": toy.plane, "positions": toy.positions}
    apart = {name: np.linalg.norm(at - at[0], axis=1) for name, at in place.items()}
    assert np.corrcoef(apart["plane"], apart["positions"])[0, 1] > 0.8
    goal = toy.plane[np.linalg.norm(toy.positions - GOAL, axis=1).argmin()]
    for path in toy.paths:
        kept = path[np.isfinite(path[:, 0])]
        assert np.linalg.norm(kept[-1] - goal) < np.linalg.norm(kept[0] - goal)


def test_a_dataset_gives_what_it_knows(tmp_path: Path) -> None:
    store = noise_store()
    model, config, _ = load_checkpoint(joint_checkpoint(tmp_path / "model.safetensors", store), "cpu")
    space = of_data(model, config, "noise", store, count=60)
    assert space.positions.shape == (0, 2) and space.plane.shape == (60, 2)
    assert space.times.max() <= 6 and len(np.unique(space.times)) > 3
    draw([space], tmp_path / "noise.png")
    assert imageio.imread(tmp_path / "noise.png").shape[1] == 1870
    few = replace(store, episode_start=store.episode_start[:2], episode_length=store.episode_length[:2])
    with pytest.raises(DatasetError, match=r"2 episodes; expected 3 at least"):
        of_data(model, config, "noise", few)


def test_the_command_draws_any_checkpoint_and_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = noise_store(episodes=8)
    joint_checkpoint(tmp_path / "model.safetensors", store)
    np.savez(tmp_path / "data.npz", observations=store.frames, actions=store.actions, rewards=store.rewards,
             terminals=(store.last == np.arange(len(store.last))).astype(float))
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figure", "3", "mine", "--checkpoint", "model.safetensors", "--dataset", "data.npz"]) == 0
    (space,) = load(latent_figure.OWN_DATA / "fig3-mine.npz")
    assert space.title == "mine" and len(space.positions) == 0 and len(space.plane) > 30
    assert {path.name for path in latent_figure.OWN_DATA.iterdir()} == {"fig3-mine.npz", "fig3-mine.png", "fig3-mine.pdf"}


def test_a_file_keeps_all(toy: LatentSpace, tmp_path: Path) -> None:
    save(tmp_path / "toy.npz", [toy, replace(toy, title="again")])
    first, second = load(tmp_path / "toy.npz")
    assert (first.title, second.title) == ("toy", "again")
    for field in fields(LatentSpace):
        if field.name != "title":
            np.testing.assert_array_equal(getattr(first, field.name), getattr(toy, field.name))
    with pytest.raises(DatasetError, match="no data of the figure"):
        load(tmp_path / "nothing.npz")


@pytest.mark.parametrize(("task", "rows"), [("SpiralMaze", 1), ("ObstacleMaze", 2)])
def test_the_shipped_data_show_that_the_plane_follows_the_maze(task: str, rows: int) -> None:
    assert (SHIPPED / f"fig3-{task}.npz").stat().st_size < 500_000
    spaces = shipped(task)
    assert len(spaces) == rows
    for space in spaces:
        apart = np.linalg.norm(space.plane[:, None] - space.plane, axis=-1) + np.eye(len(space.plane)) * 1e9
        neighbours = np.linalg.norm(space.positions - space.positions[apart.argmin(1)], axis=1)
        assert np.median(neighbours) < 0.1, "neighbours in the plane are neighbours in the world [m]"
        goal = np.median(space.values[space.positions[:, 1] > 0.6]) if rows == 2 else 1
        assert goal > np.median(space.values), "values are high at the goal"
    if rows == 2:
        assert (spaces[0].background != spaces[1].background).any(), "two layouts"


def test_the_picture_is_made_of_the_shipped_data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "results").symlink_to(SHIPPED.parent)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["figure", "3", "--no-run", "--write", "small.png"]) == 0
    picture = imageio.imread(tmp_path / "small.png")[:, :, :3].astype(int)
    height, width = picture.shape[:2]
    assert width == 1870 and height > 900
    red = (np.abs(picture - (214, 39, 40)).sum(-1) < 30).nonzero()
    assert len(red[0]) > 500
    paths = red[1][np.abs(red[1] - width * 0.93) < width * 0.07]
    assert len(paths) > 300, "paths in the last column"
    for third in range(3):
        in_row = (red[0] > height * 0.95 * third / 3) & (red[0] < height * 0.95 * (third + 1) / 3) & (red[1] > width * 0.86)
        assert in_row.sum() > 100, f"row {third} has paths"
    assert (tmp_path / "small.pdf").read_bytes().startswith(b"%PDF")


def test_positions_have_the_colours_of_their_corners() -> None:
    corners = np.array([(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)])
    colours = position_colours(corners, np.array([-1.0, 1, -1, 1]))
    np.testing.assert_allclose(colours, latent_figure.CORNERS.reshape(4, 3))
    lightness = colours @ (0.299, 0.587, 0.114)
    assert lightness[:2].max() + 0.3 < lightness[2:].min(), "bottom and top differ in grey"


def test_landmarks_lie_apart() -> None:
    places = np.array([(0.0, 0), (0.1, 0), (5, 0), (5, 5), (0, 5)])
    assert set(spread(places, 4)) >= {2, 3, 4} and len(spread(places, 9)) == 5


def test_a_figure_without_tasks_refuses_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["figure", "tasks", "SpiralMaze"]) == 2
    assert "only figures 3, 5 and 6 take one" in capsys.readouterr().err
