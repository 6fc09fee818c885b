"""Griffe extension for the API reference: `[T] [Q-value]`, a shape and a unit, is text and no Markdown link."""

from __future__ import annotations

from typing import Any

import griffe


class PlainBrackets(griffe.Extension):
    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring is not None:
            obj.docstring.value = obj.docstring.value.replace("] [", "] \\[")
