"""Stores whose frames are mapped from disk: made once beside the dataset, with checksums, for data larger than memory.

A mapped store is a folder: `frames.bin` (uint8 [F, H, W, 3] in C order), `rows.npz` (the other arrays) and `store.json`
(what it was made from, how it was read, and SHA-256 of both files).
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from velap.data.frames import FrameStore, Reading
from velap.errors import DatasetError
from velap.storage import locked, replace_file, sync

FRAMES, ROWS, INDEX = "frames.bin", "rows.npz", "store.json"
FORMAT = "velap-mapped-store/1"
MEMORY_SHARE = 0.4
"""Share of the machine's memory above which frames are mapped unless said otherwise. ours."""


def too_large(frames: int, side: int) -> bool:
    """Would so many frames of that side [px] take more than their share of memory?"""
    try:
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):  # Windows does not tell
        return False
    return frames * side * side * 3 > MEMORY_SHARE * memory


def file_sha256(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def build_mapped(build: Callable[[Path | None], FrameStore], place: Path, source: str) -> FrameStore:
    """Make the store by `build(file of the frames)`, keep it in the folder `place` and map it. Whole or not at all.

    `source` says what it was made from; `open_mapped` compares it. Raises OSError where the disk is full.
    """
    with _alone(place):
        return _build(build, place, source)


def open_or_build(build: Callable[[Path | None], FrameStore], place: Path, source: str) -> FrameStore:
    """The store in the folder `place`, made first unless it is there; one that another process makes is waited for."""
    with _alone(place):
        return open_mapped(place, source) or _build(build, place, source)


@contextmanager
def _alone(place: Path) -> Iterator[None]:
    """Wait until no other process works on the store in `place`, and keep others waiting."""
    place.parent.mkdir(parents=True, exist_ok=True)
    with locked(place.with_name(f".{place.name}.lock"), wait=True):
        yield


def _build(build: Callable[[Path | None], FrameStore], place: Path, source: str) -> FrameStore:
    """Make the store and map it; no other process does so now."""
    partial = place.with_name(f".{place.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        store = build(partial / FRAMES)
        shape, small = store.frames.shape, {name: array for name, array in store.arrays().items() if name != "frames"}
        store = replace(store, frames=np.empty((0, *shape[1:]), np.uint8))  # the last reference: the file is unmapped
        os.truncate(partial / FRAMES, int(np.prod(shape)))
        with (partial / ROWS).open("wb") as file:
            np.savez(file, **small)  # type: ignore[arg-type]
        index = {"format": FORMAT, "source": source, "dataset_id": store.dataset_id, "reading": store.reading.to_json(),
                 "shape": shape, "content_hash": store.content_hash,
                 "sha256": {name: file_sha256(partial / name) for name in (FRAMES, ROWS)}}
        for name in (FRAMES, ROWS):
            sync(partial / name)
        replace_file(partial / INDEX, json.dumps(index, indent=1).encode())
        shutil.rmtree(place, ignore_errors=True)
        partial.rename(place)
        sync(place.parent)
    except BaseException:
        shutil.rmtree(partial, ignore_errors=True)
        raise
    made = open_mapped(place, source, verify=False)
    assert made is not None
    return made


def open_mapped(place: Path, source: str, verify: bool = True) -> FrameStore | None:
    """The store in `place`; None where there is none of that source. Raises DatasetError where a checksum differs."""
    try:
        index: dict[str, Any] = json.loads((place / INDEX).read_bytes())
    except (OSError, ValueError):
        return None
    if index.get("format") != FORMAT or index.get("source") != source:
        return None
    for name, expected in index["sha256"].items() if verify else ():
        got = file_sha256(place / name) if (place / name).exists() else "missing"
        if got != expected:
            raise DatasetError(f"the mapped frames {place / name} have SHA-256 {got[:12]}…, not {expected[:12]}…; "
                               f"expected the file as it was written. Delete the folder {place}: it is made again from "
                               "the dataset.")
    # copy on write: torch takes writable arrays only, and nothing may ever write into the file
    frames = np.memmap(place / FRAMES, np.uint8, "c", shape=tuple(index["shape"]))
    with np.load(place / ROWS, allow_pickle=False) as file:
        return FrameStore(frames=frames, **{name: file[name] for name in file.files}, dataset_id=index["dataset_id"],
                          content_hash=index["content_hash"], reading=Reading.from_json(index["reading"]))
