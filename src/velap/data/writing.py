"""Write a frame store as a Minari dataset: lossless HDF5, whole or not at all. F frames, E episodes, P position entries."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
from minari.dataset.minari_storage import MinariStorage

from velap.data import minari_io
from velap.data.frames import FrameStore
from velap.data.mapped import file_sha256
from velap.data.minari_io import POSITION_KEY


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
            "file_sha256": file_sha256(data / minari_io.DATA_FILE),
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
