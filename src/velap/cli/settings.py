"""`--set PART.FIELD=VALUE` of the command line; `velap config` lists all fields."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

from velap.config.fields import hints, typed
from velap.config.serialise import PARTS
from velap.errors import ConfigError


def parse_settings(settings: Sequence[Sequence[str]], further: Mapping[str, object] | None = None,
                   ) -> dict[str, dict[str, Any]]:
    """`[["planner.n_iter=500", "train.joint.steps=9"]]` -> `{"planner": {"n_iter": 500}, "train": {"joint": {"steps": 9}}}`.

    Raises ConfigError on any other form. `further` parts beside those of the config, such as a method's own settings, with
    their defaults; the fields of the config are checked by what takes the changes, which knows its phases.
    """
    parts = [*PARTS, *(further or {})]
    changes: dict[str, dict[str, Any]] = {}
    for setting in chain.from_iterable(settings):
        name, equals, text = setting.partition("=")
        part, *path = name.split(".")
        if not (equals and part in parts and all(path) and 1 <= len(path) <= 1 + (part == "train")):
            raise ConfigError(f"--set got {setting!r}; expected PART.FIELD=VALUE or train.PHASE.FIELD=VALUE; parts are "
                              f"{', '.join(parts)}. `velap config` lists all fields.")
        value, defaults = _value(text), (further or {}).get(part)
        known = hints(type(defaults)) if defaults is not None else {}
        if path[0] in known:
            value = typed(value, known[path[0]], f"{part}.{path[0]}")
        place = changes.setdefault(part, {})
        for step in path[:-1]:
            place = place.setdefault(step, {})
        place[path[-1]] = value
    return changes


def _value(text: str) -> Any:
    """A number, a truth value, null or any other Python literal; text that is none of them."""
    words = {"null": None, "none": None, "true": True, "false": False}
    if text.lower() in words:
        return words[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def parse_pairs(pairs: Sequence[str]) -> dict[str, Any]:
    """`["obs_type=pixels", "size=96"]` -> `{"obs_type": "pixels", "size": 96}`; raises ConfigError on any other form."""
    parsed: dict[str, Any] = {}
    for pair in pairs:
        name, equals, text = pair.partition("=")
        if not (equals and name.isidentifier()):
            raise ConfigError(f"--env-kwargs got {pair!r}; expected NAME=VALUE, such as obs_type=pixels.")
        parsed[name] = _value(text)
    return parsed
