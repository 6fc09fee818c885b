"""robomimic HDF5: groups `data/demo_<n>` with `obs/<key>`, `actions`, maybe `rewards`, `dones` and `next_obs/<key>`.

Observations come in one row an action. With `next_obs` the last one is its last row; without, the last action is left out.
Actions lie in -1 to 1 by robomimic's convention. T actions of one demonstration.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import numpy as np

from velap.data.building import image_space
from velap.data.frames import Episode
from velap.data.images import ImageLayout
from velap.data.loading import files_state
from velap.data.state import StateLayout
from velap.errors import DatasetError
from velap.registry import register_reader


def _space(group: Any) -> gym.Space:
    """The space of one observation of a group of arrays [T, *]."""
    if isinstance(group, h5py.Dataset):
        if group.ndim >= 3 and group.dtype.kind in "uf":
            return image_space(group[:64])
        return gym.spaces.Box(-np.inf, np.inf, group.shape[1:], group.dtype.type)
    return gym.spaces.Dict({name: _space(group[name]) for name in group})


@register_reader("robomimic")
class RobomimicReader:
    """A file of demonstrations in robomimic's layout."""

    content_sha256: str | None = None

    def __init__(self, source: str) -> None:
        self.name, self._path = source, Path(source)
        self.place = self._path.with_name(f".{self._path.name}.frames")
        with h5py.File(self._path, "r") as file:
            self._demos = sorted(file["data"], key=lambda name: int("".join(filter(str.isdigit, name)) or 0))
            if not self._demos:
                raise DatasetError(f"{source} has no demonstration under `data`; expected at least one. Record some.")
            first = file["data"][self._demos[0]]
            if "obs" not in first or "actions" not in first:
                raise DatasetError(f"{source}, {self._demos[0]} has {', '.join(first)}; expected `obs` with images, and "
                                   "`actions`. Extract the observations first, with robomimic's dataset_states_to_obs.py.")
            self.observation_space = _space(first["obs"])
            self.frames = sum(len(file["data"][demo]["actions"]) + 1 for demo in self._demos)
            actions = np.concatenate([file["data"][demo]["actions"][:] for demo in self._demos])
        bound = 1.0 if np.abs(actions).max() <= 1 else np.inf
        self.action_space = gym.spaces.Box(-bound, bound, actions.shape[1:], np.float32)

    @classmethod
    def accepts(cls, source: str) -> bool:
        """An HDF5 file with a group `data`."""
        if not Path(source).is_file() or not h5py.is_hdf5(source):
            return False
        with h5py.File(source, "r") as file:
            return isinstance(file.get("data"), h5py.Group)

    def state(self) -> str:
        """Size and time of the file."""
        return files_state([self._path])

    def episodes(self, layout: ImageLayout, state: StateLayout | None = None) -> Iterator[Episode]:
        """All demonstrations, by number."""
        with h5py.File(self._path, "r") as file:
            for name in self._demos:
                demo = file["data"][name]
                try:
                    yield self._episode(demo, layout, state)
                except (OSError, KeyError, ValueError) as error:
                    raise DatasetError(f"{self.name}, {name} cannot be read ({type(error).__name__}: {error}); expected the "
                                       "layout of robomimic. Write or download the file again.") from error

    def _episode(self, demo: Any, layout: ImageLayout, state: StateLayout | None) -> Episode:
        numbers = None if state is None else state.joined(demo["obs/" + name][:] for name in state.names)
        images, actions = demo["obs/" + layout.name][:], demo["actions"][:]
        rewards = demo["rewards"][:] if "rewards" in demo else None
        infos = {key: demo[key][:] for key in demo if isinstance(demo[key], h5py.Dataset) and demo[key].ndim <= 2
                 and key not in ("actions", "rewards", "states") and len(demo[key]) == len(actions)}
        following = demo.get("next_obs/" + layout.name)
        if following is None:
            return Episode.of_rows(images, actions, rewards, infos, numbers)
        images = np.concatenate([images, following[-1:]])
        if state is not None and numbers is not None:
            numbers = np.concatenate([numbers, state.joined(demo["next_obs/" + name][-1:] for name in state.names)])
        return Episode(images, actions, rewards, infos=infos, state=numbers)
