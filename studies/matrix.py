"""The cells of Table 1: task × method × preset × training seed, and which of them a command line asks for."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from studies.paper import LABELS
from studies.paper import TASKS as PAPER_TASKS
from velap.errors import ConfigError, UnknownTaskError
from velap.registry import METHODS
from velap.tasks import PRESETS, TASKS

AXES = ("task", "method", "preset", "seed")


def in_paper_order(names: Iterable[str], order: Sequence[str]) -> tuple[str, ...]:
    """`names` as the paper lists them, those that it does not know behind."""
    given = tuple(names)
    return tuple(name for name in order if name in given) + tuple(name for name in given if name not in order)


@dataclass(frozen=True, order=True)
class Cell:
    """One evaluation."""

    task: str
    method: str
    preset: str
    seed: int
    """Training seed; 0 for `random`, which learns nothing."""

    def __str__(self) -> str:
        return f"{self.task} {self.method} {self.preset} seed {self.seed}"


@dataclass(frozen=True)
class Selection:
    """Values of each axis; the cells are their product."""

    tasks: tuple[str, ...]
    methods: tuple[str, ...]
    presets: tuple[str, ...] = ("default",)
    seeds: tuple[int, ...] = (0,)

    def cells(self) -> tuple[Cell, ...]:
        """All cells, task by task. `random` has no training seeds and comes once a preset."""
        product = (Cell(task, method, preset, 0 if method == "random" else seed)
                   for task in self.tasks for preset in self.presets for seed in self.seeds for method in self.methods)
        return tuple(dict.fromkeys(product))

    def __str__(self) -> str:
        sizes = {"method": self.methods, "task": self.tasks, "preset": self.presets, "training seed": self.seeds}
        return " × ".join(f"{len(values)} {name}{'' if len(values) == 1 else 's'}" for name, values in sizes.items())


def everything() -> Selection:
    """All tasks and methods, the default preset, training seed 0."""
    return Selection(in_paper_order(TASKS, PAPER_TASKS), in_paper_order(METHODS, tuple(LABELS)))


def parse_only(filters: Sequence[str]) -> Selection:
    """`["task=SpiralMaze", "method=bc,iql"]` -> the selection; an axis that is not named keeps its value of `everything`.

    Raises ConfigError on another form, UnknownTaskError on names that are not registered.
    """
    whole = everything()
    chosen: dict[str, tuple[str, ...]] = {}
    for text in filters:
        axis, equals, values = text.partition("=")
        names = tuple(name for name in values.split(",") if name)
        if not equals or axis not in AXES or not names:
            raise ConfigError(f"--only got {text!r}; expected AXIS=VALUE,VALUE with an axis of {', '.join(AXES)}, such as "
                              "`--only task=SpiralMaze method=bc,iql`.")
        if axis in chosen:
            raise ConfigError(f"--only names the axis {axis!r} twice; give all its values at once: {axis}=A,B.")
        chosen[axis] = tuple(dict.fromkeys(names))
    known = {"task": whole.tasks, "method": whole.methods, "preset": PRESETS}
    for name, allowed in known.items():
        _check_names(name, chosen.get(name, ()), allowed)
    return Selection(in_paper_order(chosen.get("task", whole.tasks), PAPER_TASKS),
                     in_paper_order(chosen.get("method", whole.methods), tuple(LABELS)),
                     chosen.get("preset", whole.presets), tuple(_seed(text) for text in chosen.get("seed", ("0",))))


def _check_names(axis: str, names: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise UnknownTaskError(f"--only names the unknown {axis} {unknown[0]!r}; expected some of {', '.join(known)}. "
                               "Names are case-sensitive.")


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise ConfigError(f"--only got the seed {text!r}; expected whole numbers from 0 on, such as seed=0,1,2.")
    return int(text)
