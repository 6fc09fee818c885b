"""One connection's episode: observations in, actions out. N stacked frames, H×W picture [px], A action dimensions."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from velap._version import __version__
from velap.data.frames import Reading, stack_indices
from velap.data.images import MIN_SIDE, ImageLayout, keys_of, to_rgb
from velap.errors import ConfigError, ObservationError
from velap.methods.base import Agent, get_method, make_agent
from velap.methods.heads import head_path, load_head
from velap.models.checkpoint import WEIGHTS_SHA256, load_checkpoint
from velap.models.velap import Spaces
from velap.training.loop import pick_device

RESET, SEED = "reset", "seed"
"""Keys of an observation: whether it is the first one of an episode, and the seed of that episode's randomness."""
_NAMED = 8
"""Keys of an observation that an error names."""


@dataclass(frozen=True)
class Policy:
    """A trained method that any number of connections share; each gets an agent of its own."""

    make_agent: Callable[[], Agent]
    spaces: Spaces
    frame_stack: int
    """N [frames]."""
    reading: Reading
    """How the pictures of the training data became frames; the robot's become frames in the same way."""
    about: Mapping[str, Any]
    """What a client is told at the start: plain values."""


def load_policy(checkpoint: Path | str, method: str = "velap", device: str = "auto",
                head: Path | str | None = None) -> Policy:
    """The policy of a checkpoint.

    Args:
        checkpoint: `model.safetensors` of a run.
        method: a name in `velap.registry.METHODS`.
        device: `auto`, `cpu` or `cuda`.
        head: what the method learnt; None looks for `<method>.safetensors` beside the checkpoint where it needs one.
    """
    where, learns = pick_device(device), get_method(method).learns
    model, config, metadata = load_checkpoint(checkpoint, where)
    learnt = load_head(head or head_path(checkpoint, method), metadata, where) if learns else None
    spaces = model.spaces
    low, high = np.array([spaces.action_low, spaces.action_high], np.float32)
    actions = gym.spaces.Box(low, high, dtype=np.float32)
    about = {
        "server": f"velap {__version__}", "task": config.task, "method": method, "weights_sha256": metadata[WEIGHTS_SHA256],
        "image_shape": [spaces.height, spaces.width, 3], "frame_stack": config.model.frame_stack,
        "action_low": list(spaces.action_low), "action_high": list(spaces.action_high), "action_horizon": 1,
        "state_size": spaces.state_dim, "reset_key": RESET, "seed_key": SEED,
    }

    def agent() -> Agent:
        return make_agent(method, model, config, actions, learnt)

    agent()  # a method that does not exist or lacks its head is an error of the start
    reading = Reading.from_json(metadata["reading"]) if "reading" in metadata else Reading(image_size=spaces.height)
    return Policy(agent, spaces, config.model.frame_stack, reading, about)


class Session:
    """The episode of one client. A refused observation changes nothing."""

    def __init__(self, policy: Policy, image_key: str | None = None) -> None:
        self._agent = policy.make_agent()
        self._picture = PictureReader(policy.spaces, image_key, policy.reading)
        self._state = StateFinder(policy.reading.state_key, policy.spaces.state_dim)
        self._frames: deque[NDArray[np.uint8]] = deque(maxlen=policy.frame_stack)
        self._stack = policy.frame_stack

    def step(self, observation: Any) -> dict[str, Any]:
        """The answer to an observation: `actions` float32 [1, A] in the robot's own range, and `plan_ms` where it planned.

        The stack of frames is made here; the client sends the newest picture alone. The first observation of a connection
        starts an episode, and so does every one whose `reset` is true.
        """
        if not isinstance(observation, dict):
            raise ObservationError(f"got {type(observation).__name__}; expected a dict with the camera's picture.")
        frame, state = self._picture(observation), self._state(observation)
        first, seed = _flag(observation.get(RESET, False)), _seed(observation.get(SEED, 0))
        if first or not self._frames:
            self._agent.reset(np.ones(1, bool), np.array([seed]))
            self._frames.clear()
        self._frames.append(frame)
        rows = stack_indices(np.array(len(self._frames) - 1), np.array(0), self._stack)
        frames = np.stack([self._frames[row] for row in rows])[None]
        actions = self._agent.act(frames) if state is None else self._agent.act(frames, state[None])
        planned = float(self._agent.last_plan_ms[0])
        return {"actions": actions, **({"plan_ms": planned} if np.isfinite(planned) else {})}


class PictureReader:
    """The camera's picture of an observation, as the model reads it: uint8 [H, W, 3]; of several cameras side by side.

    Pictures are uint8, [h, w, 3], [3, h, w] or grey. Those of other sizes than the model's become square and are resized as
    the training data were. Everything else is an ObservationError.

    Args:
        spaces: of the model.
        key: key of the picture, `a/b` when nested, or `a,b` of several cameras; None takes the only picture, or those that
            are named as the training data's were.
        reading: how the training data were read.
    """

    def __init__(self, spaces: Spaces, key: str | None = None, reading: Reading | None = None) -> None:
        self._reading = reading or Reading(image_size=spaces.height)
        learnt = keys_of(self._reading.image_key)
        self._keys = keys_of(key) or (learnt if len(learnt) > 1 else [])
        if max(len(self._keys), 1) != max(len(learnt), 1):
            raise ConfigError(f"got the cameras {', '.join(self._keys)}; expected as many as in the training data "
                              f"({', '.join(learnt) or 'one, without a name'}). Name as many, in the same order, with "
                              "--image-key.")
        self._size = (spaces.height, spaces.width // max(len(learnt), 1))

    def __call__(self, observation: Mapping[str, Any]) -> NDArray[np.uint8]:
        return np.concatenate([self._frame(*self._find(observation, key)) for key in self._keys or ("",)], axis=1)

    def _frame(self, name: str, raw: np.ndarray) -> NDArray[np.uint8]:
        """One camera's picture, square and resized."""
        height, width = self._size
        got = f"the picture {name!r} is {raw.dtype}{list(raw.shape)}; expected uint8[{height}, {width}, 3]"
        if raw.dtype != np.uint8:
            raise ObservationError(f"{got} in 0 to 255. Convert floats in 0 to 1 by "
                                   "np.round(255 * picture).astype(np.uint8).")
        layout = _layout(raw)
        if layout is None:
            raise ObservationError(f"{got}. Send red, green and blue without alpha, and one picture at a time: the server "
                                   "stacks frames itself.")
        if layout.sides == self._size:
            return to_rgb(raw[None], layout, None)[0].copy()
        if self._reading.fit is None and layout.sides[0] != layout.sides[1]:
            raise ObservationError(f"{got}, or a square of another size. Crop or pad the picture as it was for the training "
                                   "data.")
        return to_rgb(raw[None], layout, height, self._reading.fit)[0].copy()

    def _find(self, observation: Mapping[str, Any], key: str) -> tuple[str, np.ndarray]:
        """Name and array of the picture: the key's, or without one the only array that may be one."""
        arrays = dict(_arrays(observation))
        if key:
            if key not in arrays:
                raise ObservationError(f"the observation has no array {key!r}; it has {_listing(arrays)}. Send the "
                                       "picture under that key, or name another one with --image-key.")
            return key, arrays[key]
        found = {name: array for name, array in arrays.items()
                 if array.ndim == 3 or (array.dtype == np.uint8 and _layout(array) is not None)}
        if self._reading.image_key in found:
            return self._reading.image_key, found[self._reading.image_key]
        if len(found) != 1:
            raise ObservationError(f"the observation has {len(found)} pictures; expected one. It has {_listing(arrays)}. "
                                   "Send uint8[H, W, 3]; among several, name the one to use with --image-key.")
        return next(iter(found.items()))


class StateFinder:
    """The state [S] of an observation, for models that have one; everything else is an ObservationError.

    Args:
        state_key: its keys in the training data, `a,b`.
        size: S; 0 for models without.
    """

    def __init__(self, state_key: str, size: int) -> None:
        self._keys, self._size = keys_of(state_key), size

    def __call__(self, observation: Mapping[str, Any]) -> NDArray[np.float32] | None:
        if not self._size:
            return None
        arrays = {name: array for name, array in _arrays(observation) if array.dtype.kind in "fiub" and array.ndim <= 1}
        keys = self._keys if self._keys and arrays.keys() >= set(self._keys) else [
            name for name, array in arrays.items() if array.size == self._size]
        found = [arrays[key].reshape(-1) for key in keys]
        if not found or sum(part.size for part in found) != self._size or not all(np.isfinite(part).all() for part in found):
            raise ObservationError(f"the observation has no state of {self._size} finite numbers; it has "
                                   f"{_listing(dict(_arrays(observation)))}. Send it under "
                                   f"{', '.join(self._keys) or 'any key'}, as in the training data.")
        return np.concatenate(found).astype(np.float32)


def _arrays(values: Mapping[str, Any], prefix: str = "", depth: int = 0) -> Iterator[tuple[str, np.ndarray]]:
    """Names, `a/b` in nested dicts, and arrays of an observation."""
    for key, value in values.items():
        if isinstance(value, np.ndarray):
            yield f"{prefix}{key}", value
        elif isinstance(value, dict) and depth < 4:
            yield from _arrays(value, f"{prefix}{key}/", depth + 1)


def _listing(arrays: Mapping[str, np.ndarray]) -> str:
    """A few arrays by name, type and shape."""
    named = [f"{name[:40]!r}: {array.dtype}{list(array.shape)}" for name, array in list(arrays.items())[:_NAMED]]
    return ", ".join(named + ["…"] * (len(arrays) > _NAMED)) or "no array"


def _layout(raw: np.ndarray) -> ImageLayout | None:
    """How the axes of a picture lie; None for what is none."""
    if raw.ndim not in (2, 3):
        return None
    channel_first = raw.ndim == 3 and raw.shape[0] in (1, 3) and raw.shape[2] not in (1, 3)
    layout = ImageLayout((), raw.shape, channel_first)
    return layout if layout.channels in (1, 3) and min(layout.sides) >= MIN_SIDE else None


def _scalar(value: Any) -> Any:
    """A Python value of a scalar or an array of one entry, anything else as it is."""
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.size == 1):
        return value.item()
    return value


def _flag(value: Any) -> bool:
    flag = _scalar(value)
    if not isinstance(flag, bool | int) or flag not in (0, 1):
        raise ObservationError(f"{RESET!r} is {str(value)[:40]!r}; expected true in the first observation of an episode, "
                               "else false or nothing.")
    return bool(flag)


def _seed(value: Any) -> int:
    seed = _scalar(value)
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ObservationError(f"{SEED!r} is {str(value)[:40]!r}; expected an integer from 0 to 2^63 - 1.")
    return seed
