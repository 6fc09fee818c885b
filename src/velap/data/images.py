"""Where the image lies in a stranger's observations, and how it becomes RGB. Letters: T transitions, H×W image [px]."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
from PIL import Image

from velap.errors import DatasetError

IMAGE_SIZE = 64
"""Side of the images that the networks read [px], Table 2."""
MIN_SIDE = 8
"""Boxes with a shorter side are vectors or small matrices, not images [px]. ours."""


@dataclass(frozen=True)
class ImageLayout:
    """Where the image lies in an observation and how it is laid out."""

    key: tuple[str, ...]
    """Path of keys into nested Dict observations, empty for a plain Box."""
    shape: tuple[int, ...]
    """Shape of one image as stored."""
    channel_first: bool

    @property
    def sides(self) -> tuple[int, ...]:
        """Height and width [px]."""
        return self.shape[1:] if self.channel_first else self.shape[:2]

    @property
    def channels(self) -> int:
        """Colour channels."""
        if len(self.shape) == 2:
            return 1
        return self.shape[0] if self.channel_first else self.shape[2]


def _leaves(space: gym.Space, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], gym.Space]]:
    if isinstance(space, gym.spaces.Dict):
        for key, inner in space.spaces.items():
            yield from _leaves(inner, (*path, key))
    else:
        yield path, space


def _layout(path: tuple[str, ...], space: gym.Space) -> ImageLayout | None:
    """The layout of an image-like Box of any number type, None for everything else."""
    shape = space.shape if isinstance(space, gym.spaces.Box) else None
    if shape is None or len(shape) not in (2, 3):
        return None
    channel_first = len(shape) == 3 and shape[0] < shape[2]
    layout = ImageLayout(path, shape, channel_first)
    return layout if min(layout.sides) >= MIN_SIDE else None


def _listing(leaves: dict[tuple[str, ...], gym.Space]) -> str:
    def brief(space: gym.Space) -> str:
        return f"{space.dtype}{list(space.shape)}" if isinstance(space, gym.spaces.Box) else type(space).__name__

    return ", ".join(f"{'/'.join(path) or 'observation'}: {brief(space)}" for path, space in leaves.items())


def find_image(space: gym.Space, image_key: str | None, dataset_id: str,
               advice: str = "render the frames into the dataset first") -> ImageLayout:
    """The image of an observation space: the one named (`a/b` for nested Dicts), or the only one there is.

    `advice` says what to do where there is none.
    """
    leaves = dict(_leaves(space))
    if image_key is not None and () not in leaves:
        path = tuple(image_key.split("/"))
        if path not in leaves:
            raise DatasetError(f"{dataset_id} has no observation key {image_key!r}; expected one of {_listing(leaves)}. "
                               "Name the image with --image-key.")
        leaves = {path: leaves[path]}
    found = [layout for path, leaf in leaves.items() if (layout := _layout(path, leaf)) is not None]
    if len(found) > 1:
        found = [layout for layout in found if leaves[layout.key].dtype == np.uint8] or found
    if not found:
        raise DatasetError(f"{dataset_id} has no image among its observations ({_listing(leaves)}); expected uint8 images "
                           f"[H, W, 3]. velap learns from pixels: {advice}.")
    if len(found) > 1:
        raise DatasetError(f"{dataset_id} has several images among its observations ({_listing(leaves)}); expected one. "
                           "Name the one to use with --image-key.")
    _check(found[0], leaves[found[0].key], dataset_id)
    return found[0]


def _check(layout: ImageLayout, box: gym.Space, dataset_id: str) -> None:
    what = f"{dataset_id}: {'/'.join(layout.key) or 'the observation'} is {box.dtype} of shape {layout.shape}"
    if box.dtype != np.uint8:
        raise DatasetError(f"{what}; expected uint8 in 0 to 255. Convert it and write the dataset again, for floats in 0 "
                           "to 1: "
                           "np.round(255 * frame).astype(np.uint8).")
    if layout.channels not in (1, 3):
        hint = ("store the newest frame alone, velap stacks frames itself" if layout.channels % 3 == 0
                else "keep red, green and blue only")
        raise DatasetError(f"{what}, {layout.channels} channels; expected 3 or 1. Write the dataset again: {hint}.")
    if layout.sides[0] != layout.sides[1]:
        raise DatasetError(f"{what}; expected square images. Crop or pad them to a square and write the dataset again; "
                           "squares "
                           f"of any size are resized to {IMAGE_SIZE}×{IMAGE_SIZE} when read.")


def to_rgb(raw: np.ndarray, layout: ImageLayout, size: int | None) -> np.ndarray:
    """uint8 [T+1, *layout.shape] as stored → uint8 [T+1, size, size, 3]: grey repeated, channels last, resized."""
    if layout.channel_first:
        raw = np.moveaxis(raw, 1, -1)
    elif raw.ndim == 3:
        raw = raw[..., None]
    if raw.shape[-1] == 1:
        raw = np.broadcast_to(raw, (*raw.shape[:3], 3))
    if size is None or raw.shape[1] == size:
        return raw
    return np.stack([np.asarray(Image.fromarray(np.ascontiguousarray(frame)).resize((size, size), Image.Resampling.BOX))
                     for frame in raw])
