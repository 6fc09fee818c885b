"""Frame store: every frame of a dataset once as uint8, with what happened between the frames; read from and written to Minari.

Letters: F frames, E episodes, T transitions of one episode (it has T + 1 frames), A action entries, H×W image [px].
"""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import minari
import numpy as np
from minari.data_collector.episode_buffer import EpisodeBuffer
from minari.dataset.minari_dataset import MinariDataset
from minari.dataset.minari_storage import MinariStorage

from velap.data import minari_io, reading
from velap.errors import DatasetError

Array = TypeVar("Array", bound=Any)

EPISODES_PER_WRITE = 100
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
        return torch.maximum(index.unsqueeze(-1) + offsets, first.unsqueeze(-1))
    newest, oldest_allowed = np.asarray(index, dtype=np.int64), np.asarray(first, dtype=np.int64)
    return np.maximum(newest[..., None] + np.arange(1 - n, 1), oldest_allowed[..., None])


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

    @property
    def nbytes(self) -> int:
        """Memory that the arrays take [bytes]."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, np.ndarray))


def make_store(frames: np.ndarray, actions: np.ndarray, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray,
               episode_length: np.ndarray, action_low: np.ndarray, action_high: np.ndarray, dataset_id: str) -> FrameStore:
    """A FrameStore from its rows (shapes as in FrameStore), with starts and content hash computed."""
    length = np.asarray(episode_length, dtype=np.int64)
    start = np.concatenate([np.zeros(1, np.int64), np.cumsum(length + 1)[:-1]]) if len(length) else np.zeros(0, np.int64)
    rows = int((length + 1).sum())
    if not len(frames) == len(actions) == len(rewards) == len(terminated) == len(truncated) == rows:
        raise DatasetError(f"the arrays have {len(frames)} frames, {len(actions)} actions, {len(rewards)} rewards, {len(terminated)} and "
                           f"{len(truncated)} flags; expected {rows} of each, one more than transitions in every episode.")
    store = FrameStore(frames, actions.astype(np.float32, copy=False), rewards.astype(np.float32, copy=False),
                       terminated.astype(bool, copy=False), truncated.astype(bool, copy=False), start, length,
                       np.asarray(action_low, np.float32), np.asarray(action_high, np.float32), dataset_id, "")
    return replace(store, content_hash=content_hash(store))


def content_hash(store: FrameStore) -> str:
    """SHA-256 over name, type, shape and bytes of each array: equal for equal data, whatever file or machine it came from."""
    digest = hashlib.sha256()
    for name, value in vars(store).items():
        if isinstance(value, np.ndarray) and name in FrameStore.__dataclass_fields__:
            little_endian = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
            digest.update(f"{name} {little_endian.dtype.str} {value.shape};".encode())
            digest.update(little_endian.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _buffers(store: FrameStore, positions: np.ndarray | None, seeds: Sequence[int] | None,
             options: Sequence[dict[str, Any]] | None) -> Iterable[EpisodeBuffer]:
    for episode, (start, length) in enumerate(zip(store.episode_start, store.episode_length, strict=True)):
        steps, rows = slice(start, start + length), slice(start, start + length + 1)
        yield EpisodeBuffer(
            id=None,
            seed=None if seeds is None else int(seeds[episode]),
            options=None if options is None else options[episode],
            observations=store.frames[rows],  # type: ignore[arg-type]
            actions=store.actions[steps],  # type: ignore[arg-type]
            rewards=store.rewards[steps],  # type: ignore[arg-type]
            terminations=store.terminated[steps],  # type: ignore[arg-type]
            truncations=store.truncated[steps],  # type: ignore[arg-type]
            infos=None if positions is None else {POSITION_KEY: positions[rows]},
        )


def _write_minari(store: FrameStore, directory: Path, buffers: Iterable[EpisodeBuffer], env_spec: Any,
                  metadata: dict[str, Any], provenance: dict[str, Any]) -> None:
    data = directory / "data"
    data.mkdir(parents=True)
    storage = MinariStorage.new(
        data,
        observation_space=gym.spaces.Box(0, 255, store.frames.shape[1:], np.uint8),
        action_space=gym.spaces.Box(store.action_low, store.action_high, dtype=np.float32),
        env_spec=env_spec,
        jpeg_encoding=False,
    )
    storage.update_metadata({"dataset_id": store.dataset_id, "minari_version": minari.__version__, **metadata})
    dataset = MinariDataset(storage)
    chunk: list[EpisodeBuffer] = []
    for buffer in buffers:
        chunk.append(buffer)
        if len(chunk) == EPISODES_PER_WRITE:
            dataset.update_dataset_from_buffer(chunk)
            chunk = []
    if chunk:
        dataset.update_dataset_from_buffer(chunk)
    storage.update_metadata({minari_io.VELAP_KEY: {
        **provenance,
        "content_sha256": store.content_hash,
        "file_sha256": minari_io.file_sha256(data / minari_io.DATA_FILE),
    }})
    minari_io.fsync_tree(directory)


def write_dataset(store: FrameStore, *, positions: np.ndarray | None = None, seeds: Sequence[int] | None = None,
                  options: Sequence[dict[str, Any]] | None = None, env_spec: Any = None, metadata: dict[str, Any] | None = None,
                  provenance: dict[str, Any] | None = None, overwrite: bool = False) -> Path:
    """Write a store as the Minari dataset `store.dataset_id`: lossless HDF5, whole or not at all, checksums in its metadata.

    Args:
        store: what to write.
        positions: float [F, P] position of the agent at each frame [m], kept as Minari info `agent_position`.
        seeds: [E] seed of each episode's reset.
        options: [E] options of each episode's reset.
        env_spec: `gymnasium.envs.registration.EnvSpec`, for `MinariDataset.recover_environment`.
        metadata: Minari metadata such as `description` or `algorithm_name`.
        provenance: JSON values kept under the key `velap`.
        overwrite: replace a dataset of that id.

    Returns:
        Directory of the dataset.
    """
    target = minari_io.dataset_path(store.dataset_id)
    refuse_existing(store.dataset_id, overwrite)
    built = minari_io.partial_path(store.dataset_id) / "dataset"
    try:
        minari_io.make_namespace(store.dataset_id)
        shutil.rmtree(built, ignore_errors=True)
        _write_minari(store, built, _buffers(store, positions, seeds, options), env_spec, metadata or {}, provenance or {})
        minari_io.install(built, target)
        if not any(built.parent.iterdir()):
            built.parent.rmdir()
    except OSError as error:
        shutil.rmtree(built, ignore_errors=True)
        raise minari_io.storage_error(error, f"the dataset {store.dataset_id}") from error
    return target


def refuse_existing(dataset_id: str, overwrite: bool) -> None:
    """Raise DatasetError when the dataset is there and may not be replaced."""
    target = minari_io.dataset_path(dataset_id)
    if target.exists() and not overwrite:
        raise DatasetError(f"the dataset {dataset_id} exists already in {target}; expected a free id. Give --overwrite to replace it, "
                           "or another --dataset-id to keep both.")


@dataclass
class _Rows:
    """Rows of all episodes as stored, before rewards are binarised. `frames` is the largest array and is never copied."""

    frames: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: np.ndarray
    truncated: np.ndarray
    length: np.ndarray

    def arrays(self) -> tuple[np.ndarray, ...]:
        return self.frames, self.actions, self.rewards, self.terminated, self.truncated


def _episodes(dataset: MinariDataset) -> Iterator[dict[str, Any]]:
    """Raw Minari episodes; whatever a damaged file makes the readers raise becomes a DatasetError."""
    episodes = iter(dataset.storage.get_episodes(dataset.episode_indices))
    while True:
        try:
            episode = next(episodes)
        except StopIteration:
            return
        except minari_io.UNREADABLE as error:
            raise minari_io.damaged(dataset.id, f"an episode cannot be read ({type(error).__name__}: {error})") from error
        yield episode


def _read_rows(dataset: MinariDataset, layout: reading.ImageLayout, size: int | None) -> _Rows:
    capacity = dataset.total_steps + dataset.total_episodes
    side, action_shape = layout.side if size is None else size, dataset.action_space.shape
    rows = _Rows(np.empty((capacity, side, side, 3), np.uint8), np.zeros((capacity, *action_shape), np.float32),
                 np.zeros(capacity, np.float64), np.zeros(capacity, bool), np.zeros(capacity, bool), np.zeros(0, np.int64))
    lengths, start = [], 0
    for number, raw in enumerate(_episodes(dataset)):
        episode = reading.check_episode(raw, layout, action_shape, f"{dataset.id}, episode {number}")
        steps = len(episode["rewards"])
        if start + steps + 1 > capacity:
            raise minari_io.damaged(dataset.id, f"its metadata count {dataset.total_steps} transitions, its episodes hold more")
        rows.frames[start : start + steps + 1] = reading.to_rgb(episode["frames"], layout, size)
        for name in ("actions", "rewards", "terminated", "truncated"):
            getattr(rows, name)[start : start + steps] = episode[name]
        lengths.append(steps)
        start += steps + 1
    return _Rows(*(array[:start] for array in rows.arrays()), np.asarray(lengths, np.int64))


def _end_at_success(rows: _Rows, success: np.ndarray, dataset_id: str) -> _Rows:
    """Cut each episode after its first success, moving rows down in place. success: bool [F]."""
    lengths, source, target, cut = rows.length.copy(), 0, 0, 0
    for episode, steps in enumerate(rows.length):
        hits = np.flatnonzero(success[source : source + steps])
        kept = int(hits[0]) + 1 if len(hits) else int(steps)
        cut += kept < steps
        for array in rows.arrays():
            if target != source:
                array[target : target + kept + 1] = array[source : source + kept + 1]
        last = target + kept
        for array in rows.arrays()[1:]:
            array[last] = 0
        if len(hits):
            rows.terminated[last - 1], rows.truncated[last - 1] = True, False
        lengths[episode], source, target = kept, source + steps + 1, target + kept + 1
    if cut:
        reading.notice(f"{dataset_id}: {cut} episodes go on after their first success; what follows it is left out, a success ends an episode.")
    return _Rows(*(array[:target] for array in rows.arrays()), lengths)


def _check_ends(rows: _Rows, dataset_id: str) -> None:
    """Flags stand at the last transition only; episodes without a flag count as truncated."""
    ends = np.cumsum(rows.length + 1)
    for episode, (end, steps) in enumerate(zip(ends, rows.length, strict=True)):
        steps_of = slice(end - 1 - steps, end - 1)
        reading.check_flags(rows.terminated[steps_of], rows.truncated[steps_of], f"{dataset_id}, episode {episode}")
    unfinished = ~(rows.terminated | rows.truncated)[ends - 2]
    if unfinished.any():
        reading.notice(f"{dataset_id}: {unfinished.sum()} episodes end without a flag; they count as truncated.")
        rows.truncated[ends[unfinished] - 2] = True


def _bound_actions(actions: np.ndarray, low: np.ndarray, high: np.ndarray, dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """Bounds float32 [A] that are finite; actions [F, A] beyond the stated ones are clipped in place, as an environment does."""
    outside = int(((actions < low) | (actions > high)).any(axis=1).sum())
    if outside:
        reading.notice(f"{dataset_id}: {outside} of {len(actions)} actions lie outside the action space; they are clipped to it.")
        np.clip(actions, low, high, out=actions)
    if not np.isfinite(np.concatenate([low, high])).all():
        low, high = np.where(np.isfinite(low), low, actions.min(axis=0)), np.where(np.isfinite(high), high, actions.max(axis=0))
        if not np.all(low < high):
            raise DatasetError(f"{dataset_id} has an unbounded action entry that never varies ({low.tolist()} to {high.tolist()}); expected low < "
                               "high. State the bounds of the action space when the dataset is written.")
        reading.notice(f"{dataset_id}: the action space is unbounded; the bounds are the extremes of the data, {low.tolist()} to {high.tolist()}.")
    return low, high


def _finish(rows: _Rows, low: np.ndarray, high: np.ndarray, dataset_id: str) -> FrameStore:
    ends = np.cumsum(rows.length + 1) - 1
    transition = np.ones(len(rows.rewards), bool)
    transition[ends] = False
    ordinary, level = reading.reward_levels(rows.rewards[transition], dataset_id)
    success = transition & (rows.rewards == level)
    if (ordinary, level) != (0.0, 1.0):
        reading.notice(f"{dataset_id}: reward {level:g} is read as success (1), {ordinary:g} as 0.")
    rows.rewards = success.astype(np.float32)
    rows = _end_at_success(rows, success, dataset_id)
    _check_ends(rows, dataset_id)
    low, high = _bound_actions(rows.actions, low, high, dataset_id)
    return make_store(rows.frames, rows.actions, rows.rewards, rows.terminated, rows.truncated, rows.length, low, high, dataset_id)


def load_store(dataset_id: str, image_key: str | None = None, min_length: int = 1, image_size: int | None = reading.IMAGE_SIZE) -> FrameStore:
    """Read a Minari dataset with image observations and a sparse reward, ours or a stranger's, JPEG-encoded ones included.

    The reward's two values become 0 and 1. An episode ends at its first success: what a recorder kept beyond is left out, with a
    warning. Greyscale images are repeated to three channels, channel-first ones transposed, other squares resized, with a warning.

    Args:
        dataset_id: Minari id, `(namespace/)name-v0`.
        image_key: key of the image in Dict observations (`a/b` when nested); may be left out when there is one image.
        min_length: the longest episode must have this many transitions [steps].
        image_size: side that images are resized to [px]; None keeps them as they are.

    Raises:
        DatasetError: the dataset is missing, damaged or not of this kind; the text says the way out.
    """
    dataset = minari_io.open_dataset(dataset_id)
    layout = reading.find_image(dataset.observation_space, image_key, dataset_id)
    low, high = reading.action_bounds(dataset.action_space, dataset_id)
    if dataset.total_episodes == 0:
        raise DatasetError(f"{dataset_id} has no episode; expected at least one. Collect some data into it.")
    rows = _read_rows(dataset, layout, image_size)
    store = _finish(rows, low, high, dataset_id)
    if store.episode_length.max() < min_length:
        raise DatasetError(f"the longest episode of {dataset_id} has {store.episode_length.max()} transitions; expected one of at least "
                           f"{min_length}. Collect longer episodes, or lower the window and the dynamics horizon.")
    expected = minari_io.velap_metadata(dataset.storage.metadata).get("content_sha256")
    if expected is not None and image_size in (None, layout.side) and store.content_hash != expected:
        raise minari_io.damaged(dataset_id, f"its arrays have SHA-256 {store.content_hash[:12]}…, expected {str(expected)[:12]}…")
    return store
