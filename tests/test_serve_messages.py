"""Messages: ours are those of openpi-client, both ways; everything else is a MessageError that takes little memory."""

from __future__ import annotations

import contextlib
import pickle
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from velap.serve.messages import MessageError, pack, unpack

VALUES = [np.arange(24).reshape(2, 3, 4).astype(dtype) for dtype in ("u1", "i2", "<i8", "f2", ">f4", "f8", "?")] + [
    np.zeros((0, 3), np.uint8), np.array(3.5), np.array(["one", "two"]), np.arange(6).reshape(2, 3).T,
    np.float32(1.5), np.int64(-7), np.bool_(True), "text", b"bytes", None, True, 3, 2.5, [1, "a"], {"a": {"b": 1}}]


def same(got: Any, wanted: Any) -> bool:
    if isinstance(wanted, np.ndarray | np.generic):
        return got.dtype == wanted.dtype and got.shape == wanted.shape and np.array_equal(got, wanted)
    return bool(got == wanted)


@pytest.mark.parametrize("value", VALUES, ids=lambda value: f"{type(value).__name__} {getattr(value, 'dtype', '')}")
def test_values_are_those_of_openpi_client(value: Any) -> None:
    assert same(unpack(pack({"x": value}))["x"], value)
    openpi = pytest.importorskip("openpi_client.msgpack_numpy")
    assert openpi.packb({"x": value}) == pack({"x": value})
    assert same(unpack(openpi.packb({"x": value}))["x"], value)
    assert same(openpi.unpackb(pack({"x": value}))["x"], value)


def array(dtype: Any = "|u1", shape: Any = (3,), data: Any = b"abc") -> bytes:
    return msgpack.packb({"x": {b"__ndarray__": True, b"dtype": dtype, b"shape": shape, b"data": data}})


def scalar(dtype: Any, data: Any) -> bytes:
    return msgpack.packb({b"__npgeneric__": True, b"dtype": dtype, b"data": data})


@pytest.mark.parametrize(("data", "text"), [
    (b"", "0 bytes"),
    (b"\xc1", "cannot be read"),
    (pack({"a": 1})[:-1], "cannot be read"),
    (pack({"a": 1}) + b"\x00", "cannot be read"),
    (pickle.dumps({"a": 1}), "cannot be read"),
    (msgpack.packb({1: 2}), "cannot be read"),
    (msgpack.packb(msgpack.ExtType(4, b"x")), "cannot be read"),
    (b"\x81" * 5000, "cannot be read"),
    (b"\xdd\xff\xff\xff\xff", "cannot be read"),
    (msgpack.packb(list(range(5000))), "cannot be read"),
    (msgpack.packb([[0] * 1000] * 200), "more than 100000 entries"),
    (array("|O"), r"type '\|O'.*Python objects are never read"),
    (array("<c8", data=bytes(24)), "type '<c8'"),
    (array("|V3"), r"type '\|V3'"),
    (array("<U0", shape=(10**9,), data=b""), "type '<U0'"),
    (array("f4,f4"), "type 'f4,f4'"),
    (array(["f4"]), r"\['f4'\]"),
    (array(None), "type 'None'"),
    (array(shape=(4,)), r"shape \[4\] and type uint8 with 3 bytes; expected 4"),
    (array(shape=(-3,)), "shape of integers"),
    (array(shape=(1.5,)), "shape of integers"),
    (array(shape=(True, 3)), "shape of integers"),
    (array(shape=[1] * 9, data=b"a"), "at most 8 axes"),
    (array(shape=3), "shape of integers"),
    (array(shape=(0, 2**63), data=b""), "cannot be read"),
    (array(shape=(2**60, 2**60)), "expected"),
    (array(data="abc"), "without bytes"),
    (scalar("<f4", [1.0] * 5), "holds list"),
    (scalar("|u1", 256), "does not fit"),
    (scalar("|O", 1), r"type '\|O'"),
    (scalar("<i4", "x"), "does not fit"),
], ids=lambda value: value[:40].hex() if isinstance(value, bytes) else "")
def test_other_bytes_are_named(data: bytes, text: str) -> None:
    with pytest.raises(MessageError, match=text):
        unpack(data)


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    with contextlib.suppress(MessageError):
        unpack(data)


@given(st.lists(st.tuples(st.integers(0, 99), st.integers(0, 255)), max_size=4), st.integers(0, 120))
def test_a_spoilt_message_is_read_or_refused(changes: list[tuple[int, int]], length: int) -> None:
    right = bytearray(pack({"image": np.zeros((4, 4, 3), np.uint8), "reset": np.bool_(True), "seed": 3}))
    for place, value in changes:
        right[place] = value
    with contextlib.suppress(MessageError):
        unpack(bytes(right[:length]))


@pytest.mark.parametrize("byte", [b"\x80", b"\x90", b"\xa0", b"\x81", b"\x91", b"\xc0", b"\xcb", b"\xdc\x03\xff"],
                         ids=bytes.hex)
def test_a_megabyte_of_small_entries_takes_few(byte: bytes) -> None:
    data = b"\xdc\x03\xff" + (b"\xdc\x03\xff" + byte * 1023) * 1023
    tracemalloc.start()
    try:
        with pytest.raises(MessageError):
            unpack(data[: 2**20])
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 32 * 2**20, f"{peak / 2**20:.0f} MiB"


@pytest.mark.parametrize("value", [object(), np.array([object()]), np.complex64(1), {1, 2}], ids=str)
def test_what_cannot_be_sent_is_named(value: Any) -> None:
    with pytest.raises(MessageError, match="cannot send"):
        pack({"x": value})
