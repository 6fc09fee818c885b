"""`velap inspect` and `velap label`: a stranger's data before an hour of training is spent."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from velap.cli.options import ImageKey, StateKey, joined, note, say
from velap.errors import ConfigError

Dataset = Annotated[Positional[str], arg(help="Path of a dataset, or its Minari or LeRobot id.")]
Fit = Literal["crop", "pad", "squash"]


def inspect(dataset: Dataset, image_key: ImageKey = (), success: str | None = None, fit: Fit | None = None,
            image_size: int = 64, mapped: bool = False, state_key: StateKey = (), out: Path | None = None) -> None:
    """Say what is in a dataset and what will not work with it; writes a page, its figures as JSON, and pictures.

    Args:
        success: Rule of success, such as `info:solved`, `terminated` or `labels:answers.csv`.
        fit: How oblong images become square.
        image_size: Side that images are resized to [px].
        mapped: Map the frames from a file beside the dataset instead of reading them into memory.
        out: Folder of the report. Default: runs/inspection/NAME.
    """
    from velap.report.inspect import inspect as run
    from velap.report.inspect import inspection_text, save_inspection

    found = run(dataset, image_key=joined(image_key), image_size=image_size, fit=fit, success=success,
                mapped=mapped or None, state_key=joined(state_key))
    folder = out or Path("runs/inspection") / Path(dataset).name
    say(inspection_text(found))
    for path in save_inspection(found, folder):
        say(f"written {path}")


def label(dataset: Dataset, out: Path = Path("labels.csv"), successes: str | None = None, image_key: ImageKey = (),
          fit: Fit | None = None) -> None:
    """Show the last frames of all episodes and write which ones succeed, for `--success labels:FILE.csv`.

    Writes contact sheets beside the labels, then takes numbers of the successful episodes from standard input: `3, 7-9`, or
    `12:20` for a success at step 20 of episode 12. An empty line ends them.

    Args:
        out: The CSV file.
        successes: The answers, instead of standard input.
        fit: How oblong images become square.
    """
    from velap.data.labels import draw_sheets, never, parse_answers, write_labels
    from velap.data.loading import load_store

    store = load_store(dataset, joined(image_key), fit=fit, success=never, need_success=False)
    answers = None if successes is None else parse_answers(successes, store)
    for path in draw_sheets(store, out.parent, out.stem):
        say(f"last frames {path}")
    if answers is None:
        say(f"numbers of the successful episodes, 0 to {store.n_episodes - 1}; an empty line ends them:")
        answers = parse_answers(" ".join(_lines()), store)
    if not answers:
        raise ConfigError("got no successful episode; expected at least one number. Look at the sheets and repeat the "
                          "command.")
    write_labels(out, answers, store.n_episodes)
    say(f"labels {out}: {len(answers)} of {store.n_episodes} episodes succeed")
    note(f"use them by --success labels:{out}")


def _lines() -> list[str]:
    """Lines of standard input up to the first empty one."""
    lines: list[str] = []
    for line in sys.stdin:
        if not line.strip():
            break
        lines.append(line)
    return lines
