"""What counts as success: one rule, by which datasets are read, and which checkpoints keep so that evaluation agrees.

Written as text: `reward>=1`, `info:success`, `info:coverage>=0.95`, `terminated`, `labels:answers.csv` or
`python:my_module:solved`. T transitions of one episode.
"""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from velap.errors import ConfigError, DatasetError

Source = Literal["reward", "info", "terminated", "labels", "python"]
Predicate = Callable[[float, Mapping[str, Any], bool], bool]
"""(reward, info, terminated) of a transition → is it a success?"""
INFO_KEYS = ("success", "is_success")
"""Infos by which environments tell success."""
_TRUE, _FALSE = ("1", "1.0", "true", "yes"), ("0", "0.0", "false", "no", "")
_TEXT = re.compile(r"(?P<source>\w+)(:(?P<name>[^>=]+))?(>=(?P<least>[-+]?[.\d]+(e[-+]?\d+)?))?")
_FORMS = {("reward", False, True), ("info", True, False), ("info", True, True), ("terminated", False, False),
          ("labels", True, False), ("python", True, False)}
"""Source, and whether it takes a name and a level."""


@dataclass(frozen=True)
class Success:
    """A rule that says of every transition whether it is a success."""

    source: Source
    name: str = ""
    """Of the info; path of the labels; `module:function`."""
    least: float | None = None
    """Smallest reward or info that is a success; None for infos that are true or false."""

    @classmethod
    def parse(cls, text: str) -> Success:
        """A rule from its text; raises ConfigError with the forms that exist."""
        found = _TEXT.fullmatch(text.strip())
        if found is None or (found["source"], found["name"] is not None, found["least"] is not None) not in _FORMS:
            raise ConfigError(f"the success rule is {text!r}; expected one of the forms reward>=1, info:success, "
                              "info:coverage>=0.95, terminated, labels:answers.csv, python:my_module:solved.")
        least = None if found["least"] is None else float(found["least"])
        return cls(found["source"], found["name"] or "", least)  # type: ignore[arg-type]

    def __str__(self) -> str:
        level = "" if self.least is None else f">={np.format_float_positional(np.float32(self.least), trim='-')}"
        return self.source + (f":{self.name}" if self.name else "") + level

    def reached(self, values: Any) -> Any:
        """Whether numbers [*] are successes. Compared in float32, in which most data are stored: 0.7 is not below 0.7."""
        return values.astype(bool) if self.least is None else values.astype(np.float32) >= np.float32(self.least)

    @cached_property
    def predicate(self) -> Predicate:
        """The function of a `python` rule."""
        module, _, function = self.name.partition(":")
        try:
            found: Predicate = getattr(import_module(module), function)
        except (ImportError, AttributeError, ValueError) as error:
            raise ConfigError(f"the success rule {self} names no function: {error}. Expected python:module:function, "
                              "with the module importable: set PYTHONPATH where it lies elsewhere.") from error
        return found

    @cached_property
    def labels(self) -> dict[int, int | None]:
        """Successful episodes by number and the step of their success, None for their last one, from a CSV file.

        The file has a header line with `episode` and `success` (0 or 1), and maybe `step`, counted from 0; separated by
        commas, semicolons or tabs, as spreadsheets write them.
        """
        try:
            text = Path(self.name).read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            raise DatasetError(f"the labels {self.name} cannot be read: {error}. Expected a CSV file with the columns "
                               "episode and success; `velap label` writes one.") from error
        header, *lines = text.splitlines() or [""]
        separator = max(",;\t", key=header.count)
        columns = [column.strip().lower() for column in header.split(separator)]
        found: dict[int, int | None] = {}
        for number, row in enumerate(csv.DictReader(lines, columns, delimiter=separator, skipinitialspace=True), start=2):
            try:
                answer = row["success"].strip().lower()
                if answer not in (*_TRUE, *_FALSE):
                    raise ValueError(f"success is {answer!r}")
                if answer in _TRUE:
                    found[_whole(row["episode"])] = _whole(row["step"]) if (row.get("step") or "").strip() else None
            except (KeyError, ValueError, AttributeError) as error:
                raise DatasetError(f"{self.name}, line {number}: {row} is no label ({error!r}); expected the columns "
                                   "episode, success (0 or 1) and maybe step. Mend the line.") from error
        return found

    def check_labels(self, episodes: int) -> None:
        """Raises DatasetError where the labels name an episode that the dataset has not."""
        beyond = [number for number in self.labels if not 0 <= number < episodes] if self.source == "labels" else []
        if beyond:
            raise DatasetError(f"{self.name} calls episode {beyond[0]} a success; expected numbers from 0 to "
                               f"{episodes - 1}, the episodes of the dataset. Mend that line, or give the labels of this "
                               "dataset.")

    def of_episode(self, number: int, rewards: np.ndarray, terminated: np.ndarray, infos: Mapping[str, np.ndarray],
                   where: str) -> np.ndarray:
        """bool [T] successes of episode `number`.

        Args:
            number: of the episode in its dataset.
            rewards: float [T].
            terminated: bool [T].
            infos: arrays of T entries, or of T + 1, of which the first one is the reset's.
            where: dataset and episode, for messages.
        """
        steps = len(rewards)
        if self.source == "reward":
            won: np.ndarray = self.reached(rewards)
            return won
        if self.source == "terminated":
            return terminated.copy()
        if self.source == "labels":
            won = np.zeros(steps, bool)
            if number in self.labels:
                step = self.labels[number]
                if step is not None and not 0 <= step < steps:
                    raise DatasetError(f"{self.name} puts the success of episode {number} at step {step}; expected one "
                                       f"of its {steps} steps. Mend that line.")
                won[steps - 1 if step is None else step] = True
            return won
        if self.source == "python":
            of_steps = {name: last_entries(values, steps) for name, values in infos.items() if len(values) in (steps,
            steps + 1)}
            return np.array([bool(self.predicate(float(rewards[t]), {name: values[t] for name, values in of_steps.items()},
                                                 bool(terminated[t]))) for t in range(steps)])
        if self.name not in infos:
            raise DatasetError(f"{where} has no info {self.name!r}; expected one of "
                               f"{', '.join(infos) or 'those stored (none)'}. Name one of them with --success info:NAME.")
        values = last_entries(np.asarray(infos[self.name]), steps)
        if values.shape != (steps,) or values.dtype.kind not in "fiub":
            raise DatasetError(f"{where}: the info {self.name} is {values.dtype} of shape {values.shape}; expected one "
                               "number a step. Name another one with --success info:NAME.")
        won = self.reached(values)
        return won


def _whole(text: str) -> int:
    """An integer, also as a table with empty cells writes it: `20.0`."""
    value = float(text)
    if not value.is_integer():
        raise ValueError(f"{text} is no whole number")
    return int(value)


def last_entries(values: np.ndarray, steps: int) -> np.ndarray:
    """[T or T + 1, *] → [T, *], the entries after each step: infos are stored with or without that of the reset."""
    values = values.reshape(len(values), -1)[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    return values[len(values) - steps :]


def success_of(reward: float, info: Mapping[str, Any], rule: Success | str | None = None,
               terminated: bool = False) -> bool:
    """Is a transition of an environment a success, by the rule that its checkpoint keeps?

    Without a rule, and for rules that an environment cannot follow (labels; an info that it does not give): what its info
    says under `success` or `is_success`, else a reward of 1. Raises ConfigError for other rewards than 0 and 1 without
    either: where every step costs or pays, they do not tell success.
    """
    rule = Success.parse(rule) if isinstance(rule, str) else rule
    if rule is not None and rule.source == "reward":
        return bool(rule.reached(np.asarray(reward)))
    if rule is not None and rule.source == "terminated":
        return terminated
    if rule is not None and rule.source == "python":
        return bool(rule.predicate(reward, info, terminated))
    rules = [rule] if rule is not None and rule.source == "info" else []
    for asked in (*rules, *(Success("info", key) for key in INFO_KEYS)):
        told = _entry(info, asked.name)
        if told is not None:
            return _told(asked, told)
    if reward not in (0, 1):
        missing = "`success`" if rule is None or rule.source != "info" else f"{rule.name!r}"
        raise ConfigError(f"the environment gave the reward {reward:g} and no {missing} in its info; expected the rewards 0 "
                          "and 1, of which 1 is success. Say what success is, such as --success 'reward>=0' for an "
                          "environment that gives -1 a step and 0 at the goal.")
    return reward == 1


def _entry(info: Any, name: str) -> Any:
    """The info of that name, `a/b` where infos are nested, as readers call it; None where there is none."""
    if name in info:
        return info[name]
    head, _, rest = name.partition("/")
    return _entry(info[head], rest) if rest and isinstance(info.get(head), Mapping) else None


def _told(rule: Success, value: Any) -> bool:
    """Whether an environment's info is a success; raises ConfigError unless it is one number or truth value."""
    told = np.asarray(value)
    if told.size != 1 or told.dtype.kind not in "fiub":
        inner = f"{rule.name}/{next(iter(value))}" if isinstance(value, Mapping) and value else "NAME"
        raise ConfigError(f"the environment's info {rule.name!r} is {str(value)[:80]!r}; expected true, false or one "
                          f"number. Name another info by --success info:{inner}.")
    return bool(rule.reached(told))
