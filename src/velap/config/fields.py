"""What a config field may hold: its type by annotation, its range by `require`, its meaning by the docstring below it."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import types
from collections.abc import Mapping
from textwrap import dedent
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from velap.errors import ConfigError


def require(condition: bool, name: str, got: object, expected: str) -> None:
    """Raises ConfigError for the field `name` unless `condition` holds."""
    if not condition:
        raise ConfigError(f"config field `{name}` is {got!r}; expected {expected}. Change that field and start again.")


def hints(cls: Any) -> dict[str, Any]:
    """Types of a dataclass's fields by name."""
    found = get_type_hints(cls)
    return {field.name: found[field.name] for field in dataclasses.fields(cls)}


def docs(cls: Any) -> dict[str, str]:
    """Docstrings of a dataclass's fields by name, those of its bases included, on one line each."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        body = ast.parse(dedent(inspect.getsource(cast(type, base)))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, doc in zip(body.body, body.body[1:], strict=False):
            if (isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(doc, ast.Expr)
                    and isinstance(doc.value, ast.Constant)):
                found[field.target.id] = " ".join(str(doc.value.value).split())
    return found


def type_name(hint: Any) -> str:
    """A type as users write it: `int`, `float or null`, `'a' or 'b'`."""
    if get_origin(hint) is Literal:
        return " or ".join(repr(value) for value in get_args(hint))
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join(type_name(part) for part in get_args(hint))
    return "null" if hint is type(None) else getattr(hint, "__name__", str(hint))


def typed(value: Any, hint: Any, name: str) -> Any:
    """`value`, as JSON gives it, in the type `hint`; raises ConfigError where it has another one. Whole numbers are floats
    too, and nothing else changes its type."""
    if get_origin(hint) is Literal:
        if value is None and "none" in get_args(hint):
            return "none"  # as `--set` reads the word where null may be meant
        good = any(value == choice and type(value) is type(choice) for choice in get_args(hint))
    elif get_origin(hint) in (Union, types.UnionType):
        for part in get_args(hint):
            try:
                return typed(value, part, name)
            except ConfigError:
                continue
        good = False
    elif hint is float and type(value) is int:
        return float(value)
    else:
        good = type(value) is (type(None) if hint is None else hint)
    if not good:
        raise ConfigError(f"config field `{name}` is {value!r}; expected {type_name(hint)}. Change that field and start "
                          "again.")
    return value


def replace(part: Any, changes: Mapping[str, Any], where: str) -> Any:
    """A copy of a dataclass with fields replaced, types checked; raises ConfigError on fields that it does not have."""
    known = hints(type(part))
    unknown = sorted(set(changes) - set(known))
    if unknown:
        raise ConfigError(f"`{where}` has no field {', '.join(map(repr, unknown))}; expected some of {', '.join(known)}.")
    values = {name: typed(value, known[name], f"{where}.{name}") for name, value in changes.items()}
    return dataclasses.replace(part, **values)
