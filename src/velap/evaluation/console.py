"""Progress: a bar on a terminal, plain lines in a log file."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

if TYPE_CHECKING:
    from velap.evaluation.records import Record
    from velap.training.steps import Progress as TrainProgress

LINE_EVERY = 15.0
"""Time between progress lines without a terminal [s]."""


class ProgressBar:
    """A progress bar with a text beside it; without a terminal, a line every `LINE_EVERY` and one at the end."""

    def __init__(self, console: Console, title: str, total: int) -> None:
        self._console, self._title, self._total = console, title, total
        self._last_line = time.monotonic()
        self._first: tuple[int, float] | None = None
        self._bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                             TextColumn("left"), TimeRemainingColumn(), TextColumn("{task.fields[info]}"), console=console,
                             disable=not console.is_terminal)
        self._task = self._bar.add_task(title, total=total, info="")

    def show(self, done: int, info: str = "", title: str | None = None, total: int | None = None) -> None:
        """`done` of the total, with a text."""
        self._title, self._total = title or self._title, total or self._total
        self._bar.update(self._task, completed=done, total=self._total, info=info, description=self._title)
        now = time.monotonic()
        if self._first is None or done < self._first[0]:
            self._first = (done, now)
        if not self._console.is_terminal and (done == self._total or now - self._last_line >= LINE_EVERY):
            self._last_line = now
            self._console.print(f"{self._title}: {done} of {self._total}{self._left(done, now)}  {info}", markup=False,
                                soft_wrap=True)

    def _left(self, done: int, now: float) -> str:
        """Remaining time at the pace so far."""
        first, start = self._first or (done, now)
        if done <= first or done >= self._total:
            return ""
        seconds = (now - start) / (done - first) * (self._total - done)
        return f", {seconds / 60:.0f} min left" if seconds > 120 else f", {seconds:.0f} s left"

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._bar.stop()


class TrainingBar(ProgressBar):
    """Steps and losses of successive training runs; each report has its own total."""

    def __init__(self, console: Console) -> None:
        super().__init__(console, "training", 1)

    def __call__(self, progress: TrainProgress) -> None:
        """One report of the training loop."""
        losses = "  ".join(f"{name.removeprefix('loss/')} {value:.3g}" for name, value in list(progress.info.items())[:6])
        self.show(progress.step, losses, f"training, {progress.phase}", progress.total)


class EpisodeBar(ProgressBar):
    """Counts episodes and successes."""

    def __init__(self, console: Console, title: str, total: int) -> None:
        super().__init__(console, title, total)
        self._episodes = self._solved = self._steps = 0

    def step(self, row: int) -> None:
        """One more environment step of `row`; row 0 updates the bar."""
        if row == 0:
            self._steps += 1
            self.show(self._episodes, f"{self._solved} solved, step {self._steps}")

    def __call__(self, record: Record) -> None:
        """One more record."""
        self._episodes += 1
        self._solved += record.success
        self.show(self._episodes, f"{self._solved} solved; seed {record.episode_seed}: "
                                  f"{'solved' if record.success else 'not solved'} after {record.steps} steps")
