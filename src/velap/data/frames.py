"""Frame store: every frame of a dataset once as uint8, with what happened between the frames.

Letters: F frames, E episodes, T transitions of one episode (it has T + 1 frames), A action entries, H×W image [px].
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from velap.data.images import IMAGE_SIZE, Fit
from velap.data.success import Predicate, Success
from velap.errors import DatasetError

Array = TypeVar("Array", bound=Any)


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
class Reading:
    """How a dataset was read: what run time has to do in the same way. Checkpoints keep it as JSON."""

    image_key: str = ""
    """Key of the image in Dict observations, `a/b` when nested; empty for plain images. `a,b`: two side by side."""
    image_size: int | None = IMAGE_SIZE
    """Side that images are resized to, of each camera [px]; None keeps that of square ones."""
    fit: Fit | None = None
    """How oblong images become square; None where they are."""
    state_key: str = ""
    """Keys of the state beside the image, `a,b`; empty without a state."""
    success: str = ""
    """Rule of `velap.data.success`; empty where rewards are 0 and 1, and 1 is success."""

    def to_json(self) -> str:
        """As kept in checkpoints and beside mapped frames."""
        plain = asdict(self)
        if not self.state_key:  # as before there were states: the text names mapped frames
            del plain["state_key"]
        return json.dumps(plain, sort_keys=True)

    @classmethod
    def from_json(cls, text: str) -> Reading:
        """What `to_json` wrote."""
        return cls(**json.loads(text))


@dataclass(frozen=True)
class Episode:
    """One recorded episode: T actions between T + 1 observations."""

    images: Any
    """[T + 1, H, W, 3], [T + 1, 3, H, W] or [T + 1, H, W]: uint8, or floats in 0 to 1."""
    actions: Any
    """float [T, A]."""
    rewards: Any = None
    """float [T]; None for 0 everywhere, where success comes from elsewhere."""
    terminated: Any = None
    """bool [T], the task ended with that transition; None for nowhere."""
    truncated: Any = None
    """bool [T], the recording ended there; None for the last transition where the task did not end."""
    infos: Mapping[str, Any] = field(default_factory=dict)
    """Arrays of T entries, or of T + 1, of which the first one is the reset's."""
    state: Any = None
    """float [T + 1, S], numbers beside the images, such as joint angles; None for none."""

    @classmethod
    def of_rows(cls, images: np.ndarray, actions: np.ndarray, rewards: Any, infos: Mapping[str, np.ndarray],
                state: np.ndarray | None = None) -> Episode:
        """An episode of formats that store T images (and T states) and T actions, each beside the image before it, with what
        it led to.

        The last action leads to no recorded image and is left out. What its row says of the end (a reward, a success) counts
        for the action before, which leads to the last image.
        """
        def moved(values: Any) -> np.ndarray:
            """[T, *] → [T - 1, *]."""
            values = np.asarray(values)
            values = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
            kept = values[:-1].copy()
            if len(kept) and values.ndim == 1 and values.dtype.kind in "fiub":
                kept[-1] = max(values[-2], values[-1])
            return kept

        return cls(images, actions[:-1], None if rewards is None else moved(rewards),
                   infos={name: moved(values) for name, values in infos.items()}, state=state)


@dataclass(frozen=True)
class FrameStore:
    """One row a frame. The row of an episode's last frame has action 0, reward 0 and no flag: nothing follows it."""

    frames: np.ndarray
    """uint8 [F, H, W, 3]; in memory, or mapped from a file."""
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
    reading: Reading = Reading()
    """How they were read."""
    states: np.ndarray | None = None
    """float32 [F, S], numbers beside the frames; None without."""

    @classmethod
    def from_arrays(cls, *, frames: np.ndarray, actions: np.ndarray, rewards: np.ndarray, terminated: np.ndarray,
                    truncated: np.ndarray, episode_length: Any, action_low: Any, action_high: Any,
                    dataset_id: str = "arrays", reading: Reading | None = None,
                    states: np.ndarray | None = None) -> FrameStore:
        """A store of rows as above; starts and content hash are computed, frames are not copied."""
        length = np.asarray(episode_length, dtype=np.int64)
        rows = int((length + 1).sum())
        counts = [len(array) for array in (frames, actions, rewards, terminated, truncated)]
        if counts != [rows] * 5 or (states is not None and len(states) != rows):
            raise DatasetError(f"frames, actions, rewards, terminated and truncated have {counts} rows; expected "
                               f"{rows} each, one more than transitions in every episode. Pad the last row of each "
                               "episode with zeros.")
        store = cls(frames, actions.astype(np.float32, copy=False), rewards.astype(np.float32, copy=False),
                    terminated.astype(bool, copy=False), truncated.astype(bool, copy=False),
                    np.cumsum(length + 1) - length - 1, length, np.asarray(action_low, np.float32),
                    np.asarray(action_high, np.float32), dataset_id, "", reading or Reading(image_size=frames.shape[1]),
                    None if states is None else states.astype(np.float32, copy=False))
        return replace(store, content_hash=content_hash(store))

    @classmethod
    def from_episodes(cls, episodes: Iterable[Episode], *, dataset_id: str = "episodes", action_low: Any = -np.inf,
                      action_high: Any = np.inf, success: str | Success | Predicate | None = None,
                      image_size: int | None = IMAGE_SIZE, fit: Fit | None = None, place: Path | None = None) -> FrameStore:
        """A store of recorded episodes, taken one at a time.

        Args:
            episodes: any iterable, a generator included; all have images of one shape.
            dataset_id: name in messages, cards and checkpoints.
            action_low: bounds of the actions, float [A] or one for all; infinite ones are taken from the data.
            action_high: as `action_low`.
            success: rule of `velap.data.success`, as an object, as text, or a function (reward, info, terminated) → bool of
                a module; None takes the info `success` or `is_success` where there is one, else the higher of two rewards.
            image_size: side that images are resized to [px]; None keeps that of square ones.
            fit: how oblong images become square.
            place: new folder for the frames where they do not fit into memory.
        """
        from velap.data.building import build_from_episodes

        return build_from_episodes(episodes, dataset_id, (action_low, action_high), success, image_size, fit, place)

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


def content_hash(store: FrameStore) -> str:
    """SHA-256 over name, type, shape and bytes of each array: equal for equal data, whatever file they came from."""
    digest = hashlib.sha256()
    for name, value in store.arrays().items():
        little_endian = np.ascontiguousarray(value).astype(value.dtype.newbyteorder("<"), copy=False)
        digest.update(f"{name} {little_endian.dtype.str} {value.shape};".encode())
        digest.update(little_endian.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()
