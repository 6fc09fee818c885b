"""`velap config`: every field that a setting can change, with its value in a preset and its meaning."""

from __future__ import annotations

from rich.markup import escape
from tyro.conf import Positional

from velap.cli.options import OUT, Preset, say


def config(task: Positional[str] = "my/dataset-v0", preset: Preset = "default") -> None:
    """Every config field with its value, type and meaning.

    Args:
        task: Task name, or the id of your own dataset.
    """
    from velap.config import describe
    from velap.tasks import make_config

    made = make_config(task, preset)
    say(f"# {task}, preset {preset}, hash {made.hash()}. Change a field with --set NAME=VALUE. train.PHASE.steps adds a "
        "phase "
        "that has no value here (-), 0 leaves one out.")
    for name, kind, value, meaning in describe(made):
        OUT.print(f"[bold]{name}[/bold] = {escape(value)}  ({escape(kind)})\n    {escape(meaning)}", soft_wrap=True)
