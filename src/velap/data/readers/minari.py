"""Minari datasets: HDF5, Arrow or Parquet; images may be JPEG-encoded. T transitions of one episode."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from velap.data import minari_io
from velap.data.frames import Episode
from velap.data.images import ImageLayout
from velap.data.loading import files_state
from velap.data.state import StateLayout
from velap.registry import register_reader


def flat_infos(infos: dict[str, Any] | None, prefix: str = "") -> dict[str, np.ndarray]:
    """Infos of an episode by name, `a/b` where they are nested."""
    flat: dict[str, np.ndarray] = {}
    for name, value in (infos or {}).items():
        if isinstance(value, dict):
            flat |= flat_infos(value, f"{prefix}{name}/")
        elif np.ndim(value) > 0:
            flat[prefix + name] = np.asarray(value)
    return flat


@register_reader("minari")
class MinariReader:
    """A Minari dataset of this machine, by its id."""

    def __init__(self, source: str) -> None:
        self.name = source
        self._dataset = minari_io.open_dataset(source)
        self.observation_space = self._dataset.observation_space
        self.action_space = self._dataset.action_space
        self.frames = int(self._dataset.total_steps + self._dataset.total_episodes)
        self._checksums = minari_io.velap_metadata(self._dataset.storage.metadata)
        self.content_sha256 = self._checksums.get("content_sha256")
        directory = minari_io.dataset_path(source)
        self.place = directory.with_name(f".{directory.name}.frames")

    @classmethod
    def accepts(cls, source: str) -> bool:
        """Every id of Minari's form is taken where the dataset is here."""
        return minari_io.is_id(source) and minari_io.exists(source)

    def state(self) -> str:
        """The checksum that velap left, else sizes and times of the files."""
        data = minari_io.dataset_path(self.name) / "data"
        return str(self._checksums.get("file_sha256") or files_state([path for path in data.rglob("*") if path.is_file()]))

    def episodes(self, layout: ImageLayout, state: StateLayout | None = None) -> Iterator[Episode]:
        """All episodes in order."""
        for raw in minari_io.raw_episodes(self._dataset):
            yield Episode(layout.of(raw["observations"]), raw["actions"], raw["rewards"], raw["terminations"],
                          raw["truncations"], flat_infos(raw["infos"]),
                          None if state is None else state.of_episode(raw["observations"]))
