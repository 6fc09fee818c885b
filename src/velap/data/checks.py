"""What a stranger's episodes must look like; each error says the way out. T transitions of one episode, A action entries."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium as gym
import numpy as np

from velap.data.frames import Episode
from velap.data.images import ImageLayout
from velap.errors import DatasetError


def notice(text: str) -> None:
    """Tell the user about a harmless change that is made to the data while reading."""
    warnings.warn(text, UserWarning, stacklevel=4)


def action_bounds(space: gym.Space, dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """float32 [A] lower and upper bounds, infinite where the dataset names none."""
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1 or not np.issubdtype(space.dtype, np.floating):
        raise DatasetError(f"{dataset_id} has the action space {str(space)[:200]}; expected a Box of floats with one axis. "
                           "The policies here are continuous: discrete or nested actions need another method.")
    low, high = space.low.astype(np.float32), space.high.astype(np.float32)
    if not np.all(low < high):
        raise DatasetError(f"{dataset_id} has action bounds {low.tolist()} to {high.tolist()}; expected low < high in every "
                           "entry. Leave constant entries out of the action and write the dataset again.")
    return low, high


def _vector(values: Any, name: str, where: str, length: int | None = None) -> np.ndarray:
    values = np.asarray(values)
    if values.ndim == 2 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != 1 or values.dtype.kind not in "fiub" or (length is not None and len(values) != length):
        expected = "one number a transition" if length is None else f"{length} of them, one a transition"
        raise DatasetError(f"{where}: {name} are {values.dtype} of shape {values.shape}; expected {expected}. "
                           "Write that episode again.")
    return values


def _require_finite(values: np.ndarray, name: str, where: str) -> None:
    finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not finite.all():
        step = int(np.argmin(finite))
        raise DatasetError(f"{where}: the {name} of step {step} is {values[step].tolist()}; expected finite numbers. "
                           "Repair the value or drop that episode, and write the dataset again.")


def _require_bounds(images: np.ndarray, layout: ImageLayout, where: str) -> None:
    """Raise DatasetError unless float images [T + 1, *] lie within their bounds, and exceed 1 where the upper one is 255."""
    low, high = layout.bounds
    found = float(images.min()), float(images.max())
    if not (low - 0.01 <= found[0] and found[1] <= high + 0.01):
        raise DatasetError(f"{where}: the images have values from {found[0]:g} to {found[1]:g}; expected {low:g} to "
                           f"{high:g}, the bounds of their space. State the right bounds, and write the dataset again.")
    if high == 255 and found[1] <= 1:
        raise DatasetError(f"{where}: the images have values up to {found[1]:g}; expected values up to 255, the upper "
                           "bound of their space. State 1 as the bound, and write the dataset again.")


def checked_episode(episode: Episode, layout: ImageLayout, action_shape: tuple[int, ...], where: str) -> Episode:
    """The episode as arrays, shapes agreeing and values finite, missing rewards and flags filled in."""
    images, actions = np.asarray(episode.images), np.asarray(episode.actions)
    if episode.rewards is None:
        rewards = np.zeros(len(actions), np.float64)
    else:
        rewards = _vector(episode.rewards, "rewards", where).astype(np.float64)
    steps = len(rewards)
    if steps == 0:
        raise DatasetError(f"{where} has no transition; expected at least one. Leave empty episodes out of the dataset.")
    _require_finite(rewards, "reward", where)
    if images.shape != (steps + 1, *layout.shape) or images.dtype != layout.dtype:
        raise DatasetError(f"{where}: the images are {images.dtype} of shape {images.shape}; expected {layout.dtype} "
                           f"of shape {(steps + 1, *layout.shape)}, one more than the {steps} rewards. Write that "
                           "episode again, its last observation included.")
    if images.dtype != np.uint8:
        _require_bounds(images, layout, where)
    if actions.shape != (steps, *action_shape):
        raise DatasetError(f"{where}: the actions have shape {actions.shape}; expected {(steps, *action_shape)}, one a "
                           "transition. Write that episode again.")
    _require_finite(actions, "action", where)
    terminated = np.zeros(steps, bool)
    if episode.terminated is not None:
        terminated = _vector(episode.terminated, "terminations", where, steps).astype(bool)
    truncated = np.arange(steps) == steps - 1
    if episode.truncated is not None:
        truncated = _vector(episode.truncated, "truncations", where, steps).astype(bool)
    elif terminated[-1]:
        truncated[-1] = False
    state = None if episode.state is None else np.asarray(episode.state)
    if state is not None:
        if state.ndim != 2 or len(state) != steps + 1 or state.dtype.kind not in "fiub":
            raise DatasetError(f"{where}: the state is {state.dtype} of shape {state.shape}; expected numbers of shape "
                               f"[{steps + 1}, S], one row an image. Write that episode again.")
        _require_finite(state, "state", where)
        state = state.astype(np.float32)
    return Episode(images, actions.astype(np.float32), rewards, terminated, truncated, episode.infos, state)


def level_rule(rewards: np.ndarray, dataset_id: str, infos: list[str]) -> float:
    """The reward that is success: the higher of the two that a sparse reward has; DatasetError for any other kind.

    rewards: float [transitions of all episodes]; infos: names that a success rule could use.
    """
    levels = np.unique(rewards)
    others = [f"--success info:{name}" for name in infos]
    ways = f"Say what success is: {', '.join([*others, '--success terminated, --success labels:FILE.csv'])}"
    if levels.size == 1:
        raise DatasetError(f"every reward of {dataset_id} is {levels[0]:g}; expected two values, of which the higher "
                           f"one marks the transitions that solve the task. {ways}; or record some successes.")
    if levels.size > 2:
        named = f"; its infos hold {', '.join(infos)}" if infos else ""
        raise DatasetError(f"{dataset_id} has {levels.size} different rewards, from {levels[0]:g} to {levels[-1]:g}{named}; "
                           f"expected a sparse reward of two values. {ways}, or --success 'reward>={levels[-1]:g}' "
                           "where that reward or more is success.")
    return float(levels[1])


def check_ends(terminated: np.ndarray, truncated: np.ndarray, length: np.ndarray, dataset_id: str) -> None:
    """DatasetError when a flag stands before an episode's last transition; episodes without a flag become truncated.

    bool [F], changed in place; length int64 [E].
    """
    ends = np.cumsum(length + 1) - 1
    flags = terminated | truncated
    unfinished = ~flags[ends - 1]
    flags[ends - 1] = False
    if flags.any():
        row = int(np.argmax(flags))
        episode = int(np.searchsorted(ends, row))
        step = row - int(ends[episode] - length[episode])
        kind = "termination" if terminated[row] else "truncation"
        raise DatasetError(f"{dataset_id}, episode {episode}: a {kind} stands at step {step}, but the episode goes on to "
                           f"step {length[episode] - 1}; expected flags at the last step only. Split the episode there and "
                           "write the dataset again.")
    if unfinished.any():
        notice(f"{dataset_id}: {unfinished.sum()} episodes end without a flag; they count as truncated.")
        truncated[ends[unfinished] - 1] = True


def bounded_actions(actions: np.ndarray, length: np.ndarray, low: np.ndarray, high: np.ndarray,
                    dataset_id: str) -> tuple[np.ndarray, np.ndarray]:
    """Finite bounds float32 [A]; actions float32 [F, A] beyond the stated ones are clipped in place, as environments do."""
    taken = np.ones(len(actions), bool)
    taken[np.cumsum(length + 1) - 1] = False
    outside = int((((actions < low) | (actions > high)).any(axis=1) & taken).sum())
    if outside:
        notice(f"{dataset_id}: {outside} of {taken.sum()} actions lie outside the action space; they are clipped to it.")
        actions[taken] = np.clip(actions[taken], low, high)
    if np.isfinite(low).all() and np.isfinite(high).all():
        return low, high
    low = np.where(np.isfinite(low), low, actions[taken].min(axis=0))
    high = np.where(np.isfinite(high), high, actions[taken].max(axis=0))
    if not np.all(low < high):
        raise DatasetError(f"{dataset_id} has an unbounded action entry that never varies ({low.tolist()} to "
                           f"{high.tolist()}); expected low < high. State the bounds of the action space, or leave "
                           "that entry out.")
    notice(f"{dataset_id}: the action space is unbounded; its bounds are taken from the data, {low.tolist()} to "
           f"{high.tolist()}.")
    return low, high
