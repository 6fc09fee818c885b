"""Videos, pictures and the demo on the toy world: what is drawn is where it should be."""

from __future__ import annotations

from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from PIL import ImageFont
from rich.console import Console

from toy_env import SIDE, ToyModel, toy_env, toy_player
from toy_world import GOAL, misleading_value
from velap.errors import CheckpointError, StorageError
from velap.evaluation.evaluate import Player
from velap.evaluation.rollout import FrameReader
from velap.methods.tree_agent import IN_WORDS
from velap.models import checkpoint
from velap.report import demo
from velap.report.figures import LatentMap, can_probe, plan_figure, planned, probe, to_pixels
from velap.report.video import CAPTION, HOLD, TILE, VideoRecorder, film
from velap.search.est import plan


def test_positions_and_pixels_agree() -> None:
    corners = to_pixels(np.array([[-1.0, 3.0], [1.0, -1.0], [0.0, 1.0]]), (-1.0, 1.0, -1.0, 3.0), 100)
    np.testing.assert_allclose(corners, [[0, 0], [100, 100], [50, 50]])


def test_a_latent_map_locates_latents_and_knows_their_value() -> None:
    env = toy_env()
    assert can_probe(env)
    latent_map = probe(ToyModel(), env, FrameReader(env, SIDE), frame_stack=2,  # type: ignore[arg-type]
                       rng=np.random.default_rng(0), count=500)
    assert latent_map.latents.shape == (500, 2)
    # the toy's latents are its positions, up to a pixel's rounding of 0.04
    np.testing.assert_allclose(latent_map.latents, latent_map.positions, atol=0.05)
    np.testing.assert_allclose(latent_map.locate(latent_map.latents[7:9]), latent_map.positions[7:9])
    np.testing.assert_allclose(latent_map.values, misleading_value(torch.tensor(latent_map.latents)), rtol=1e-4)


def test_a_film_shows_every_step(tmp_path: Path) -> None:
    steps = 12
    film(toy_player(steps, n_iter=40), [0, 1], tmp_path / "two.mp4")
    reader = imageio.get_reader(tmp_path / "two.mp4")
    assert reader.get_meta_data()["size"] == (2 * TILE, TILE + CAPTION)
    assert reader.count_frames() == steps - 1 + HOLD
    first = reader.get_data(0)
    assert (np.abs(first.astype(int) - (255, 40, 40)).sum(-1) < 60).any(), "the next waypoint is a red dot"
    assert list(tmp_path.iterdir()) == [tmp_path / "two.mp4"]


def test_captions_can_be_drawn_and_fit() -> None:
    font = ImageFont.load_default(size=12)
    for words in IN_WORDS.values():
        assert words.isascii(), "the font has no other letters"
        ahead = "" if "," in words else "100 ahead, "
        assert font.getlength(f"Q^g 0.000, {ahead}{words}") < TILE - 6


def test_a_failing_film_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), VideoRecorder(tmp_path / "broken.mp4", 1):
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(StorageError), VideoRecorder(tmp_path / "file" / "video.mp4", 1):
        pass


def test_the_picture_of_a_plan(tmp_path: Path) -> None:
    player = toy_player(n_iter=60)
    latent_map = probe_few(player)
    fns = ToyModel().search_fns()  # type: ignore[arg-type]
    roots = torch.tensor([GOAL, (-3.0, 0.0)], dtype=torch.float64)
    result = plan(fns, roots, player.config.planner, torch.Generator().manual_seed(0))
    plan_figure(tmp_path / "plan.png", planned(result, 1), np.full((8, 8, 3), 200, np.uint8), latent_map, "title")
    image = imageio.imread(tmp_path / "plan.png")
    assert image.shape[:2] == (550, 1650)
    assert len(np.unique(image.reshape(-1, image.shape[2]), axis=0)) > 200


def test_the_demo_solves_films_and_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "load_player", lambda what: toy_player())
    monkeypatch.setattr(demo, "latent_map_of", lambda player: probe_few(player))
    console = Console(record=True, width=100, file=(tmp_path / "log").open("w"))
    summary = demo.run_demo(console, "toy", checkpoint=tmp_path / "any", episodes=2, out=tmp_path / "out", device="cpu")
    assert (summary.episodes, summary.successes) == (2, 2)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["episodes.mp4", "plan.png"]
    assert "100.0 (34.2 to 100.0)" in console.export_text()


def probe_few(player: Player) -> LatentMap:
    env = player.make_env()
    return probe(player.model, env, FrameReader(env, SIDE), frame_stack=2,  # type: ignore[arg-type]
                 rng=np.random.default_rng(0), count=150)


def test_a_missing_release_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(checkpoint, "__file__", str(tmp_path / "models" / "checkpoint.py"))
    with pytest.raises(CheckpointError, match="velap run SpiralMaze"):
        checkpoint.released_checkpoint("SpiralMaze")
