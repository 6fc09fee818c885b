"""What a stranger's episodes must look like, and how they become rows of a frame store; each error says the way out.

Letters: F frames, T transitions of one episode (it has T + 1 frames), A action entries, H×W image [px].
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from minari.dataset.minari_dataset import MinariDataset

from velap.data import minari_io
from velap.data.images import ImageLayout, to_rgb
from velap.errors import DatasetError


@dataclass(frozen=True)
class Rows:
    """Rows of all episodes. `frames` is by far the largest array: it is filled once and never copied."""

    frames: np.ndarray
    """uint8 [F, H, W, 3]."""
    actions: np.ndarray
    """float32 [F, A]."""
    rewards: np.ndarray
    """float64 [F]."""
    terminated: np.ndarray
    """bool [F]."""
    truncated: np.ndarray
    """bool [F]."""
    length: np.ndarray
    """int64 [E] transitions of each episode."""

    def arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Those with one entry a frame, frames first."""
        return self.frames, self.actions, self.rewards, self.terminated, self.truncated

    def head(self, count: int, length: np.ndarray) -> Rows:
        """Views of the first `count` rows, with the episodes' lengths int64 [E]."""
        return Rows(self.frames[:count], self.actions[:count], self.rewards[:count], self.terminated[:count],
                    self.truncated[:count], length)

    def end(self) -> np.ndarray:
        """int64 [E] last row of each episode."""
        return np.cumsum(self.length + 1) - 1


def notice(text: str) -> None:
    """Tell the user about a harmless change that is made to the data while reading."""
    warnings.warn(text, UserWarning, stacklevel=4)


def action_bounds(space: gym.Space, dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """float32 [A] lower and upper bounds, infinite where the dataset names none."""
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise DatasetError(f"{dataset_id} has the action space {str(space)[:200]}; expected a Box of floats with one axis. "
                           "The "
                           "policies here are continuous: discrete or nested actions need another method.")
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    if not np.all(low < high):
        raise DatasetError(f"{dataset_id} has action bounds {low.tolist()} to {high.tolist()}; expected low < high in every "
                           "entry. Leave constant entries out of the action and write the dataset again.")
    return low, high


def reward_levels(rewards: np.ndarray, dataset_id: str) -> tuple[float, float]:
    """The two values (ordinary, success) of a sparse reward float [all transitions]; DatasetError for any other kind."""
    levels = np.unique(rewards)
    if levels[-1] <= 0:
        shown = ", ".join(f"{level:g}" for level in levels[-3:])
        raise DatasetError(f"the rewards of {dataset_id} are never positive (values: {shown}); expected 1 on the "
                           "transitions that "
                           "solve the task and 0 elsewhere. Record some successes, or label them, and write the dataset "
                           "again.")
    if levels.size == 1:
        raise DatasetError(f"every reward of {dataset_id} is {levels[0]:g}; expected 1 on the transitions that solve the "
                           "task and "
                           "0 elsewhere. Write reward 0 where the task was not solved.")
    if levels.size > 2:
        raise DatasetError(f"{dataset_id} has {levels.size} different rewards, from {levels[0]:g} to {levels[-1]:g}; "
                           "expected a "
                           "sparse reward of two values. Binarise it and write the dataset again: reward = float(success), "
                           "for "
                           f"example float(reward >= {levels[-1]:g}).")
    return float(levels[0]), float(levels[1])


def _vector(episode: dict[str, Any], name: str, where: str, length: int | None = None) -> np.ndarray:
    values = np.asarray(episode[name])
    if values.ndim != 1 or values.dtype.kind not in "fiub" or (length is not None and len(values) != length):
        expected = "one number a transition" if length is None else f"{length} of them, as many as rewards"
        raise DatasetError(f"{where}: {name} are {values.dtype} of shape {values.shape}; expected {expected}. "
                           "Write that episode again.")
    return values


def _require_finite(values: np.ndarray, name: str, where: str) -> None:
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        step = int(np.argmin(finite))
        raise DatasetError(f"{where}: the {name} of step {step} is {values[step].tolist()}; expected finite numbers. "
                           "Repair the "
                           "value or drop that episode, and write the dataset again.")


def check_episode(episode: dict[str, Any], layout: ImageLayout, action_shape: tuple[int, ...],
                  where: str) -> dict[str, np.ndarray]:
    """The arrays of one Minari episode, shapes agreeing and values finite: images, actions, rewards and both flags."""
    rewards = _vector(episode, "rewards", where).astype(np.float64)
    steps = len(rewards)
    if steps == 0:
        raise DatasetError(f"{where} has no transition; expected at least one. Leave empty episodes out of the dataset.")
    _require_finite(rewards, "reward", where)
    images = episode["observations"]
    for key in layout.key:
        images = images[key]
    images = np.asarray(images)
    if images.shape != (steps + 1, *layout.shape) or images.dtype != np.uint8:
        raise DatasetError(f"{where}: the images are {images.dtype} of shape {images.shape}; expected uint8 of shape "
                           f"{(steps + 1, *layout.shape)}, one more than the {steps} rewards. Write that episode again, "
                           "its last "
                           "observation included.")
    actions = np.asarray(episode["actions"])
    if actions.shape != (steps, *action_shape):
        raise DatasetError(f"{where}: the actions have shape {actions.shape}; expected {(steps, *action_shape)}, one a "
                           "transition. Write that episode again.")
    _require_finite(actions, "action", where)
    return {
        "frames": images,
        "actions": actions.astype(np.float32),
        "rewards": rewards,
        "terminated": _vector(episode, "terminations", where, steps).astype(bool),
        "truncated": _vector(episode, "truncations", where, steps).astype(bool),
    }


def episodes(dataset: MinariDataset) -> Iterator[dict[str, Any]]:
    """Raw Minari episodes; whatever a damaged file makes the readers raise becomes a DatasetError."""
    stored = iter(dataset.storage.get_episodes(dataset.episode_indices))
    while True:
        try:
            episode = next(stored)
        except StopIteration:
            return
        except minari_io.UNREADABLE as error:
            raise minari_io.damaged(dataset.id, f"an episode cannot be read ({type(error).__name__}: {error})") from error
        yield episode


def read_rows(dataset: MinariDataset, layout: ImageLayout, size: int | None) -> Rows:
    """All episodes in order, rewards as stored; arrays are made once from the counts in the dataset's metadata."""
    capacity = dataset.total_steps + dataset.total_episodes
    side, action_shape = layout.sides[0] if size is None else size, dataset.action_space.shape
    if side != layout.sides[0]:
        notice(f"{dataset.id}: images of {layout.sides[0]}×{layout.sides[1]} are resized to {side}×{side}.")
    rows = Rows(np.empty((capacity, side, side, 3), np.uint8), np.zeros((capacity, *action_shape), np.float32),
                np.zeros(capacity, np.float64), np.zeros(capacity, bool), np.zeros(capacity, bool), np.zeros(0, np.int64))
    lengths, start = [], 0
    for number, raw in enumerate(episodes(dataset)):
        episode = check_episode(raw, layout, action_shape, f"{dataset.id}, episode {number}")
        steps = len(episode["rewards"])
        if start + steps + 1 > capacity:
            raise minari_io.damaged(dataset.id, f"its metadata count {dataset.total_steps} transitions, its episodes hold "
                                                "more")
        rows.frames[start : start + steps + 1] = to_rgb(episode["frames"], layout, side)
        for name in ("actions", "rewards", "terminated", "truncated"):
            getattr(rows, name)[start : start + steps] = episode[name]
        lengths.append(steps)
        start += steps + 1
    return rows.head(start, np.asarray(lengths, np.int64))


def binarise(rows: Rows, dataset_id: str) -> Rows:
    """Rewards in {0, 1}; each episode ends at its first success, rows are moved down in place."""
    transition = np.ones(len(rows.rewards), bool)
    transition[rows.end()] = False
    ordinary, level = reward_levels(rows.rewards[transition], dataset_id)
    if (ordinary, level) != (0.0, 1.0):
        notice(f"{dataset_id}: reward {level:g} is read as success (1), {ordinary:g} as 0.")
    rows.rewards[:] = transition & (rows.rewards == level)
    lengths, source, target = rows.length.copy(), 0, 0
    for episode, steps in enumerate(rows.length):
        hits = np.flatnonzero(rows.rewards[source : source + steps])
        kept = int(hits[0]) + 1 if len(hits) else int(steps)
        for array in rows.arrays():
            if target != source:
                array[target : target + kept + 1] = array[source : source + kept + 1]
        last = target + kept
        for array in rows.arrays()[1:]:
            array[last] = 0
        if len(hits):
            rows.terminated[last - 1], rows.truncated[last - 1] = True, False
        lengths[episode], source, target = kept, source + steps + 1, last + 1
    cut = int((lengths < rows.length).sum())
    if cut:
        notice(f"{dataset_id}: {cut} episodes go on after their first success; what follows it is left out.")
    return rows.head(target, lengths)


def check_ends(rows: Rows, dataset_id: str) -> None:
    """DatasetError when a flag stands before an episode's last transition; episodes without a flag become truncated."""
    ends = rows.end()
    flags = rows.terminated | rows.truncated
    unfinished = ~flags[ends - 1]
    flags[ends - 1] = False
    if flags.any():
        row = int(np.argmax(flags))
        episode = int(np.searchsorted(ends, row))
        step = row - int(ends[episode] - rows.length[episode])
        kind = "termination" if rows.terminated[row] else "truncation"
        raise DatasetError(f"{dataset_id}, episode {episode}: a {kind} stands at step {step}, but the episode goes on to "
                           "step "
                           f"{rows.length[episode] - 1}; expected flags at the last step only. Split the episode there and "
                           "write "
                           "the dataset again.")
    if unfinished.any():
        notice(f"{dataset_id}: {unfinished.sum()} episodes end without a flag; they count as truncated.")
        rows.truncated[ends[unfinished] - 1] = True


def bound_actions(rows: Rows, low: np.ndarray, high: np.ndarray, dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """Finite bounds float32 [A]; actions beyond the stated ones are clipped in place, as environments do."""
    taken = np.ones(len(rows.actions), bool)
    taken[rows.end()] = False
    actions = rows.actions[taken]
    outside = int(((actions < low) | (actions > high)).any(axis=1).sum())
    if outside:
        notice(f"{dataset_id}: {outside} of {len(actions)} actions lie outside the action space; they are clipped to it.")
        rows.actions[taken] = np.clip(actions, low, high)
    if np.isfinite(low).all() and np.isfinite(high).all():
        return low, high
    low = np.where(np.isfinite(low), low, actions.min(axis=0))
    high = np.where(np.isfinite(high), high, actions.max(axis=0))
    if not np.all(low < high):
        raise DatasetError(f"{dataset_id} has an unbounded action entry that never varies ({low.tolist()} to "
                           f"{high.tolist()}); "
                           "expected low < high. State the bounds of the action space, or leave that entry out.")
    notice(f"{dataset_id}: the action space is unbounded; its bounds are taken from the data, {low.tolist()} to "
           f"{high.tolist()}.")
    return low, high
