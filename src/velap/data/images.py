"""Where the image lies in a stranger's observations, and how it becomes RGB. Letters: T transitions, H×W image [px]."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from PIL import Image

from velap.errors import DatasetError

IMAGE_SIZE = 64
"""Side of the images that the networks read [px], Table 2."""
MIN_SIDE = 8
"""Boxes with a shorter side are vectors or small matrices, not images [px]. ours."""
FLOAT_RANGES = ((0.0, 1.0), (-1.0, 1.0), (0.0, 255.0))
"""Bounds that float images may have."""

Fit = Literal["crop", "pad", "squash"]
"""How an oblong image becomes a square one: cut to its middle, padded with black on both sides, or squashed."""
FITS: tuple[Fit, ...] = ("crop", "pad", "squash")


@dataclass(frozen=True)
class ImageLayout:
    """Where the image lies in an observation and how it is laid out."""

    key: tuple[str, ...]
    """Path of keys into nested Dict observations, empty for a plain Box."""
    shape: tuple[int, ...]
    """Shape of one image as stored."""
    channel_first: bool
    dtype: str = "uint8"
    """Number type as stored."""
    bounds: tuple[float, float] = (0.0, 255.0)
    """Values of black and white."""

    @property
    def name(self) -> str:
        """The key as the user writes it, `a/b`; empty for a plain Box."""
        return "/".join(self.key)

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

    def of(self, observation: Any) -> np.ndarray:
        """The image [..., *shape] of one observation, or of the observations of an episode."""
        for key in self.key:
            observation = observation[key]
        return np.asarray(observation)


def leaves_of(space: gym.Space, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], gym.Space]:
    """The spaces within nested Dicts by their path of keys; a plain one under the empty path."""
    if not isinstance(space, gym.spaces.Dict):
        return {path: space}
    return {found: leaf for key, inner in space.spaces.items() for found, leaf in leaves_of(inner, (*path, key)).items()}


def image_like(space: gym.Space) -> bool:
    """Is that a Box with the sides of an image?"""
    return _layout((), space) is not None


def _layout(path: tuple[str, ...], space: gym.Space) -> ImageLayout | None:
    """The layout of an image-like Box of any number type, None for everything else."""
    shape = space.shape if isinstance(space, gym.spaces.Box) else None
    if shape is None or len(shape) not in (2, 3, 4):
        return None
    image = shape[-3:]
    channel_first = len(image) == 3 and image[0] < image[2]
    layout = ImageLayout(path, shape, channel_first, str(space.dtype))
    return layout if min(ImageLayout(path, image, channel_first).sides) >= MIN_SIDE else None


def listing(leaves: Mapping[tuple[str, ...], gym.Space]) -> str:
    """Observations by key, type and shape."""
    def brief(space: gym.Space) -> str:
        return f"{space.dtype}{list(space.shape)}" if isinstance(space, gym.spaces.Box) else type(space).__name__

    return ", ".join(f"{'/'.join(path) or 'observation'}: {brief(space)}" for path, space in leaves.items())


ADVICE = "render the frames into the dataset first"


def find_images(space: gym.Space, image_key: str | None, where: str, advice: str = ADVICE,
                fit: Fit | None = None) -> tuple[ImageLayout, ...]:
    """As `find_image`, of every camera that `image_key` names, `a,b`; they stand side by side in a frame."""
    return tuple(find_image(space, key, where, advice, fit) for key in keys_of(image_key) or ("",))


def keys_of(text: str | None) -> list[str]:
    """The keys in `a,b`."""
    return [key.strip() for key in text.split(",")] if text else []


def side_by_side(images: Sequence[np.ndarray], layouts: Sequence[ImageLayout], size: int | None,
                 fit: Fit | None = None) -> np.ndarray:
    """`to_rgb` of K cameras, each [T+1, *layout.shape] → frames uint8 [T+1, size, K · size, 3], in memory of their own."""
    return np.concatenate([to_rgb(raw, layout, size, fit) for raw, layout in zip(images, layouts, strict=True)], axis=2)


def find_image(space: gym.Space, image_key: str, where: str,
               advice: str = ADVICE, fit: Fit | None = None) -> ImageLayout:
    """The image of an observation space: the one named (`a/b` for nested Dicts), or the only one there is.

    Args:
        space: of one observation.
        image_key: key of the image; empty where there is only one.
        where: name of the dataset or environment, for messages.
        advice: what to do where there is no image.
        fit: how an oblong image becomes square; without it such an image is refused.
    """
    leaves = leaves_of(space)
    if image_key and () in leaves:
        raise DatasetError(f"{where} has plain observations and no key {image_key!r}; expected none. Leave --image-key out.")
    if image_key:
        path = next((path for path in leaves if "/".join(path) == image_key), None)
        if path is None:
            raise DatasetError(f"{where} has no observation key {image_key!r}; expected one of {listing(leaves)}. "
                               "Name the image with --image-key.")
        leaves = {path: leaves[path]}
    found = [layout for path, leaf in leaves.items() if (layout := _layout(path, leaf)) is not None]
    if len(found) > 1:
        found = [layout for layout in found if _is_picture(layout, leaves[layout.key])] or found
    if not found:
        raise DatasetError(f"{where} has no image among its observations ({listing(leaves)}); expected images "
                           f"[H, W, 3]. velap learns from pixels: {advice}.")
    if len(found) > 1:
        cameras = ", ".join(layout.name for layout in found)
        raise DatasetError(f"{where} has several images among its observations: {cameras}; expected one. Name the one to "
                           f"use with --image-key, for example --image-key {found[0].name}; several stand side by side.")
    return _checked(found[0], leaves[found[0].key], where, fit)


def known_key(space: gym.Space, image_key: str) -> str | None:
    """The key, or keys `a,b`, if observations of that space have them."""
    names = {"/".join(path) for path in leaves_of(space)}
    return image_key if image_key and names.issuperset(keys_of(image_key)) else None


def _is_picture(layout: ImageLayout, box: gym.Space) -> bool:
    """Is it a picture, and no depth map or mask beside one?"""
    if layout.dtype == "uint8":
        return True
    return layout.channels == 3 and _bounds(box) in FLOAT_RANGES


def _bounds(box: gym.Space) -> tuple[float, float]:
    assert isinstance(box, gym.spaces.Box)
    return float(box.low.min()), float(box.high.max())


def _checked(layout: ImageLayout, box: gym.Space, where: str, fit: Fit | None) -> ImageLayout:
    """The layout with its bounds; raises DatasetError where it cannot become an RGB square."""
    what = f"{where}: {layout.name or 'the observation'} is {box.dtype} of shape {layout.shape}"
    if len(layout.shape) == 4:
        raise DatasetError(f"{what}, several frames; expected one. Store the newest frame alone, velap stacks frames "
                           "itself.")
    if layout.channels not in (1, 3):
        stacked = layout.channels % 3 == 0 or layout.channel_first
        hint = ("store the newest frame alone, velap stacks frames itself" if stacked
                else "keep red, green and blue only")
        raise DatasetError(f"{what}, {layout.channels} channels; expected 3 or 1. Write the dataset again: {hint}.")
    if layout.sides[0] != layout.sides[1] and fit is None:
        raise DatasetError(f"{what}; expected square images. Say how they become square: --fit crop (their middle), "
                           "--fit pad (black beside them) or --fit squash.")
    if box.dtype == np.uint8:
        return layout
    bounds = _bounds(box)
    if not np.issubdtype(np.dtype(layout.dtype), np.floating) or bounds not in FLOAT_RANGES:
        raise DatasetError(f"{what} from {bounds[0]:g} to {bounds[1]:g}; expected uint8, or floats with the bounds 0 and 1, "
                           "-1 and 1, or 0 and 255. Convert it, for values in 0 to 1: np.round(255 * "
                           "frame).astype(np.uint8).")
    return ImageLayout(layout.key, layout.shape, layout.channel_first, layout.dtype, bounds)


def to_rgb(raw: np.ndarray, layout: ImageLayout, size: int | None, fit: Fit | None = None) -> np.ndarray:
    """[T+1, *layout.shape] as stored → uint8 [T+1, size, size, 3]: grey repeated, channels last, square, resized.

    With `size` None squares keep their side.
    """
    if layout.channel_first:
        raw = np.moveaxis(raw, 1, -1)
    elif raw.ndim == 3:
        raw = raw[..., None]
    if raw.dtype != np.uint8:
        low, high = layout.bounds
        raw = np.round((raw.astype(np.float32) - low) * (255 / (high - low))).clip(0, 255).astype(np.uint8)
    if raw.shape[-1] == 1:
        raw = np.broadcast_to(raw, (*raw.shape[:3], 3))
    if fit is not None:
        raw = _square(raw, fit)
    side = size or min(raw.shape[1:3])
    if raw.shape[1:3] == (side, side):
        return raw
    return np.stack([np.asarray(Image.fromarray(np.ascontiguousarray(frame)).resize((side, side), Image.Resampling.BOX))
                     for frame in raw])


def _square(frames: np.ndarray, fit: Fit) -> np.ndarray:
    """uint8 [T+1, H, W, 3] with both sides equal, but for `squash`, which leaves that to the resizing."""
    height, width = frames.shape[1:3]
    if height == width or fit == "squash":
        return frames
    short, beside = min(height, width), abs(height - width) // 2
    if fit == "crop":
        middle = slice(beside, beside + short)
        return frames[:, middle] if height > width else frames[:, :, middle]
    after = abs(height - width) - beside
    sides = ((beside, after), (0, 0)) if height < width else ((0, 0), (beside, after))
    return np.pad(frames, ((0, 0), *sides, (0, 0)))
