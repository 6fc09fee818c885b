"""Numbers beside the image, such as joint angles: where they lie in a stranger's observations. S entries of the state."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np

from velap.data.images import image_like, keys_of, leaves_of, listing
from velap.errors import DatasetError


@dataclass(frozen=True)
class StateLayout:
    """Keys of the numbers that are the state, one after the other."""

    keys: tuple[tuple[str, ...], ...]
    """Paths of keys into nested Dict observations."""
    size: int
    """S."""

    @property
    def names(self) -> list[str]:
        """The keys as the user writes them, `a/b`."""
        return ["/".join(key) for key in self.keys]

    def of(self, observation: Any) -> np.ndarray:
        """float32 [S] of one observation."""
        return self.joined(part[None] for part in self._parts(observation))[0]

    def of_episode(self, observations: Any) -> np.ndarray:
        """float32 [T+1, S] of the observations of an episode."""
        return self.joined(self._parts(observations))

    def _parts(self, observation: Any) -> Iterable[np.ndarray]:
        for key in self.keys:
            part = observation
            for name in key:
                part = part[name]
            yield np.asarray(part)

    @staticmethod
    def joined(parts: Iterable[np.ndarray]) -> np.ndarray:
        """float32 [T+1, S] of numbers [T+1, *] under each key."""
        return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1).astype(np.float32)


def find_state(space: gym.Space, state_key: str | None, where: str, size: int = 0) -> StateLayout | None:
    """The state of an observation space under the keys of `state_key`, `a,b`; None where that is empty.

    An environment may call it otherwise than the dataset did: with `size` S, its only vector of that size is taken where the
    keys are missing.

    Raises:
        DatasetError: the keys are missing or hold no numbers; the text lists those there are.
    """
    names = keys_of(state_key)
    if not names and not size:
        return None
    numbers = {"/".join(path): (path, leaf) for path, leaf in leaves_of(space).items()
               if isinstance(leaf, gym.spaces.Box) and not image_like(leaf)}
    same_size = [name for name, (_, leaf) in numbers.items() if int(np.prod(leaf.shape)) == size]
    if size and not (names and numbers.keys() >= set(names)) and len(same_size) == 1:
        names = same_size
    missing = [name for name in names if name not in numbers]
    if missing or not names:
        raise DatasetError(f"{where} has no numbers under the observation key {missing[0] if missing else ''!r}; "
                           f"expected {f'one vector of {size} numbers' if size else 'one of its vectors'}. It has "
                           f"{listing(leaves_of(space))}.")
    found = [numbers[name] for name in names]
    width = sum(int(np.prod(leaf.shape)) for _, leaf in found)
    if size and width != size:
        raise DatasetError(f"{where} has {width} numbers under {', '.join(names)}; expected {size}, as in the training "
                           "data. Evaluate the checkpoint on the environment that its data come from.")
    return StateLayout(tuple(path for path, _ in found), width)
