"""Read any dataset into a frame store: a reader is found for it, its camera and its success rule are chosen, the rest is
common.

A reader is one class with `register_reader` in a file of `velap.data.readers` or of another package.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import gymnasium as gym

from velap.data import checks, minari_io
from velap.data.building import build_store, rule_of
from velap.data.frames import Episode, FrameStore, Reading
from velap.data.images import IMAGE_SIZE, Fit, ImageLayout, find_images
from velap.data.mapped import open_or_build, too_large
from velap.data.state import StateLayout, find_state
from velap.data.success import Predicate, Success
from velap.errors import DatasetError
from velap.registry import READERS


class Reader(Protocol):
    """A dataset of one format, opened."""

    name: str
    """Of the dataset, for messages and checkpoints."""
    observation_space: gym.Space
    """Of one observation; the image is found in it as in an environment's."""
    action_space: gym.Space
    """Infinite bounds where the format names none."""
    frames: int
    """Frames in all episodes, about; 0 where the format does not tell."""
    content_sha256: str | None
    """Content hash of the store that was written, where velap wrote it at its own size."""
    place: Path
    """Folder beside the dataset for its mapped frames."""

    def __init__(self, source: str) -> None:
        """Open a dataset that `accepts` took."""

    @classmethod
    def accepts(cls, source: str) -> bool:
        """Is that a dataset of this format? Opens no more than it must."""

    def state(self) -> str:
        """What changes whenever the dataset does, such as a checksum, or sizes and times of its files."""

    def episodes(self, layout: ImageLayout, state: StateLayout | None = None) -> Iterator[Episode]:
        """All episodes in order, with the images of that camera as stored, and that state where one is asked for."""


def find_reader(source: str) -> Reader:
    """The dataset `source` (a path, or an id of Minari or LeRobot), opened by the reader that takes it."""
    for kind in READERS.values():
        if kind.accepts(source):
            found: Reader = kind(source)
            return found
    if Path(source).exists():
        raise DatasetError(f"no reader takes {source}; expected a dataset of {', '.join(READERS)}. Convert it, or "
                           "build a store with FrameStore.from_episodes.")
    minari_io.read_metadata(source)  # raises what is wrong with the id, and names those near it
    raise DatasetError(f"no reader takes {source}; expected a dataset of {', '.join(READERS)}.")


def files_state(paths: list[Path]) -> str:
    """Sizes and times of change of files, for `Reader.state`."""
    return "; ".join(f"{path.name} {(found := path.stat()).st_size} {found.st_mtime_ns}" for path in sorted(paths))


def load_store(source: str | Path, image_key: str | None = None, min_length: int = 1, image_size: int | None = IMAGE_SIZE, *,
               fit: Fit | None = None, success: str | Success | Predicate | None = None,
               mapped: bool | None = None, need_success: bool = True, state_key: str | None = None) -> FrameStore:
    """Read a dataset of images and continuous actions, ours or a stranger's, of any format that has a reader.

    Rewards become 0 and 1. An episode ends at its first success: what was recorded beyond is left out. Grey images are
    repeated to three channels, channel-first ones transposed, floats rounded, squares resized. Changes of the data are
    warned of.

    Args:
        source: path of the dataset, or its id.
        image_key: key of the image in Dict observations (`a/b` when nested); needed only where there are several. `a,b`
            puts two cameras side by side in one frame.
        min_length: the longest episode must have this many transitions [steps].
        image_size: side that images are resized to [px]; None keeps that of square ones.
        fit: how oblong images become square: `crop`, `pad` or `squash`.
        success: rule of `velap.data.success`; None finds one.
        mapped: map the frames from a file beside the dataset, which is made at the first call; None does so where they would
            take more than their share of memory.
        need_success: whether a dataset without any success is refused, as training must.
        state_key: key of numbers beside the image, `a,b` of several; None reads none.

    Raises:
        DatasetError: the dataset is missing, damaged or not of this kind; the text says the way out.
        StorageError: there is no room for the mapped frames.
    """
    reader = find_reader(str(source))
    layouts = find_images(reader.observation_space, image_key, reader.name, fit=fit)
    state = find_state(reader.observation_space, state_key, reader.name)
    bounds = checks.action_bounds(reader.action_space, reader.name)
    rule = rule_of(success)
    reading = Reading(",".join(layout.name for layout in layouts), image_size, fit,
                      "" if state is None else ",".join(state.names))
    side = image_size or max(side for layout in layouts for side in layout.sides)

    def build(path: Path | None) -> FrameStore:
        views = zip(*(reader.episodes(layout) if state is None else reader.episodes(layout, state) for layout in layouts),
                    strict=True)
        store = build_store(reader.name, views, layouts, bounds, reading, rule, reader.frames, path,
                            need_success)
        stored = [layout.sides for layout in layouts]
        if reader.content_sha256 is not None and stored == [(side, side)] and rule is None and state is None \
                and store.content_hash != reader.content_sha256:
            raise minari_io.damaged(reader.name, f"its arrays have SHA-256 {store.content_hash[:12]}…, not "
                                                 f"{reader.content_sha256[:12]}…")
        return store

    if too_large(reader.frames * len(layouts), side) if mapped is None else mapped:
        labels = files_state([Path(rule.name)]) if rule is not None and rule.source == "labels" else ""
        made_from = f"{reader.state()}; {reading.to_json()}; success {rule} {labels}{'' if need_success else ' or none'}"
        try:
            store = open_or_build(build, reader.place, made_from)
        except DatasetError:
            raise
        except OSError as error:
            raise minari_io.storage_error(error, f"the mapped frames {reader.place}") from error
    else:
        store = build(None)
    longest = int(store.episode_length.max())
    if longest < min_length:
        raise DatasetError(f"the longest episode of {reader.name} has {longest} transitions; expected one of "
                           f"{min_length} or more. Collect longer episodes, or train with a smaller window and dynamics "
                           "horizon.")
    return store
