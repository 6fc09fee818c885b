"""Where runs lie, locks, and writing a file as a whole or not at all."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

OWN_RECORDS, SHIPPED_RECORDS = Path("runs/records"), Path("results/records")
"""Where a user's evaluations write, and where those of the published tables lie. The two never meet."""


def folder_name(name: str) -> str:
    """A task, dataset or environment id as the name of one folder on every system."""
    return re.sub(r'[/\\:*?"<>|]', "_", name)


def run_dir(task: str, preset: str, seed: int) -> Path:
    """Default folder of a training run."""
    return Path("runs") / folder_name(task) / preset / f"seed{seed}"


@contextmanager
def locked(path: Path, wait: bool = False) -> Iterator[None]:
    """Hold the lock file `path`; the system releases it however a process ends. BlockingIOError: another one holds it.

    With `wait`, its release is waited for.
    """
    lock = FileLock(path)
    try:
        lock.acquire(timeout=-1 if wait else 0)
    except Timeout as error:
        raise BlockingIOError(f"{path} is held by another process") from error
    try:
        yield
    finally:
        if os.name != "nt":  # Windows deletes no open file; FileLock does it there
            path.unlink(missing_ok=True)  # while it is held: afterwards it may be another process's lock
        lock.release()


def replace_file(path: Path, content: bytes) -> None:
    """All of `content` or nothing: temporary file beside the target, fsync, rename, fsync of the folder. Raises OSError."""
    temporary = path.with_name(f".{path.name}.tmp")  # one writer a path: what a killed one left is written over
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    sync(path.parent)


def sync(path: Path) -> None:
    """Make a file's content or the renames in a folder last; Windows has no such call for folders and does without."""
    if os.name == "nt" and path.is_dir():
        return
    descriptor = os.open(path, os.O_RDWR if os.name == "nt" else os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
