"""`velap label`: the last frames of episodes as contact sheets, and the answers as the CSV that a success rule reads."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from velap.data.frames import FrameStore
from velap.errors import ConfigError
from velap.runs import write_atomic

COLUMNS, ROWS = 10, 10
"""Frames of a sheet."""
TILE, CAPTION, GAP = 128, 18, 4
"""Side of a frame, height of its number, and space between frames [px]."""
_ANSWER = re.compile(r"(?P<first>\d+)(-(?P<last>\d+)|:(?P<step>\d+))?")


def never(reward: float, info: Mapping[str, Any], terminated: bool) -> bool:
    """The success rule by which episodes are read whole, to be labelled."""
    return False


def draw_sheets(store: FrameStore, folder: Path, stem: str) -> list[Path]:
    """The last frame of each episode with its number, 100 a sheet: `<stem>-1.png`, ...; returns the paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths, font = [], ImageFont.load_default(size=14)
    for page, first in enumerate(range(0, store.n_episodes, COLUMNS * ROWS), start=1):
        episodes = range(first, min(first + COLUMNS * ROWS, store.n_episodes))
        columns = min(COLUMNS, len(episodes))
        rows = -(-len(episodes) // columns)
        sheet = Image.new("RGB", (columns * (TILE + GAP) + GAP, rows * (TILE + CAPTION + GAP) + GAP), "white")
        pen = ImageDraw.Draw(sheet)
        for place, episode in enumerate(episodes):
            left, top = GAP + place % columns * (TILE + GAP), GAP + place // columns * (TILE + CAPTION + GAP)
            frame = Image.fromarray(store.frames[store.episode_start[episode] + store.episode_length[episode]])
            pen.text((left + 2, top), str(episode), fill="black", font=font)
            sheet.paste(frame.resize((TILE, TILE), Image.Resampling.NEAREST), (left, top + CAPTION))
        paths.append(folder / f"{stem}-{page}.png")
        sheet.save(paths[-1])
    return paths


def parse_answers(text: str, store: FrameStore) -> dict[int, int | None]:
    """`3, 7-9, 12:20` → the successful episodes 3, 7, 8, 9 and 12, the last one at its step 20; ConfigError for the rest."""
    found: dict[int, int | None] = {}
    for word in re.split(r"[\s,;]+", text.strip()):
        if not word:
            continue
        answer = _ANSWER.fullmatch(word)
        if answer is None:
            raise ConfigError(f"got the answer {word!r}; expected numbers of episodes such as 3, ranges such as 7-9, or "
                              "12:20 for a success at step 20 of episode 12. Correct it and repeat the command.")
        first, last = int(answer["first"]), int(answer["last"] or answer["first"])
        if not first <= last < store.n_episodes:
            raise ConfigError(f"got the answer {word!r}; expected episodes from 0 to {store.n_episodes - 1}, the smaller "
                              "one first. Correct it and repeat the command.")
        step = None if answer["step"] is None else int(answer["step"])
        if step is not None and step >= store.episode_length[first]:
            raise ConfigError(f"got the answer {word!r}; expected a step from 0 to {store.episode_length[first] - 1} of "
                              f"episode {first}. Correct it and repeat the command.")
        found |= dict.fromkeys(range(first, last + 1), step)
    return found


def write_labels(path: Path, answers: Mapping[int, int | None], episodes: int) -> None:
    """A CSV with one line an episode: its number, 1 for success or 0, and the step of the success where one was named."""
    table = io.StringIO(newline="")
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["episode", "success", "step"])
    for episode in range(episodes):
        step = answers.get(episode)
        writer.writerow([episode, int(episode in answers), "" if step is None else step])
    write_atomic(path, table.getvalue().encode())
