"""What several commands share: the types of their options, and where they print."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

from rich.console import Console
from tyro.conf import Positional, UseAppendAction, arg

OUT = Console(highlight=False)
ERR = Console(stderr=True, highlight=False)

Task = Annotated[Positional[str], arg(help="Task name, see `velap info`.")]
Preset = Annotated[Literal["default", "paper"], arg(help="`paper`: Tables 2-10. `default`: what measured best.")]
Method = Annotated[str, arg(help="velap, a baseline of Table 1 (bc, bc-success, td3bc, iql, mppi, mbop, iris, "
                                 "iris-multistep), iql-sparse (the setting of IQL's authors for sparse rewards), random, or "
                                 "a method of an installed package. td3bc is π^g alone.")]
Device = Annotated[Literal["auto", "cpu", "cuda"], arg(help="`auto`: CUDA if there is a GPU.")]
Settings = Annotated[tuple[tuple[str, ...], ...], UseAppendAction,
                     arg(name="set", help="Config fields to replace, such as `planner.n_iter=500`.")]
"""One tuple for each `--set` of the command line."""
ImageKey = Annotated[tuple[str, ...], UseAppendAction,
                     arg(metavar="KEY", help="Key of the image in dict observations, `a/b` when nested. Give it once "
                                             "for each camera: several stand side by side in one frame.")]
StateKey = Annotated[tuple[str, ...], UseAppendAction,
                     arg(metavar="KEY", help="Key of numbers beside the image, such as joint angles, that the latent "
                                             "holds too. Give it once for each.")]
Records = Annotated[Path, arg(help="Root of the episode records.")]


def joined(keys: tuple[str, ...]) -> str | None:
    """The keys of `--image-key` or `--state-key` as the Python interface takes them: `a,b`."""
    return ",".join(keys) or None


def command() -> str:
    """The command as it was typed, for provenance."""
    return shlex.join(["velap", *sys.argv[1:]])


def say(text: str) -> None:
    """Print a line on standard output, unbroken."""
    OUT.print(text, markup=False, soft_wrap=True)


def note(text: str) -> None:
    """Print a note on standard error, unbroken."""
    ERR.print(f"note: {text}", markup=False, soft_wrap=True)
