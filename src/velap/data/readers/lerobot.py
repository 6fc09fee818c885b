"""LeRobot datasets of format v3: image and video columns, whatever codec PyAV decodes (AV1 included).

A folder with `meta/info.json` (features, path templates, fps), `meta/episodes/**.parquet` (a row an episode: in which
files its rows and videos lie, and where in them), `data/**.parquet` (a row a frame) and `videos/<key>/**.mp4`; one file
holds many episodes. A row holds an observation and the action that follows it. The last action of an episode leads to no
recorded frame and is left out. T rows of one episode.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

from velap.data.frames import Episode
from velap.data.images import ImageLayout
from velap.data.loading import files_state
from velap.data.state import StateLayout
from velap.errors import DatasetError
from velap.registry import register_reader

INFO = Path("meta/info.json")
NEXT = "next."
"""Begin of the names of columns that tell what an action led to; infos are called with and without it."""
INTERNAL = ("timestamp", "frame_index", "episode_index", "index", "task_index")
EXTRA = "Install what reads LeRobot's files: pip install 'velap[lerobot]' (pyarrow and av)."


def _root(source: str) -> Path:
    """The folder of a path, or of a dataset id in LeRobot's cache."""
    if (Path(source) / INFO).is_file():
        return Path(source)
    home = os.environ.get("HF_HOME") or Path.home() / ".cache" / "huggingface"
    return Path(os.environ.get("HF_LEROBOT_HOME") or Path(home) / "lerobot") / source


@register_reader("lerobot")
class LeRobotReader:
    """A LeRobot dataset by its folder, or by its id (`user/name`) where LeRobot has downloaded it."""

    content_sha256: str | None = None

    def __init__(self, source: str) -> None:
        self.name = source
        self.place = _root(source) / ".velap-frames"
        self._root = _root(source)
        try:
            self._info: dict[str, Any] = json.loads((self._root / INFO).read_bytes())
            self._features: dict[str, Any] = self._info["features"]
            version = str(self._info["codebase_version"])
        except (OSError, ValueError, KeyError) as error:
            raise DatasetError(f"{self._root / INFO} cannot be read ({error!r}); expected that of a LeRobot dataset. "
                               "Download the dataset again.") from error
        if not version.startswith("v3"):
            raise DatasetError(f"{source} is a LeRobot dataset of format {version}; expected v3. Convert it with "
                               "LeRobot's script convert_dataset_v21_to_v30.")
        if "action" not in self._features:
            raise DatasetError(f"{source} has the features {', '.join(self._features)}; expected `action` among them.")
        kinds = {key: feature["dtype"] for key, feature in self._features.items()}
        cameras = {key: self._camera(key) for key, kind in kinds.items() if kind in ("image", "video")}
        numbers = {key: gym.spaces.Box(-np.inf, np.inf, tuple(self._features[key]["shape"]), np.float32)
                   for key, kind in kinds.items() if key.startswith("observation.") and kind.startswith(("float", "int"))}
        self.observation_space = gym.spaces.Dict(cameras | numbers)
        self.action_space = gym.spaces.Box(-np.inf, np.inf, tuple(self._features["action"]["shape"]), np.float32)
        self.frames = int(self._info.get("total_frames", 0))

    @classmethod
    def accepts(cls, source: str) -> bool:
        """A folder with `meta/info.json`."""
        return (_root(source) / INFO).is_file()

    def state(self) -> str:
        """Sizes and times of all files."""
        return files_state([path for path in self._root.rglob("*") if path.is_file() and ".velap-frames" not in str(path)])

    def _camera(self, key: str) -> gym.spaces.Box:
        """The space of a camera's images as they are decoded, channels last."""
        shape = tuple(self._features[key]["shape"])
        names = self._features[key].get("names") or ()
        if len(shape) == 3 and (names[:1] in (["channels"], ["channel"], ["c"]) or (not names and shape[0] < shape[2])):
            shape = (*shape[1:], shape[0])
        return gym.spaces.Box(0, 255, shape, np.uint8)

    def episodes(self, layout: ImageLayout, state: StateLayout | None = None) -> Iterator[Episode]:
        """All episodes in order of their index."""
        pa, pq = _pyarrow()
        key, video = layout.name, self._features[layout.name]["dtype"] == "video"
        numbers = [name for name, feature in self._features.items()
                   if feature["dtype"] not in ("image", "video", "string") and name not in INTERNAL and name != "action"]
        columns = ["episode_index", "action", *numbers, *([] if video else [key])]
        files = sorted((self._root / "meta/episodes").rglob("*.parquet"))
        entries = pa.concat_tables([pq.read_table(path) for path in files], promote_options="default")
        table = opened = None
        of_row = np.zeros(0, np.int64)
        frames = _Video() if video else None
        for entry in sorted(entries.to_pylist(), key=lambda entry: entry["episode_index"]):
            index, length = entry["episode_index"], entry["length"]
            path = self._root / self._info["data_path"].format(chunk_index=entry["data/chunk_index"],
                                                               file_index=entry["data/file_index"])
            try:
                if path != opened:
                    table, opened = pq.read_table(path, columns=columns), path
                    of_row = table["episode_index"].to_numpy()
                assert table is not None
                rows = table.slice(int(np.searchsorted(of_row, index)), int((of_row == index).sum()))
                values = {name: _numbers(rows[name]) for name in ("action", *numbers)}
                if frames is not None:
                    images = frames.read(self._video_path(key, entry), entry[f"videos/{key}/from_timestamp"], length,
                                         float(self._info["fps"]))
                else:
                    images = np.stack([_decoded(cell, self._root) for cell in rows[key].to_pylist()])
            except (OSError, KeyError, ValueError, pa.ArrowException) as error:
                raise DatasetError(f"{self.name}, episode {index} cannot be read from {path} ({type(error).__name__}: "
                                   f"{error}); expected the files as LeRobot wrote them. Download the dataset "
                                   "again.") from error
            if len(rows) != length or len(images) != length:
                raise DatasetError(f"{self.name}, episode {index} has {len(rows)} rows and {len(images)} images; expected "
                                   f"{length} each. Download the dataset again.")
            actions = values.pop("action")
            held = None if state is None else state.joined(values[name] for name in state.names)
            values |= {name.removeprefix(NEXT): column for name, column in values.items()}
            yield Episode.of_rows(images, actions, values.pop("reward", None), values, held)

    def _video_path(self, key: str, entry: dict[str, Any]) -> Path:
        return self._root / self._info["video_path"].format(video_key=key, chunk_index=entry[f"videos/{key}/chunk_index"],
                                                            file_index=entry[f"videos/{key}/file_index"])


def _pyarrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise DatasetError(f"LeRobot datasets are Parquet files and pyarrow is missing ({error}). {EXTRA}") from error
    return pyarrow, pyarrow.parquet


def _numbers(column: Any) -> np.ndarray:
    """A column of numbers [T], or of lists of numbers [T, *]."""
    array = column.combine_chunks()
    flat, listed = array, False
    while hasattr(flat, "flatten") and hasattr(flat.type, "value_type"):
        flat, listed = flat.flatten(), True
    values = flat.to_numpy(zero_copy_only=False)
    return values.reshape(len(array), -1) if listed else values


def _decoded(cell: dict[str, Any], root: Path) -> np.ndarray:
    """An image column's cell: encoded bytes, or the path of a file; uint8 [H, W, 3] or [H, W]."""
    data = cell["bytes"] if cell.get("bytes") else (root / cell["path"]).read_bytes()
    image = np.asarray(Image.open(io.BytesIO(data)))
    return image if image.ndim == 3 else image[..., None]


class _Video:
    """Reads runs of frames from video files, in order without seeking where runs follow each other."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._frames: Iterator[tuple[float, np.ndarray]] = iter(())

    def read(self, path: Path, start: float, count: int, fps: float) -> np.ndarray:
        """`count` frames uint8 [count, H, W, 3] from the time `start` [s] on."""
        images: list[np.ndarray] = []
        for attempt in range(2):
            if path != self._path or attempt:
                self._path, self._frames = path, _decode(path)
            for time, image in self._frames:
                if time > start + (len(images) + 0.5) / fps:  # it was passed already: begin again
                    break
                if time > start + (len(images) - 0.5) / fps:
                    images.append(image)
                    if len(images) == count:
                        return np.stack(images)
            images.clear()
        raise ValueError(f"{path} has no {count} frames from {start:g} s on, {fps:g} a second")


def _decode(path: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Time [s] and frame uint8 [H, W, 3] of a video, in order."""
    try:
        import av
    except ImportError as error:
        raise DatasetError(f"the frames are a video and PyAV is missing ({error}). {EXTRA}") from error
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        for frame in container.decode(stream):
            yield float(frame.time or 0.0), frame.to_ndarray(format="rgb24")
