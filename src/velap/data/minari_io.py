"""Where Minari datasets lie, how one is put in place whole or not at all, and how a damaged one is noticed.

Minari 0.5.4: a dataset is a directory `<root>/<id>/data` with `metadata.json` and `main_data.hdf5`; directories whose name
begins with a dot are not listed, so that unfinished work lives in `<root>/<namespace>/.<name>.partial`.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import json
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from minari.dataset.minari_dataset import DATASET_ID_RE, MinariDataset
from minari.namespace import create_namespace, list_local_namespaces
from minari.storage.datasets_root_dir import get_dataset_path
from minari.storage.local import list_local_datasets

from velap.data.mapped import file_sha256
from velap.errors import DatasetError, StorageError
from velap.storage import locked, sync

UNREADABLE = (
    OSError, KeyError, ValueError, RuntimeError, TypeError, AssertionError, IndexError, AttributeError, EOFError,
    OverflowError, MemoryError, struct.error, gym.error.Error,
)
"""What Minari, h5py and Pillow raise on files that are damaged or were never theirs."""

DATA_FILE = "main_data.hdf5"
METADATA_FILE = "metadata.json"
POSITION_KEY = "agent_position"
"""Key of the Minari `infos` that holds the agent's position at each frame, where the task knows it [m]."""
VELAP_KEY = "velap"
"""Key of `metadata.json` under which velap keeps checksums and provenance."""


def is_id(text: str) -> bool:
    """Does Minari take that as `(namespace/)name-v0`?"""
    match = DATASET_ID_RE.fullmatch(text)
    return match is not None and match.group("version") is not None


def check_dataset_id(dataset_id: str) -> None:
    """Raise DatasetError unless Minari takes `dataset_id` as `(namespace/)name-v0`."""
    if not is_id(dataset_id):
        raise DatasetError(f"{dataset_id!r} is not a Minari dataset id; expected (namespace/)name-v0: letters, digits, "
                           "- and _, and a version at the end, for example velap/SpiralMaze-v0; or the path of a dataset.")


def dataset_path(dataset_id: str) -> Path:
    """Directory of a dataset, existing or not, under MINARI_DATASETS_PATH or Minari's default root."""
    check_dataset_id(dataset_id)
    try:
        return get_dataset_path(dataset_id)
    except OSError as error:
        raise storage_error(error, "Minari's root directory") from error


def partial_path(dataset_id: str) -> Path:
    """Directory beside the dataset where unfinished work on it lies."""
    target = dataset_path(dataset_id)
    return target.parent / f".{target.name}.partial"


def storage_error(error: Exception, what: str) -> StorageError:
    """A StorageError that says what could not be written, why, and what to do."""
    reason, number = " ".join(str(error).split()), getattr(error, "errno", None)
    if number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) or "errno = 28" in reason or "No space left" in reason:
        way_out = "Free some space, or point MINARI_DATASETS_PATH to another disk"
    elif number in (errno.EACCES, errno.EPERM, errno.EROFS):
        way_out = "Point MINARI_DATASETS_PATH to a directory that you may write to"
    else:
        way_out = "Make the place writable, or point MINARI_DATASETS_PATH to another one"
    return StorageError(f"could not write {what}: {reason}. Expected a disk with room that may be written to; nothing "
                        f"half-written was put in place. {way_out}, and run the same command again.")


def make_namespace(dataset_id: str) -> None:
    """Create the Minari namespace of `dataset_id` where it is missing."""
    namespace = DATASET_ID_RE.fullmatch(dataset_id).group("namespace")
    if namespace is not None and namespace not in list_local_namespaces():
        with contextlib.suppress(ValueError):  # another process was first
            create_namespace(namespace)


def _old(target: Path) -> Path:
    return target.parent / f".{target.name}.old"


def install(built: Path, target: Path) -> None:
    """Rename the finished dataset `built` to `target`; a dataset that was there is deleted once the new one is in place."""
    for path in [*built.rglob("*"), built]:
        sync(path)
    shutil.rmtree(_old(target), ignore_errors=True)
    if target.exists():
        target.rename(_old(target))
    built.rename(target)
    sync(target.parent)
    shutil.rmtree(_old(target), ignore_errors=True)


def exists(dataset_id: str) -> bool:
    """Is the dataset there? One whose replacement was interrupted between the two renames is put back."""
    target = dataset_path(dataset_id)
    if not target.exists() and _old(target).exists():
        _old(target).rename(target)
    return target.exists()


def refuse_existing(dataset_id: str, overwrite: bool) -> None:
    """Raise DatasetError when the dataset is there and may not be replaced."""
    if exists(dataset_id) and not overwrite:
        raise DatasetError(f"the dataset {dataset_id} exists already in {dataset_path(dataset_id)}; expected a free "
                           "id. Give --overwrite to replace it, or another --dataset-id to keep both.")


@contextlib.contextmanager
def exclusive(directory: Path, dataset_id: str) -> Iterator[None]:
    """Hold the lock of a work directory; the kernel releases it however the process ends."""
    directory.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(locked(directory / "lock"))
        except BlockingIOError as error:
            raise StorageError(f"another process is writing {dataset_id} (it holds {directory / 'lock'}); expected to be "
                               "alone. Wait for it or stop it, then run the same command again.") from error
        yield


def read_metadata(dataset_id: str) -> dict[str, Any]:
    """`metadata.json` of a local dataset; DatasetError when there is none or it is damaged."""
    path = dataset_path(dataset_id) / "data" / METADATA_FILE
    if not exists(dataset_id) or not path.parent.is_dir():
        raise DatasetError(_missing(dataset_id))
    try:
        metadata = json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise damaged(dataset_id, f"{path} cannot be read ({error})") from error
    if not isinstance(metadata, dict):
        raise damaged(dataset_id, f"{path} does not hold an object")
    return metadata


def open_dataset(dataset_id: str) -> MinariDataset:
    """The Minari dataset of that id, its data file checked against the checksum that velap left, if it did."""
    metadata = read_metadata(dataset_id)
    path = dataset_path(dataset_id) / "data"
    expected = velap_metadata(metadata).get("file_sha256")
    if expected is not None:
        try:
            got = file_sha256(path / DATA_FILE)
        except OSError as error:
            raise damaged(dataset_id, f"{path / DATA_FILE} cannot be read ({error})") from error
        if got != expected:
            raise damaged(dataset_id, f"{path / DATA_FILE} has SHA-256 {got[:12]}…, not {str(expected)[:12]}…")
    try:
        return MinariDataset(path)
    except UNREADABLE as error:
        raise damaged(dataset_id, f"Minari cannot open it ({type(error).__name__}: {error})") from error


def raw_episodes(dataset: MinariDataset) -> Iterator[dict[str, Any]]:
    """Episodes as Minari has them; whatever a damaged file makes its readers raise becomes a DatasetError."""
    stored = iter(dataset.storage.get_episodes(dataset.episode_indices))
    while True:
        try:
            episode = next(stored)
        except StopIteration:
            return
        except UNREADABLE as error:
            raise damaged(dataset.id, f"an episode cannot be read ({type(error).__name__}: {error})") from error
        yield episode


def load_positions(dataset_id: str) -> np.ndarray | None:
    """float32 [F, P] positions of the agent [m], a row for each frame of the dataset; None where it has none."""
    parts = []
    for episode in raw_episodes(open_dataset(dataset_id)):
        position = (episode["infos"] or {}).get(POSITION_KEY)
        if position is None or np.ndim(position) != 2 or len(position) != len(episode["rewards"]) + 1:
            return None
        parts.append(np.asarray(position, np.float32))
    return np.concatenate(parts) if parts else None


def velap_metadata(metadata: dict[str, Any]) -> dict[str, Any]:
    """The part of `metadata.json` that velap wrote, empty for datasets of others."""
    entry = metadata.get(VELAP_KEY)
    return entry if isinstance(entry, dict) else {}


def damaged(dataset_id: str, detail: str) -> DatasetError:
    """DatasetError for files that are truncated, bit-flipped or changed after they were written."""
    return DatasetError(f"the dataset {dataset_id} is damaged or was changed after it was written: "
                        f"{' '.join(detail.split())}. "
                        "Expected the files as they were written. Restore them from a copy, or write the dataset again "
                        "(for a task of velap: velap collect TASK --overwrite).")


def _missing(dataset_id: str) -> str:
    try:
        known = sorted(list_local_datasets())
    except UNREADABLE:
        known = []
    near = difflib.get_close_matches(dataset_id, known, n=3, cutoff=0.5) or known[:5]
    here = f"there are {', '.join(near)}" if near else "there is none yet"
    return (f"no Minari dataset {dataset_id!r} under {get_dataset_path()}; expected a local dataset, {here}. Make it "
            "with velap collect TASK, fetch it with minari download, or set MINARI_DATASETS_PATH to where it lies.")
