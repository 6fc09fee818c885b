"""Frame store: every frame of a dataset once as uint8, with what happened between the frames; in and out of Minari.

Letters: F frames, E episodes, T transitions of one episode (it has T + 1 frames), A action entries, P entries of a position,
H×W image [px].
"""

from __future__ import annotations

import hashlib
import io
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import h5py
import minari
import numpy as np
from minari.dataset.minari_storage import MinariStorage

from velap.data import checks as reading
from velap.data import minari_io
from velap.data.images import IMAGE_SIZE, find_image
from velap.errors import DatasetError

Array = TypeVar("Array", bound=Any)

POSITION_KEY = "agent_position"
"""Key of the Minari `infos` that holds the agent's position at each frame, where the task knows it [m]."""


def stack_indices(index: Array, first: Array, n: int) -> Array:
    """Frames that make up stacked states: the n last ones, the first frame of the episode repeated where there are fewer.

    Args:
        index: int64 [*] newest frame of each state. NumPy array or torch tensor.
        first: int64 [*] first frame of the episode of each state, of the same kind.
        n: frames a state N [frames].

    Returns:
        int64 [*, n], oldest first, of the kind of `index`.
    """
    if hasattr(index, "new_tensor"):
        import torch

        offsets = torch.arange(1 - n, 1, device=index.device)
        rows: Any = torch.maximum(index.unsqueeze(-1) + offsets, first.unsqueeze(-1))
        return rows
    newest, oldest = np.asarray(index, dtype=np.int64), np.asarray(first, dtype=np.int64)
    return np.maximum(newest[..., None] + np.arange(1 - n, 1), oldest[..., None])


@dataclass(frozen=True)
class FrameStore:
    """One row a frame. The row of an episode's last frame has action 0, reward 0 and no flag: nothing follows it."""

    frames: np.ndarray
    """uint8 [F, H, W, 3]."""
    actions: np.ndarray
    """float32 [F, A], as given to the environment, within `action_low` to `action_high`."""
    rewards: np.ndarray
    """float32 [F] in {0, 1}: reward of the transition from this frame to the next."""
    terminated: np.ndarray
    """bool [F]: that transition ended the episode for good."""
    truncated: np.ndarray
    """bool [F]: that transition was the last one recorded, the task went on."""
    episode_start: np.ndarray
    """int64 [E] first row of each episode."""
    episode_length: np.ndarray
    """int64 [E] transitions T of each episode [steps]."""
    action_low: np.ndarray
    """float32 [A]."""
    action_high: np.ndarray
    """float32 [A]."""
    dataset_id: str
    content_hash: str
    """SHA-256 of the arrays above, hexadecimal."""

    @cached_property
    def episode_of(self) -> np.ndarray:
        """int64 [F] episode of each row."""
        return np.repeat(np.arange(len(self.episode_length)), self.episode_length + 1)

    @cached_property
    def first(self) -> np.ndarray:
        """int64 [F] first row of the row's episode."""
        return self.episode_start[self.episode_of]

    @cached_property
    def last(self) -> np.ndarray:
        """int64 [F] last row of the row's episode, its final frame."""
        return (self.episode_start + self.episode_length)[self.episode_of]

    @property
    def n_transitions(self) -> int:
        """Transitions in all episodes [steps]."""
        return int(self.episode_length.sum())

    @property
    def n_episodes(self) -> int:
        """Episodes E."""
        return len(self.episode_length)

    def arrays(self) -> dict[str, np.ndarray]:
        """The stored arrays by name."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}

    @property
    def nbytes(self) -> int:
        """Memory that the stored arrays take [bytes]."""
        return sum(value.nbytes for value in self.arrays().values())


def make_store(frames: np.ndarray, actions: np.ndarray, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray,
               episode_length: np.ndarray, action_low: np.ndarray, action_high: np.ndarray, dataset_id: str) -> FrameStore:
    """A FrameStore from its rows (shapes as in FrameStore), with starts and content hash computed."""
    length = np.asarray(episode_length, dtype=np.int64)
    rows = int((length + 1).sum())
    counts = [len(array) for array in (frames, actions, rewards, terminated, truncated)]
    if counts != [rows] * 5:
        raise DatasetError(f"frames, actions, rewards, terminated and truncated have {counts} rows; expected {rows} each, "
                           "one more "
                           "than transitions in every episode. Pad the last row of each episode with zeros.")
    store = FrameStore(frames, actions.astype(np.float32, copy=False), rewards.astype(np.float32, copy=False),
                       terminated.astype(bool, copy=False), truncated.astype(bool, copy=False),
                       np.cumsum(length + 1) - length - 1, length, np.asarray(action_low, np.float32),
                       np.asarray(action_high, np.float32), dataset_id, "")
    return replace(store, content_hash=content_hash(store))


def content_hash(store: FrameStore) -> str:
    """SHA-256 over name, type, shape and bytes of each array: equal for equal data, whatever file they came from."""
    digest = hashlib.sha256()
    for name, value in store.arrays().items():
        little_endian = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {little_endian.dtype.str} {value.shape};".encode())
        digest.update(little_endian.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


@dataclass(frozen=True)
class Extras:
    """What a Minari dataset keeps beside the arrays of a store."""

    positions: np.ndarray | None = None
    """float32 [F, P] position of the agent at each frame [m], kept as Minari info `agent_position`."""
    seeds: Sequence[int] | None = None
    """[E] seed of each episode's reset."""
    options: Sequence[dict[str, Any]] | None = None
    """[E] options of each episode's reset."""
    behaviours: Sequence[str] | None = None
    """[E] name of the behaviour that chose each episode's actions."""
    env_spec: Any = None
    """`gymnasium.envs.registration.EnvSpec`, for `MinariDataset.recover_environment`."""
    metadata: dict[str, Any] | None = None
    """Minari metadata such as `description` or `algorithm_name`."""
    provenance: dict[str, Any] | None = None
    """JSON values kept under the key `velap` of the metadata."""


def _encode_episodes(store: FrameStore, extras: Extras) -> io.BytesIO:
    """Minari's HDF5 layout. An episode's frames are one deflated chunk: Minari's own writer cuts them into six frames of a
    quarter image and two colours, which makes SpiralMaze 39 times larger and half again slower to read. The file is made in
    memory, because HDF5 itself crashes the process on a full disk."""
    content = io.BytesIO()
    with h5py.File(content, "w", libver="v110") as file:
        for episode, (start, length) in enumerate(zip(store.episode_start, store.episode_length, strict=True)):
            steps, rows = slice(start, start + length), slice(start, start + length + 1)
            group = file.create_group(f"episode_{episode}")
            group.attrs.update({"id": episode, "total_steps": int(length)})
            if extras.seeds is not None:
                group.attrs["seed"] = int(extras.seeds[episode])
            if extras.options is not None:
                group.attrs.update({f"options/{name}": value for name, value in extras.options[episode].items()})
            if extras.behaviours is not None:
                group.attrs["behaviour"] = extras.behaviours[episode]
            frames = store.frames[rows]
            group.create_dataset("observations", data=frames, chunks=frames.shape, maxshape=(None, *frames.shape[1:]),
                                 compression="gzip", compression_opts=1)
            for name, array in (("actions", store.actions), ("rewards", store.rewards), ("terminations", store.terminated),
                                ("truncations", store.truncated)):
                group.create_dataset(name, data=array[steps], chunks=True, maxshape=(None, *array.shape[1:]))
            if extras.positions is not None:
                group.create_dataset(f"infos/{POSITION_KEY}", data=extras.positions[rows], chunks=True,
                                     maxshape=(None, *extras.positions.shape[1:]))
    return content


def _write_minari(store: FrameStore, directory: Path, extras: Extras) -> None:
    data = directory / "data"
    data.mkdir(parents=True)
    storage = MinariStorage.new(
        data,
        observation_space=gym.spaces.Box(0, 255, store.frames.shape[1:], np.uint8),
        action_space=gym.spaces.Box(store.action_low, store.action_high, dtype=np.float32),
        env_spec=extras.env_spec,
        jpeg_encoding=False,
    )
    (data / minari_io.DATA_FILE).write_bytes(_encode_episodes(store, extras).getbuffer())
    storage.update_metadata({
        **(extras.metadata or {}),
        "dataset_id": store.dataset_id,
        "minari_version": minari.__version__,
        "total_episodes": store.n_episodes,
        "total_steps": store.n_transitions,
        "dataset_size": storage.get_size(),
        minari_io.VELAP_KEY: {
            **(extras.provenance or {}),
            "content_sha256": store.content_hash,
            "file_sha256": minari_io.file_sha256(data / minari_io.DATA_FILE),
        },
    })


def write_dataset(store: FrameStore, extras: Extras | None = None, overwrite: bool = False,
                  finish: Callable[[Path], object] | None = None) -> Path:
    """Write a store as the Minari dataset `store.dataset_id`: lossless HDF5, whole or not at all, checksums in its metadata.

    Args:
        store: what to write.
        extras: what to keep beside it.
        overwrite: replace a dataset of that id.
        finish: called with the dataset's directory before it is renamed into place, to put other files into it.

    Returns:
        Directory of the dataset.
    """
    target, work = minari_io.dataset_path(store.dataset_id), minari_io.partial_path(store.dataset_id)
    minari_io.refuse_existing(store.dataset_id, overwrite)
    built = work / "dataset"
    try:
        minari_io.make_namespace(store.dataset_id)
        shutil.rmtree(built, ignore_errors=True)
        _write_minari(store, built, extras or Extras())
        if finish is not None:
            finish(built)
        minari_io.install(built, target)
    except OSError as error:
        shutil.rmtree(built, ignore_errors=True)
        raise minari_io.storage_error(error, f"the dataset {store.dataset_id}") from error
    if not any(work.iterdir()):
        work.rmdir()
    return target


def load_store(dataset_id: str, image_key: str | None = None, min_length: int = 1,
               image_size: int | None = IMAGE_SIZE) -> FrameStore:
    """Read a Minari dataset with image observations and a sparse reward, ours or a stranger's, JPEG-encoded ones included.

    The reward's two values become 0 and 1. An episode ends at its first success: what was recorded beyond is left out. Grey
    images are repeated to three channels, channel-first ones transposed, squares resized. Changes of the data are warned of.

    Args:
        dataset_id: Minari id, `(namespace/)name-v0`.
        image_key: key of the image in Dict observations (`a/b` when nested); needed only where there are several.
        min_length: the longest episode must have this many transitions [steps].
        image_size: side that images are resized to [px]; None keeps them as they are.

    Raises:
        DatasetError: the dataset is missing, damaged or not of this kind; the text says the way out.
    """
    dataset = minari_io.open_dataset(dataset_id)
    layout = find_image(dataset.observation_space, image_key, dataset_id)
    low, high = reading.action_bounds(dataset.action_space, dataset_id)
    if dataset.total_episodes == 0:
        raise DatasetError(f"{dataset_id} has no episode; expected at least one. Collect some data into it.")
    rows = reading.binarise(reading.read_rows(dataset, layout, image_size), dataset_id)
    reading.check_ends(rows, dataset_id)
    low, high = reading.bound_actions(rows, low, high, dataset_id)
    store = make_store(*rows.arrays(), rows.length, low, high, dataset_id)
    longest = int(store.episode_length.max())
    if longest < min_length:
        raise DatasetError(f"the longest episode of {dataset_id} has {longest} transitions; expected one of {min_length} "
                           "or more. "
                           "Collect longer episodes, or train with a smaller window and dynamics horizon.")
    expected = minari_io.velap_metadata(dataset.storage.metadata).get("content_sha256")
    if expected is not None and image_size in (None, layout.sides[0]) and store.content_hash != expected:
        raise minari_io.damaged(dataset_id, f"its arrays have SHA-256 {store.content_hash[:12]}…, not {str(expected)[:12]}…")
    return store


def load_positions(dataset_id: str) -> np.ndarray | None:
    """float32 [F, P] positions of the agent [m], a row for each of `load_store`; None where the dataset has none."""
    dataset = minari_io.open_dataset(dataset_id)
    parts = []
    for episode in reading.episodes(dataset):
        position = (episode["infos"] or {}).get(POSITION_KEY)
        if position is None or np.ndim(position) != 2 or len(position) != len(episode["rewards"]) + 1:
            return None
        parts.append(np.asarray(position, np.float32))
    return np.concatenate(parts) if parts else None
