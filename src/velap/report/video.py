"""Videos of rollouts: one tile an environment, with the waypoints of its agent drawn at their positions in the world.

S side of a tile [px], B environments.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from velap.methods.tree_agent import FOLLOWING, IN_WORDS, TreeAgent
from velap.report.figures import PROBES, LatentMap, can_probe, probe, to_pixels
from velap.runs import storage_errors

if TYPE_CHECKING:
    from velap.evaluation.evaluate import Player
    from velap.evaluation.rollout import Moment

TILE = 256
"""S [px]."""
COLUMNS = 5
"""Tiles side by side at most."""
CAPTION = 32
"""Height of a tile's caption [px]; a multiple of 16, as video codecs want it."""
FPS = 20
"""Frames a second: environment steps of 0.05 s in real time."""
HOLD = 20
"""Number of times that the last picture is repeated."""
_WAYPOINT, _NEXT, _SOLVED, _FAILED = (255, 140, 0), (255, 40, 40), (20, 140, 60), (170, 30, 30)


class VideoRecorder:
    """An observer that writes an mp4 with B tiles while the episodes run; the file appears when it is complete."""

    def __init__(self, path: Path, tiles: int, latent_map: LatentMap | None = None) -> None:
        self.path = path
        self._map = latent_map
        self._columns = min(tiles, COLUMNS)
        rows = math.ceil(tiles / self._columns)
        self._canvas = np.full((rows * (TILE + CAPTION), self._columns * TILE, 3), 255, np.uint8)
        self._steps = [0] * tiles
        self._last_row = -1
        self._font = ImageFont.load_default(size=12)
        self._partial = path.with_name(f".{os.getpid()}-{path.name}")  # of this process alone

    def __enter__(self) -> Self:
        height, width = self._canvas.shape[:2]
        with storage_errors(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._partial.touch()
        self._writer = imageio_ffmpeg.write_frames(
            str(self._partial), (width, height), fps=FPS, quality=7, macro_block_size=16,
            output_params=["-f", "mp4", "-movflags", "+faststart"], ffmpeg_log_level="error")
        self._writer.send(None)
        return self

    def __call__(self, moment: Moment) -> None:
        """Draw the tile of a row; each round over the rows writes a frame."""
        row, outcome = moment.row, moment.outcome
        if row <= self._last_row and outcome is None:
            self._write()
        self._last_row = row
        text = f"episode {moment.seed}, step {self._steps[row]}\n"
        image = Image.fromarray(picture(moment, TILE))
        colour: tuple[int, int, int] = (0, 0, 0)
        if outcome is not None:
            text, colour = (f"{text}solved", _SOLVED) if outcome.success else (f"{text}not solved", _FAILED)
            self._steps[row] = 0
        else:
            self._steps[row] += 1
            if isinstance(moment.agent, TreeAgent):
                text += self._draw_plan(image, moment.agent, row)
        caption = Image.new("RGB", (TILE, CAPTION), "white")
        ImageDraw.Draw(caption).text((6, 1), text, colour, font=self._font, spacing=2)
        y, x = row // self._columns * (TILE + CAPTION), row % self._columns * TILE
        self._canvas[y : y + TILE, x : x + TILE] = np.asarray(image)
        self._canvas[y + TILE : y + TILE + CAPTION, x : x + TILE] = np.asarray(caption)

    def _draw_plan(self, image: Image.Image, agent: TreeAgent, row: int) -> str:
        """Draw the waypoints ahead of `row`, the next one in red; returns the caption."""
        value = agent.last_values[row]
        waypoints = agent.plans.ahead(row).float().cpu().numpy()
        actor = agent.last_actors[row]
        if actor not in FOLLOWING:
            return f"Q^g {value:.3f}, {IN_WORDS[actor]}"
        if self._map is not None:
            points = [tuple(point) for point in to_pixels(self._map.locate(waypoints), self._map.extent, TILE)]
            draw = ImageDraw.Draw(image)
            draw.line(points, _WAYPOINT, width=2)
            for point in points[:0:-1]:
                draw.circle(point, 3, _WAYPOINT)
            draw.circle(points[0], 4, _NEXT)
        return f"Q^g {value:.3f}, {len(waypoints)} ahead, {IN_WORDS[actor]}"

    def _write(self) -> None:
        with storage_errors(self.path):
            self._writer.send(self._canvas.tobytes())

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        for _ in range(HOLD if kind is None else 0):
            self._write()
        self._writer.close()
        with storage_errors(self.path):
            if kind is None:
                self._partial.replace(self.path)
            else:
                self._partial.unlink(missing_ok=True)


def picture(moment: Moment, size: int) -> NDArray[np.uint8]:
    """A picture of the environment, uint8 [size, size, 3], rendered at that size if possible, else enlarged; the agent's
    frame if the environment renders nothing."""
    env = moment.env
    if can_probe(env):
        return env.unwrapped.render(size)
    drawn = env.render() if env.render_mode == "rgb_array" else None
    image = Image.fromarray(moment.frame if drawn is None else np.asarray(drawn, np.uint8))
    return np.asarray(image.resize((size, size), Image.Resampling.NEAREST))


def latent_map_of(player: Player, seed: int = 0, count: int = PROBES) -> LatentMap | None:
    """Real states of the scene of that seed, by the player's model; None if the environment cannot be probed."""
    env = player.make_env()
    try:
        if player.model is None or not can_probe(env):
            return None
        return probe(player.model, env, player.frames_of(env), frame_stack=player.agent.frame_stack,
                     rng=np.random.default_rng(0), count=count, seed=seed)
    finally:
        env.close()


def film(player: Player, seeds: Sequence[int], path: Path) -> None:
    """Run the episodes of `seeds` again, all at once, and film them."""
    with VideoRecorder(path, len(seeds), latent_map_of(player)) as recorder:
        for _ in player.episodes(seeds, len(seeds), recorder):
            pass
