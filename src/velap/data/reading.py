"""What a stranger's episodes must look like, and how they become rows of a frame store: each check says the way out.

Letters: T transitions of one episode (it has T + 1 frames), A action entries, H×W image [px].
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from PIL import Image

from velap.errors import DatasetError

IMAGE_SIZE = 64
"""Side of the images that the networks read [px], Table 2."""
MIN_SIDE = 8
"""Boxes with a shorter side are vectors, not images [px]. ours."""


@dataclass(frozen=True)
class ImageLayout:
    """Where the image lies in an observation and how it is laid out."""

    key: tuple[str, ...]
    """Path of keys into nested Dict observations, empty for a plain Box."""
    shape: tuple[int, ...]
    """Shape of one image as stored."""
    channel_first: bool

    @property
    def side(self) -> int:
        """Side of the square image [px]."""
        return self.shape[-1] if self.channel_first else self.shape[0]


def _boxes(space: gym.Space, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], gym.Space]]:
    if isinstance(space, gym.spaces.Dict):
        for key, inner in space.spaces.items():
            yield from _boxes(inner, (*path, key))
    else:
        yield path, space


def _layout(path: tuple[str, ...], space: gym.Space) -> ImageLayout | None:
    """The layout of an image-like Box of any number type, None for everything else."""
    shape = space.shape if isinstance(space, gym.spaces.Box) else None
    if shape is None or len(shape) not in (2, 3):
        return None
    channel_first = len(shape) == 3 and shape[0] in (1, 3) and shape[2] not in (1, 3)
    sides = shape[1:] if channel_first else shape[:2]
    return ImageLayout(path, shape, channel_first) if min(sides) >= MIN_SIDE else None


def find_image(space: gym.Space, image_key: str | None, dataset_id: str) -> ImageLayout:
    """The image of an observation space: the one named (`a/b` for nested Dicts), or the only one there is."""
    boxes = dict(_boxes(space))
    names = ["/".join(path) for path in boxes if path]
    listing = "; ".join(f"{'/'.join(path) or 'observation'}: {box}" for path, box in boxes.items())
    if image_key is not None and names:
        path = tuple(image_key.split("/"))
        if path not in boxes:
            raise DatasetError(f"{dataset_id} has no observation key {image_key!r}; expected one of {', '.join(names)}. Name it with --image-key.")
        boxes = {path: boxes[path]}
    found = [layout for path, box in boxes.items() if (layout := _layout(path, box)) is not None]
    exact = [layout for layout in found if boxes[layout.key].dtype == np.uint8]
    found = exact if len(exact) == 1 else found
    if not found:
        raise DatasetError(f"{dataset_id} has no image observation ({_short(listing)}); expected uint8 images [H, W, 3]. velap learns from "
                           "pixels: render the frames into the dataset first.")
    if len(found) > 1:
        several = ", ".join("/".join(layout.key) for layout in found)
        raise DatasetError(f"{dataset_id} has several image observations ({several}); expected one. Name the one to use with --image-key.")
    _check_layout(found[0], boxes[found[0].key], dataset_id)
    return found[0]


def _short(text: str, limit: int = 300) -> str:
    return text if len(text) <= limit else text[:limit] + "…"


def _check_layout(layout: ImageLayout, box: gym.Space, dataset_id: str) -> None:
    name = "/".join(layout.key) or "the observation"
    if box.dtype != np.uint8:
        raise DatasetError(f"{dataset_id}: {name} is {box.dtype}; expected uint8 in 0 to 255. Store it as np.uint8 (for floats in 0 to 1: "
                           "np.round(255 * frame).astype(np.uint8)) and write the dataset again.")
    shape = layout.shape
    channels = 1 if len(shape) == 2 else shape[0] if layout.channel_first else shape[2]
    sides = shape[1:] if layout.channel_first else shape[:2]
    if channels not in (1, 3):
        hint = "velap stacks frames itself: store the newest frame alone" if channels % 3 == 0 else "drop the channels beyond red, green, blue"
        raise DatasetError(f"{dataset_id}: {name} has shape {shape} with {channels} channels; expected 3 or 1; {hint}.")
    if sides[0] != sides[1]:
        raise DatasetError(f"{dataset_id}: {name} has shape {shape}; expected square images. Crop or pad them to a square when the "
                           "dataset is written; velap resizes squares by itself.")


def to_rgb(raw: np.ndarray, layout: ImageLayout, size: int | None) -> np.ndarray:
    """Stored images uint8 [T+1, *layout.shape] → uint8 [T+1, size, size, 3]; grey is repeated, other sizes are box-filtered."""
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


def action_bounds(space: gym.Space, dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """float32 [A] lower and upper bounds, infinite where the dataset names none."""
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise DatasetError(f"{dataset_id} has actions {_short(str(space))}; expected a Box of floats with one axis. velap's policies are "
                           "continuous: discrete or nested actions need another method.")
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    if not np.all(low < high):
        raise DatasetError(f"{dataset_id} has action bounds {low.tolist()} to {high.tolist()}; expected low < high in every entry. "
                           "Leave constant entries out of the action.")
    return low, high


def reward_levels(rewards: np.ndarray, dataset_id: str) -> tuple[float, float]:
    """The two values of a sparse reward, (ordinary, success); DatasetError for any other kind of reward.

    Args:
        rewards: float [all transitions].
    """
    levels = np.unique(rewards)
    if levels.size == 0 or levels[-1] <= 0:
        shown = ", ".join(f"{level:g}" for level in levels[-3:]) or "none"
        raise DatasetError(f"{dataset_id} has no positive reward (values: {shown}); expected 1 on the transitions that succeed. "
                           "velap learns from rare successes: record some, or label them (write reward 1 where the task was solved, else 0).")
    if levels.size == 1:
        raise DatasetError(f"{dataset_id} has reward {levels[0]:g} on every transition; expected 0 on most and 1 on the transitions that "
                           "succeed. Write reward 0 where the task was not solved.")
    if levels.size > 2:
        raise DatasetError(f"{dataset_id} has {levels.size} different rewards, from {levels[0]:g} to {levels[-1]:g}; expected a sparse one with "
                           "two values. Binarise it when the dataset is written: reward = float(success), for example "
                           f"float(reward >= {levels[-1]:g}).")
    return float(levels[0]), float(levels[1])


def _field(episode: dict[str, Any], name: str, where: str, length: int | None = None) -> np.ndarray:
    values = np.asarray(episode[name])
    if values.ndim != 1 or (length is not None and len(values) != length):
        raise DatasetError(f"{where}: {name} have shape {values.shape}; expected ({length if length is not None else 'T'},), one a "
                           "transition. Write the episode again with one more observation than transitions.")
    return values


def _require_finite(values: np.ndarray, name: str, where: str) -> None:
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        step = int(np.argmin(finite))
        raise DatasetError(f"{where}: {name} at step {step} is {np.asarray(values[step]).tolist()}; expected finite numbers. Drop that episode "
                           "or repair the value, and write the dataset again.")


def raw_rewards(episode: dict[str, Any], where: str) -> np.ndarray:
    """float64 [T] rewards of one Minari episode, finite."""
    rewards = _field(episode, "rewards", where)
    if rewards.dtype.kind not in "fiub":
        raise DatasetError(f"{where}: rewards are {rewards.dtype}; expected numbers. Write reward 1.0 for success, else 0.0.")
    rewards = rewards.astype(np.float64)
    _require_finite(rewards, "reward", where)
    return rewards


def check_episode(episode: dict[str, Any], layout: ImageLayout, action_shape: tuple[int, ...], where: str) -> dict[str, np.ndarray]:
    """The arrays of one Minari episode with agreeing shapes and finite values: frames, actions, rewards and both flags."""
    rewards = raw_rewards(episode, where)
    steps = len(rewards)
    if steps == 0:
        raise DatasetError(f"{where} has no transition; expected at least one. Leave empty episodes out of the dataset.")
    frames = episode["observations"]
    for key in layout.key:
        frames = frames[key]
    frames = np.asarray(frames)
    if frames.shape != (steps + 1, *layout.shape) or frames.dtype != np.uint8:
        raise DatasetError(f"{where}: the images are {frames.dtype} {frames.shape}; expected uint8 {(steps + 1, *layout.shape)}: one more than "
                           "the rewards, of the shape that the dataset states. Write the episode again, last observation included.")
    actions = np.asarray(episode["actions"])
    if actions.shape != (steps, *action_shape):
        raise DatasetError(f"{where}: the actions have shape {actions.shape}; expected {(steps, *action_shape)}, one a transition. "
                           "Write the episode again.")
    _require_finite(actions, "action", where)
    return {
        "frames": frames,
        "actions": actions.astype(np.float32),
        "rewards": rewards,
        "terminated": _field(episode, "terminations", where, steps).astype(bool),
        "truncated": _field(episode, "truncations", where, steps).astype(bool),
    }


def check_flags(terminated: np.ndarray, truncated: np.ndarray, where: str) -> None:
    """Raise DatasetError when a flag stands before the last transition. Both bool [T]."""
    early = (terminated | truncated)[:-1]
    if early.any():
        step, kind = int(np.argmax(early)), "termination" if terminated[np.argmax(early)] else "truncation"
        raise DatasetError(f"{where}: a {kind} stands at step {step}, but the episode goes on to step {len(terminated) - 1}; expected flags at "
                           "the last transition only. Split the episode there and write the dataset again.")


def notice(text: str) -> None:
    """Tell the user about a harmless change that was made to the data while reading."""
    warnings.warn(text, UserWarning, stacklevel=3)
