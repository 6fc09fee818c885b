"""Messages of openpi's protocol: msgpack, with NumPy arrays and scalars as maps. Nothing in a message is ever executed.

An array is the map `{b"__ndarray__": True, b"data": bytes, b"dtype": "<f4", b"shape": [2, 3]}`, in C order; a scalar is
`{b"__npgeneric__": True, b"data": value, b"dtype": "<f4"}` (openpi-client 0.1). Numbers, booleans and text are the types
that are read; pickled objects, structures and complex numbers are refused.
"""

from __future__ import annotations

import math
import re
from typing import Any

import msgpack
import numpy as np

from velap.errors import ObservationError

ARRAY, SCALAR = b"__ndarray__", b"__npgeneric__"
MAX_MESSAGE = 16 * 2**20
"""Longest message that the server reads [bytes]: two Full HD pictures and what goes with them. ours."""
MAX_ENTRIES = 100_000
"""Entries of all lists and maps of a message together; pictures are arrays, one entry each. ours."""
MAX_LENGTH = 1024
"""Entries of one list or map. ours."""
MAX_AXES = 8
"""Axes of an array. ours."""
_TYPES = re.compile(r"[<>=|]?([biu]1|[iuf][248]|[SU][1-9]\d{0,5})")
"""NumPy type strings that are read."""


class MessageError(ObservationError):
    """Bytes that are no message of the protocol, or a message beyond the limits."""


def pack(message: Any) -> bytes:
    """Bytes of a message of dicts, lists, text, numbers and NumPy arrays."""
    packed: bytes = msgpack.packb(message, default=_to_map)
    return packed


def _to_map(value: Any) -> dict[bytes, Any]:
    """A NumPy array or scalar as a map."""
    if isinstance(value, np.ndarray | np.generic) and _TYPES.fullmatch(value.dtype.str):
        if isinstance(value, np.ndarray):
            return {ARRAY: True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
        return {SCALAR: True, b"data": value.item(), b"dtype": value.dtype.str}
    raise MessageError(f"cannot send {type(value).__name__}; expected dicts, lists, text, numbers and NumPy arrays of them.")


def unpack(data: bytes) -> Any:
    """The message in `data`; arrays are read-only views of it.

    Raises MessageError for everything else: other formats, truncated or extra bytes, other types, messages beyond the
    limits of this module. What is built beside the bytes stays below 32 MiB.
    """
    budget = _Budget()
    try:
        return msgpack.unpackb(data, object_hook=budget.read_map, list_hook=budget.read_list, raw=False,
                               strict_map_key=True, max_array_len=MAX_LENGTH, max_map_len=MAX_LENGTH, max_ext_len=0)
    except MessageError:
        raise
    except (ValueError, TypeError) as error:  # what msgpack raises on input
        reason = str(error)[:120] or type(error).__name__
        raise MessageError(f"got {len(data)} bytes that cannot be read ({reason}); expected one msgpack message, such as a "
                           "dict with the picture as a NumPy array.") from None


class _Budget:
    """Counts the entries of a message while it is read."""

    def __init__(self) -> None:
        self._entries = 0

    def _spend(self, entries: int) -> None:
        self._entries += 1 + entries
        if self._entries > MAX_ENTRIES:
            raise MessageError(f"got a message of more than {MAX_ENTRIES} entries; expected fewer. Send pictures as NumPy "
                               "arrays, not as lists.")

    def read_list(self, values: list[Any]) -> list[Any]:
        self._spend(len(values))
        return values

    def read_map(self, values: dict[Any, Any]) -> Any:
        self._spend(len(values))
        if ARRAY in values:
            return _read_array(values)
        return _read_scalar(values) if SCALAR in values else values


def _read_type(values: dict[Any, Any]) -> np.dtype[Any]:
    """The NumPy type that a map names; raises MessageError for types that are not plain numbers, booleans or text."""
    name = values.get(b"dtype")
    if not isinstance(name, str) or not _TYPES.fullmatch(name):
        raise MessageError(f"got an array of type {str(name)[:40]!r}; expected booleans, integers, floats or text, such as "
                           "'|u1' for uint8. Python objects are never read.")
    return np.dtype(name)


def _read_array(values: dict[Any, Any]) -> np.ndarray:
    kind, data, shape = _read_type(values), values.get(b"data"), values.get(b"shape")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) > MAX_AXES or not all(
            type(side) is int and side >= 0 for side in shape):
        raise MessageError("got an array without bytes or without a shape of integers; expected the keys data, dtype and "
                           f"shape, with at most {MAX_AXES} axes.")
    size = math.prod(shape) * kind.itemsize
    if size != len(data):
        raise MessageError(f"got an array of shape {shape} and type {kind} with {len(data)} bytes; expected {size}.")
    return np.frombuffer(data, kind).reshape(shape) if size else np.zeros(shape, kind)


def _read_scalar(values: dict[Any, Any]) -> Any:
    kind, value = _read_type(values), values.get(b"data")
    if not isinstance(value, bool | int | float | str | bytes):
        raise MessageError(f"got a scalar of type {kind} that holds {type(value).__name__}; expected one value.")
    try:
        return kind.type(value)
    except (ValueError, OverflowError, TypeError):
        raise MessageError(f"got a scalar of type {kind} whose value does not fit it.") from None
