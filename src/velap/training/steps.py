"""The one loop that steps through a training: loggers, diagnostics, checkpoints, interrupts, losses that are not finite.
Joint training and the learners on frozen latents are driven by it."""

from __future__ import annotations

import contextlib
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import NamedTuple, Protocol

from torch import Tensor

from velap.errors import TrainingError
from velap.signals import stop_signals
from velap.training.loggers import Logger


@dataclass(frozen=True)
class Progress:
    """What a progress view needs."""

    phase: str
    """Stage of the training, or the method whose head is learnt."""
    step: int
    """Updates done, all phases counted [steps]."""
    total: int
    """Updates of the whole run [steps]."""
    seconds: float
    """Training time so far, earlier sittings included [s]."""
    info: dict[str, float]
    """The latest losses and diagnostics."""


class Cadence(NamedTuple):
    """Updates between two of each [steps]."""

    log: int
    diagnose: int
    checkpoint: int


class Run(Protocol):
    """What `run_steps` drives: joint training and the learners on frozen latents."""

    step: int
    """Updates done [steps]."""
    seconds: float
    """Training time so far [s]."""

    @property
    def total(self) -> int:
        """Updates of the whole run [steps]."""
        ...

    @property
    def phase(self) -> str:
        """Name of what the last update belonged to."""
        ...

    @property
    def cadence(self) -> Cadence:
        """How often to log, diagnose and save."""
        ...

    @property
    def state_path(self) -> Path:
        """Where `save` puts the state."""
        ...

    def update(self) -> dict[str, Tensor]:
        """One update; adds one to `step`."""
        ...

    def report(self) -> dict[str, float]:
        """Diagnostics on held-out episodes."""
        ...

    def save(self) -> None:
        """Everything a resume needs."""
        ...


def run_steps(run: Run, loggers: Sequence[Logger], on_progress: Callable[[Progress], None],
              interrupted: threading.Event) -> None:
    """Update to the end or until interrupted; logs, diagnoses, saves, and raises TrainingError when a loss is not finite.
    The loggers are closed however it ends."""
    every = run.cadence
    clock = time.monotonic()
    with contextlib.ExitStack() as at_end:
        for logger in loggers:
            at_end.callback(logger.close)
        while run.step < run.total and not interrupted.is_set():
            info = run.update()
            row: dict[str, float] = {}
            last = run.step == run.total
            if run.step % every.log == 0 or last:
                row |= {name: float(value) for name, value in info.items()}
                _check_finite(row, run)
            if run.step % every.diagnose == 0 or last:
                row |= run.report()
            now = time.monotonic()
            run.seconds, clock = run.seconds + now - clock, now
            if row:
                for logger in loggers:
                    logger.log(run.step, run.phase, run.seconds, row)
                on_progress(Progress(run.phase, run.step, run.total, run.seconds, row))
            if run.step % every.checkpoint == 0:
                run.save()


def _check_finite(losses: Mapping[str, float], run: Run) -> None:
    """Raises TrainingError."""
    bad = sorted(name for name, value in losses.items() if not math.isfinite(value))
    if bad:
        kept = f"the last good state is in {run.state_path}" if run.state_path.exists() else "no state is kept yet"
        raise TrainingError(f"{', '.join(bad)} became NaN or infinite at step {run.step}; expected finite losses. "
                            f"Check the data for bad actions and rewards; {kept}.")


@contextlib.contextmanager
def interrupt_flag() -> Iterator[threading.Event]:
    """Within, the signals of `velap.signals` set the flag instead of breaking an update in two. A second Ctrl-C acts at
    once; others may come repeatedly, clusters send several. Outside the main thread signals stay as they are."""
    flag = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    previous = {number: signal.getsignal(number) for number in stop_signals()}

    def restore() -> None:
        for number, handler in previous.items():
            signal.signal(number, handler)

    def note(number: int, frame: FrameType | None) -> None:
        flag.set()
        if number == signal.SIGINT:
            signal.signal(number, previous[signal.SIGINT])

    for number in previous:
        signal.signal(number, note)
    try:
        yield flag
    finally:
        restore()


def cosine(done: float) -> float:
    """Factor of the learning rate after a share `done` of the updates: 1 at the start, a hundredth at the end."""
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done))
