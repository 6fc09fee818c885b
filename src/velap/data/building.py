"""Episodes → frame store, one episode at a time, so that no frame is in memory twice; frames in memory or in a file.

Letters: F frames, E episodes, T transitions of one episode (it has T + 1 frames), A action entries.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from velap.data import checks
from velap.data.frames import Episode, FrameStore, Reading
from velap.data.images import FLOAT_RANGES, Fit, ImageLayout, find_image, side_by_side
from velap.data.success import INFO_KEYS, Predicate, Success
from velap.errors import ConfigError, DatasetError


class FrameBuffer:
    """Frames uint8 [F, side, width, 3] that are added episode by episode."""

    def __init__(self, side: int, width: int, expected: int, path: Path | None) -> None:
        """`expected` frames are made room for in memory; with `path` they are written to that file."""
        self._shape = (side, width, 3)
        self._count = 0
        self._path = path
        self._file = None if path is None else path.open("wb")
        self._held = np.empty((0 if path else max(expected, 1), *self._shape), np.uint8)

    def add(self, frames: np.ndarray) -> None:
        """Frames uint8 [T + 1, side, width, 3] of the next episode."""
        end = self._count + len(frames)
        if self._file is not None:
            self._file.write(np.ascontiguousarray(frames).data)
        else:
            if end > len(self._held):
                self._held.resize((max(end, len(self._held) * 3 // 2), *self._shape), refcheck=False)
            self._held[self._count : end] = frames
        self._count = end

    def finish(self) -> np.ndarray:
        """All frames, to be changed in place."""
        if self._file is not None:
            assert self._path is not None
            self._file.close()
            return np.memmap(self._path, np.uint8, "r+", shape=(self._count, *self._shape))
        return self._held[: self._count]

    def close(self) -> None:
        """Close the file where there is one."""
        if self._file is not None:
            self._file.close()


def build_store(name: str, episodes: Iterable[Sequence[Episode]], layouts: Sequence[ImageLayout],
                bounds: tuple[np.ndarray, np.ndarray], reading: Reading, rule: Success | None = None, expected: int = 0,
                path: Path | None = None, need_success: bool = True) -> FrameStore:
    """A store of episodes whose images lie as `layouts` say. Rewards become 0 and 1, an episode ends at its first success.

    Args:
        name: of the dataset.
        episodes: taken once, in order; each as every camera has it.
        layouts: of the images, one a camera.
        bounds: float32 [A] each, infinite where unknown.
        reading: how to read; the store keeps it with the success rule that was used.
        rule: of success; None finds one: the info `success` or `is_success` where there is one that is ever true, else the
            higher of two rewards.
        expected: frames to make room for.
        path: file for the frames; None keeps them in memory.
        need_success: whether data without any success are refused.
    """
    sides = [side for layout in layouts for side in layout.sides]
    side = reading.image_size or (max if reading.fit == "pad" else min)(sides)
    for layout in layouts:
        if layout.sides == (side, side):
            continue
        how = f" ({reading.fit})" if reading.fit and layout.sides[0] != layout.sides[1] else ""
        checks.notice(f"{name}: images of {layout.sides[0]}×{layout.sides[1]} are resized to {side}×{side}{how}.")
    frames, parts = FrameBuffer(side, side * len(layouts), expected, path), _Parts()
    try:
        for number, raw in enumerate(episodes):
            where = f"{name}, episode {number}"
            views = [checks.checked_episode(each, layout, bounds[0].shape, where)
                     for each, layout in zip(raw, layouts, strict=True)]
            episode = views[0]
            frames.add(side_by_side([each.images for each in views], layouts, side, reading.fit))
            parts.add(episode, None if rule is None else rule.of_episode(number, episode.rewards, episode.terminated,
                                                                         episode.infos, where), number, where)
        if not parts.lengths:
            raise DatasetError(f"{name} has no episode; expected at least one. Collect some data into it.")
        if rule is not None:
            rule.check_labels(len(parts.lengths))
        told, won = parts.successes(rule, name) if need_success else parts.any_successes(rule, name)
        rows, states = parts.rows(), parts.states(name)
        kept = frames.finish()
    finally:
        frames.close()
    seen = [kept] if states is None else [kept, states]
    length = _end_at_success(seen, rows, won, np.asarray(parts.lengths, np.int64), name)
    count = int((length + 1).sum())
    small = {key: array[:count] for key, array in rows.items()}
    checks.check_ends(small["terminated"], small["truncated"], length, name)
    low, high = checks.bounded_actions(small["actions"], length, *bounds, name)
    return FrameStore.from_arrays(frames=kept[:count], **small, episode_length=length, action_low=low, action_high=high,
                                  dataset_id=name, reading=replace(reading, image_size=side, success=told),
                                  states=None if states is None else states[:count])


class _Parts:
    """Everything of the episodes but their frames."""

    def __init__(self) -> None:
        self.lengths: list[int] = []
        self._episodes: list[Episode] = []
        self._won: list[np.ndarray] = []
        self._told: dict[str, list[np.ndarray]] = {key: [] for key in INFO_KEYS}
        self._names: set[str] = set()

    def add(self, episode: Episode, won: np.ndarray | None, number: int, where: str) -> None:
        """An episode, and its successes bool [T] where the rule is known."""
        self.lengths.append(len(episode.rewards))
        self._episodes.append(replace(episode, images=None, infos={}))
        if won is not None:
            self._won.append(won)
            return
        self._names.update(name for name, values in episode.infos.items()
                           if np.ndim(values) == 1 and len(values) - len(episode.rewards) in (0, 1))
        for key in INFO_KEYS:
            if key in episode.infos:
                found = Success("info", key).of_episode(number, episode.rewards, episode.terminated, episode.infos, where)
                self._told[key].append(found)

    def successes(self, rule: Success | None, name: str) -> tuple[str, list[np.ndarray]]:
        """The rule's text, found where none is given, and the successes bool [T] of each episode."""
        if rule is not None:
            if not any(won.any() for won in self._won):
                raise DatasetError(f"{name} has no success by the rule {rule}; expected at least one. Record some, or give "
                                   "another rule with --success.")
            return str(rule), self._won
        for key, told in self._told.items():
            if len(told) == len(self.lengths) and any(won.any() for won in told):
                return str(Success("info", key)), told
        rewards = [episode.rewards for episode in self._episodes]
        level = checks.level_rule(np.concatenate(rewards), name, sorted(self._names))
        if set(np.unique(np.concatenate(rewards))) != {0.0, 1.0}:
            other = min(float(part.min()) for part in rewards)
            checks.notice(f"{name}: reward {level:g} is read as success (1), {other:g} as 0.")
        return str(Success("reward", least=level)), [part >= level for part in rewards]

    def any_successes(self, rule: Success | None, name: str) -> tuple[str, list[np.ndarray]]:
        """As `successes`; no rule and no success where there is none."""
        try:
            return self.successes(rule, name)
        except DatasetError:
            return "" if rule is None else str(rule), [np.zeros(length, bool) for length in self.lengths]

    def states(self, name: str) -> np.ndarray | None:
        """float32 [F, S] of all episodes; None where they have none. Raises DatasetError where some differ."""
        widths = {None if episode.state is None else episode.state.shape[1] for episode in self._episodes}
        if len(widths) > 1:
            raise DatasetError(f"the states of {name} have {', '.join(map(str, widths))} entries; expected the same number "
                               "in every episode. Write the others again, or leave the state out.")
        return None if widths == {None} else np.concatenate([episode.state for episode in self._episodes])

    def rows(self) -> dict[str, np.ndarray]:
        """Actions, rewards and flags by frame [F, *], zero in the row of each last frame."""
        def padded(arrays: Iterator[np.ndarray]) -> np.ndarray:
            return np.concatenate([part for array in arrays for part in (array, np.zeros_like(array[:1]))])

        return {name: padded(getattr(episode, name) for episode in self._episodes)
                for name in ("actions", "rewards", "terminated", "truncated")}


def _end_at_success(seen: Sequence[np.ndarray], rows: dict[str, np.ndarray], won: list[np.ndarray], length: np.ndarray,
                    name: str) -> np.ndarray:
    """Rewards 0 and 1; each episode ends at its first success, rows of what was `seen` (frames, states) and of what was done
    are moved down in place. Gives the lengths int64 [E]."""
    lengths, source, target = length.copy(), 0, 0
    arrays = (*seen, *rows.values())
    for episode, steps in enumerate(length):
        hits = np.flatnonzero(won[episode])
        kept = int(hits[0]) + 1 if len(hits) else int(steps)
        if target != source:
            for array in arrays:
                array[target : target + kept + 1] = array[source : source + kept + 1]
        last = target + kept
        for array in rows.values():
            array[last] = 0
        rows["rewards"][target : last] = 0
        if len(hits):
            rows["rewards"][last - 1], rows["terminated"][last - 1], rows["truncated"][last - 1] = 1, True, False
        lengths[episode], source, target = kept, source + steps + 1, last + 1
    cut = int((lengths < length).sum())
    if cut:
        checks.notice(f"{name}: {cut} episodes go on after their first success; what follows it is left out.")
    return lengths


def rule_of(success: str | Success | Predicate | None) -> Success | None:
    """A success rule as an object; functions are kept by their module and name."""
    if success is None or isinstance(success, Success):
        return success
    if isinstance(success, str):
        return Success.parse(success) if success else None
    module, name = inspect.getmodule(success), getattr(success, "__qualname__", "")
    rule = Success("python", f"{getattr(module, '__name__', '')}:{name}")
    if "<" in name or module is None:
        raise ConfigError(f"the success rule is {success!r}; expected a function of a module, which evaluation can "
                          "find again. Define it with `def` at the top of a file.")
    return rule


def build_from_episodes(episodes: Iterable[Episode], name: str, bounds: tuple[Any, Any],
                        success: str | Success | Predicate | None, image_size: int | None, fit: Fit | None,
                        place: Path | None) -> FrameStore:
    """`FrameStore.from_episodes`."""
    from velap.data.mapped import build_mapped

    stream = iter(episodes)
    first = next(stream, None)
    if first is None:
        raise DatasetError(f"{name} has no episode; expected at least one.")
    layout = find_image(image_space(np.asarray(first.images)), "", name, fit=fit)
    shape = np.asarray(first.actions).shape[1:]
    if len(shape) != 1:
        raise DatasetError(f"{name}, episode 0: the actions have shape {np.shape(first.actions)}; expected one vector a "
                           "transition, [T, A].")
    low, high = (np.broadcast_to(np.asarray(bound, np.float32), shape).copy() for bound in bounds)
    reading = Reading(image_size=image_size, fit=fit)

    def build(path: Path | None) -> FrameStore:
        views = ((each,) for each in chain([first], stream))
        return build_store(name, views, [layout], (low, high), reading, rule_of(success), path=path)

    return build(None) if place is None else build_mapped(build, place, f"episodes of {name}")


def image_space(images: np.ndarray) -> gym.Space:
    """The space of images [T + 1, *]; float ones have the narrowest bounds of FLOAT_RANGES that hold them."""
    if not np.issubdtype(images.dtype, np.floating):
        largest = 255 if images.dtype == np.uint8 else np.iinfo(images.dtype).max
        return gym.spaces.Box(0, largest, images.shape[1:], images.dtype.type)
    low, high = float(images.min()), float(images.max())
    bounds = next((pair for pair in FLOAT_RANGES if pair[0] <= low and high <= pair[1]), (-np.inf, np.inf))
    return gym.spaces.Box(*bounds, images.shape[1:], images.dtype.type)


Build = Callable[[Path | None], FrameStore]
"""Makes a store with its frames in that file, or in memory."""
