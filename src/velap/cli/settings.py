"""`--set PART.FIELD=VALUE` of the command line."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

from velap.config import Config
from velap.errors import ConfigError

PARTS = ("model", "train", "planner", "controller")


def parse_settings(settings: Sequence[Sequence[str]], further: Mapping[str, object] | None = None,
                   ) -> dict[str, dict[str, Any]]:
    """`[["planner.n_iter=500"]]` -> `{"planner": {"n_iter": 500}}`; raises ConfigError on any other form.

    `further` parts beside those of the config, such as a method's own settings, with their defaults.
    """
    parts = {**{part: getattr(Config(task="", preset=""), part) for part in PARTS}, **(further or {})}
    changes: dict[str, dict[str, Any]] = {}
    for setting in chain.from_iterable(settings):
        name, equals, text = setting.partition("=")
        part, dot, field = name.partition(".")
        if not (equals and dot and part in parts):
            raise ConfigError(f"--set got {setting!r}; expected PART.FIELD=VALUE; parts are {', '.join(parts)}.")
        try:
            value = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            value = text
        changes.setdefault(part, {})[field] = _as_type_of_default(parts[part], part, field, value)
    return changes


def parse_pairs(pairs: Sequence[str]) -> dict[str, Any]:
    """`["obs_type=pixels", "size=96"]` -> `{"obs_type": "pixels", "size": 96}`; raises ConfigError on any other form."""
    parsed: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (equals and name.isidentifier()):
            raise ConfigError(f"--env-kwargs got {pair!r}; expected NAME=VALUE, such as obs_type=pixels.")
        try:
            parsed[name] = ast.literal_eval(text)
        except (ValueError, SyntaxError):
            parsed[name] = text
    return parsed


def _as_type_of_default(defaults: object, part: str, field: str, value: Any) -> Any:
    """`value` in the type of the field's default; unknown fields pass, what takes the changes names them."""
    default = getattr(defaults, field, None)
    if isinstance(default, float) and isinstance(value, int):
        return float(value)
    if default is not None and type(value) is not type(default):
        raise ConfigError(f"--set got {value!r} for {part}.{field}; expected {type(default).__name__}, such as {default!r}.")
    return value
