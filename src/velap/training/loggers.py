"""Where the losses of a training go: files, TensorBoard, Weights & Biases, or any object with `log` and `close`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol

from velap.errors import ConfigError
from velap.runs import storage_errors, write_atomic


class Logger(Protocol):
    """Takes the losses and diagnostics of logged updates."""

    def log(self, step: int, phase: str, seconds: float, values: Mapping[str, float]) -> None:
        """`values` after `step` updates and so many seconds of training [s]."""
        ...

    def close(self) -> None:
        """The training ends, pauses or fails."""
        ...


class JsonLines:
    """One line a logged step in a file; a resume drops what came after its state."""

    def __init__(self, path: Path, resumed_step: int | None) -> None:
        self.path = Path(path)
        kept: list[str] = []
        if resumed_step is not None and self.path.exists():
            kept = [line for line in self.path.read_text().splitlines() if _step_of(line) <= resumed_step]
        write_atomic(self.path, "".join(f"{line}\n" for line in kept).encode())

    def log(self, step: int, phase: str, seconds: float, values: Mapping[str, float]) -> None:
        """Adds one line."""
        row = {"step": step, "phase": phase, "seconds": round(seconds, 1), **values}
        with storage_errors(self.path), open(self.path, "a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def close(self) -> None:
        """Every line is written already."""


def _step_of(line: str) -> float:
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")


class TensorBoard:
    """TensorBoard events."""

    def __init__(self, folder: Path, resumed_step: int | None) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._writer = SummaryWriter(str(folder), purge_step=resumed_step or 0)

    def log(self, step: int, phase: str, seconds: float, values: Mapping[str, float]) -> None:
        """One scalar a value."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        """Write what is buffered."""
        self._writer.close()


class WandB:
    """A run of Weights & Biases, which its own environment variables configure."""

    def __init__(self, folder: Path, resumed_step: int | None) -> None:
        try:
            import wandb  # type: ignore[import-not-found]
        except ImportError as error:
            raise ConfigError("the logger 'wandb' needs the package wandb, which is not installed; expected it. Install it "
                              "with `pip install wandb`, or leave the logger out.") from error
        folder.mkdir(parents=True, exist_ok=True)
        name = "-".join(folder.parts[-3:])
        self._run: Any = wandb.init(project="velap", dir=str(folder), id=name, name=name, resume="allow")

    def log(self, step: int, phase: str, seconds: float, values: Mapping[str, float]) -> None:
        """One row."""
        self._run.log({"phase": phase, "seconds": seconds, **values}, step=step)

    def close(self) -> None:
        """Upload what is buffered."""
        self._run.finish()


BUILT_IN: dict[str, Callable[[Path, str, int | None], Logger]] = {
    "jsonl": lambda folder, stem, step: JsonLines(folder / (f"{stem}.metrics.jsonl" if stem else "metrics.jsonl"), step),
    "tensorboard": lambda folder, stem, step: TensorBoard(folder / "tensorboard" / stem, step),
    "wandb": lambda folder, stem, step: WandB(folder / stem, step),
}
"""Loggers by name: made from the run's folder, the head's name (empty for a joint training) and the step of a resume."""
DEFAULT = ("jsonl", "tensorboard")


def make_loggers(loggers: Iterable[str | Logger], folder: Path, stem: str, resumed_step: int | None) -> list[Logger]:
    """Loggers that were named, made; those that were given, as they are. Raises ConfigError for an unknown name."""
    made: list[Logger] = []
    for each in loggers:
        if isinstance(each, str) and each not in BUILT_IN:
            raise ConfigError(f"unknown logger {each!r}; expected some of {', '.join(BUILT_IN)}, or an object with log and "
                              "close.")
        made.append(BUILT_IN[each](folder, stem, resumed_step) if isinstance(each, str) else each)
    return made
