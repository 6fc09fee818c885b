"""OGBench `.npz` files with pixels, and plain arrays in one: `observations`, `actions`, `terminals`, maybe `rewards` and
more.

Arrays have one row a step [N, *]; `terminals` is 1 in the last row of each trajectory. OGBench's last row holds the last
observation, and its action leads nowhere. With `next_observations` every row is a transition. N rows, T transitions of
one episode.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from velap.data.building import image_space
from velap.data.frames import Episode
from velap.data.images import ImageLayout
from velap.data.loading import files_state
from velap.data.state import StateLayout
from velap.errors import DatasetError
from velap.registry import register_reader

NEEDED = ("observations", "actions", "terminals")


@register_reader("ogbench")
class OGBenchReader:
    """A file of arrays with one row a step."""

    content_sha256: str | None = None

    def __init__(self, source: str) -> None:
        self.name, self._path = source, Path(source)
        self.place = self._path.with_name(f".{self._path.name}.frames")
        with np.load(self._path, allow_pickle=False) as file:
            missing = [name for name in NEEDED if name not in file]
            if missing:
                raise DatasetError(f"{source} holds {', '.join(file.files)}; expected {', '.join(NEEDED)} too, one row "
                                   f"a step. Add {', '.join(missing)}, or build a store with FrameStore.from_episodes.")
            self._following = "next_observations" in file
            self._terminals = np.asarray(file["terminals"]).reshape(-1) > 0
            images = ("observations", "next_observations", "terminals")
            self._numbers = {name: values for name in file.files if name not in images and self._is_column(values :=
            file[name])}
        with _Rows(self._path, "observations") as rows:
            self.observation_space: gym.Space = image_space(rows.read(min(256, len(self._terminals))))
        actions = self._numbers.pop("actions")
        self._actions = actions
        bound = 1.0 if np.abs(actions).max() <= 1 else np.inf
        self.action_space = gym.spaces.Box(-bound, bound, actions.shape[1:], np.float32)
        self.frames = len(actions)

    def _is_column(self, values: Any) -> bool:
        return bool(values.ndim in (1, 2) and len(values) == len(self._terminals) and values.dtype.kind in "fiub")

    @classmethod
    def accepts(cls, source: str) -> bool:
        """A file that ends in `.npz`."""
        return source.endswith(".npz") and Path(source).is_file()

    def state(self) -> str:
        """Size and time of the file."""
        return files_state([self._path])

    def episodes(self, layout: ImageLayout, state: StateLayout | None = None) -> Iterator[Episode]:
        """All trajectories in order."""
        ends = np.flatnonzero(self._terminals).tolist()
        if not self._terminals[-1]:
            ends.append(len(self._terminals) - 1)
        start = 0
        with ExitStack() as stack:
            images = stack.enter_context(_Rows(self._path, "observations"))
            following = stack.enter_context(_Rows(self._path, "next_observations")) if self._following else None
            for end in ends:
                infos = {name: values[start : end + 1] for name, values in self._numbers.items()}
                rewards, actions = infos.pop("rewards", None), self._actions[start : end + 1]
                frames = images.read(end + 1 - start)
                if following is None:
                    yield Episode.of_rows(frames, actions, rewards, infos)
                else:
                    frames = np.concatenate([frames, following.read(end + 1 - start)[-1:]])
                    yield Episode(frames, actions, rewards, infos=infos)
                start = end + 1


class _Rows:
    """Rows of one array of a `.npz` file from its begin on, without the whole array in memory."""

    def __init__(self, path: Path, name: str) -> None:
        self._archive = zipfile.ZipFile(path)
        self._member = self._archive.open(f"{name}.npy")
        read_header = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}
        version = np.lib.format.read_magic(self._member)[0]
        shape, fortran, self._dtype = read_header[version](self._member)
        if fortran:
            raise DatasetError(f"{path}: {name} is stored column by column; expected C order. Save np.ascontiguousarray "
                               "of it.")
        self._shape = shape[1:]

    def read(self, count: int) -> np.ndarray:
        """The next `count` rows [count, *]."""
        size = count * int(np.prod(self._shape)) * self._dtype.itemsize
        data = self._member.read(size)
        return np.frombuffer(data, self._dtype).reshape(-1, *self._shape)

    def __enter__(self) -> _Rows:
        return self

    def __exit__(self, *_: object) -> None:
        self._member.close()
        self._archive.close()
