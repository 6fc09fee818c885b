"""Learning on frozen latents: the cached data, and what BC, IQL and IRIS have in common.

F frames, D latent, A action dimension, T transitions, B rows of a batch.
"""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import Config
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler
from velap.errors import CheckpointError, ConfigError
from velap.losses import Info
from velap.models.checkpoint import shared_weights
from velap.models.velap import LatentModel
from velap.runs import load_tensors, make_generator, save_tensors
from velap.storage import locked
from velap.training.capture import adam, set_rate
from velap.training.encoding import encode_all, evaluated
from velap.training.loop import HOLDOUT_EPISODES, holdout_episodes
from velap.training.steps import cosine

LATENTS = "latents.safetensors"
"""Cached latents of the dataset, beside the joint checkpoint."""
LATENTS_FORMAT = "velap-latents/1"


@dataclass(frozen=True)
class LearnerConfig:
    """What every learner on frozen latents has. The defaults are the default preset's."""

    steps: int = 20_000
    """Updates at most. D.1 and D.3: 3·10⁵. ours: docs/experiments/2026-11-heads.md has the held-out curves."""
    batch: int = 256
    """Transitions a batch. D.1: 128; D.3: 256."""
    learning_rate: float = 1e-3
    """Adam. D.1 and D.3: 3·10⁻⁴."""
    cosine: bool = True
    """The learning rate falls to a hundredth along a cosine. ours; off in `paper`."""

    def __post_init__(self) -> None:
        self.require("steps", self.steps >= 1, "at least 1 update")
        self.require("batch", self.batch >= 2, "at least 2 transitions")
        self.require("learning_rate", self.learning_rate > 0, "a positive number")

    def require(self, name: str, holds: bool, expected: str) -> None:
        """Raises ConfigError for the field `name` unless `holds`."""
        if not holds:
            raise ConfigError(f"{type(self).__name__} field `{name}` is {getattr(self, name)!r}; expected {expected}. "
                              "Change that field and start again.")

    def length(self, transitions: int) -> int:
        """Updates of a training on so many transitions [steps]."""
        return self.steps

    def to_json(self) -> str:
        """Canonical JSON of all fields."""
        return json.dumps(asdict(self), sort_keys=True)


@dataclass(frozen=True)
class LatentData:
    """A dataset seen through a frozen encoder, on one device. Row i+1 follows row i within an episode."""

    latents: Tensor
    """float32 [F, D]."""
    actions: Tensor
    """float32 [F, A] in [-1, 1]."""
    rewards: Tensor
    """float32 [F] in {0, 1}."""
    terminated: Tensor
    """bool [F], the transition from this row ended the task."""
    last: Tensor
    """int64 [F], final row of the row's episode."""
    training: Tensor
    """int64 [T], rows of the transitions that are learnt from."""
    held_out: Tensor
    """int64 [*], rows of the transitions of the joint training's held-out episodes."""
    rewarded: Tensor
    """int64 [*], those of `training` with a reward."""
    success_training: Tensor
    """int64 [*], transitions of successful episodes (D*), some of those episodes held out."""
    success_held_out: Tensor
    """int64 [*], transitions of the successful episodes held out of D*."""
    discount: float
    """γ of the joint checkpoint."""
    dataset_id: str


def latent_data(model: LatentModel, config: Config, metadata: Mapping[str, str], store: FrameStore,
                folder: Path) -> LatentData:
    """Encode a store by a joint checkpoint, or take its latents from `folder`, where they are kept for the next learner.

    metadata: of the checkpoint; its seed decides which episodes are held out, as in the joint training.
    """
    seed, count = int(metadata.get("seed", 0)), HOLDOUT_EPISODES
    device = next(model.parameters()).device
    sampler = WindowSampler(store, config.train, config.model.frame_stack, device, holdout_episodes(store, count, seed))
    inside = np.arange(len(store.frames)) < store.last
    rows = np.flatnonzero(inside)
    of = store.episode_of[rows]
    kept_successes = holdout_episodes(store, count, seed, rewarded=True)
    succeeds = (np.bincount(store.episode_of, weights=store.rewards) > 0)[of]
    aside = np.isin(of, kept_successes)

    def put(array: np.ndarray) -> Tensor:
        return torch.from_numpy(array).to(device)

    held_out = torch.from_numpy(rows).to(device)
    return LatentData(
        latents=_cached_latents(model, sampler, {"joint": shared_weights(metadata), "dataset": store.content_hash}, folder),
        actions=sampler.actions,
        rewards=sampler.rewards,
        terminated=sampler.terminated,
        last=sampler.last,
        training=sampler.transitions,
        held_out=held_out[~torch.isin(held_out, sampler.transitions)],
        rewarded=sampler.rewarded,
        success_training=put(rows[succeeds & ~aside]),
        success_held_out=put(rows[succeeds & aside]),
        discount=config.train.discount,
        dataset_id=store.dataset_id,
    )


def _cached_latents(model: LatentModel, sampler: WindowSampler, identity: dict[str, str], folder: Path) -> Tensor:
    """float32 [F, D] latents of every frame; the file in `folder` counts only for the same weights and data."""
    path, expected = folder / LATENTS, {"format": LATENTS_FORMAT, **identity}
    with locked(folder / f".{LATENTS}.lock", wait=True):  # learners of other heads may want them now as well
        try:
            tensors, metadata = load_tensors(path)
            if all(metadata.get(key) == value for key, value in expected.items()):
                return tensors["latents"].to(sampler.device)
        except CheckpointError:
            pass  # a cache: missing or damaged, it is made anew
        latents = encode_all(model, sampler)
        save_tensors(path, {"latents": latents}, expected)
        return latents


ConfigT = TypeVar("ConfigT", bound=LearnerConfig)
HeadT = TypeVar("HeadT", bound=nn.Module)


class FrozenLearner(ABC, Generic[ConfigT, HeadT]):
    """Learns a head from cached latents: `update` draws a batch, takes the gradient of `loss` and lets the targets follow.

    What it saves: `model`, `companions` and `optimizers`.
    """

    def __init__(self, head: HeadT, data: LatentData, config: ConfigT, generator: torch.Generator) -> None:
        self.model, self.data, self.config, self.generator = head, data, config, generator
        self.updates = 0
        self.companions: dict[str, nn.Module] = {}
        self.optimizers = {"head": self._adam(head)}
        self.pool, self.held_out = data.training, data.held_out

    @property
    def total(self) -> int:
        """Updates of the whole training [steps]."""
        return self.config.length(len(self.pool))

    @abstractmethod
    def loss(self, rows: Tensor) -> tuple[Tensor, Info]:
        """Loss over transitions `rows` int64 [B], random numbers from `self.generator`."""

    def update(self) -> Info:
        """One update on a fresh batch."""
        self.schedule(self.updates / self.total)
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        loss, info = self.loss(self.draw())
        loss.backward()
        for optimizer in self.optimizers.values():
            optimizer.step()
        self.updates += 1
        self.follow()
        return info

    def draw(self) -> Tensor:
        """A batch of transition rows int64 [B], uniform with repetition."""
        return self.pool[self._integers(len(self.pool), self.config.batch)]

    def schedule(self, done: float) -> None:
        """Set the learning rates; `done` is the share of the updates behind us."""
        if self.config.cosine:
            self._set_rate("head", self.config.learning_rate * cosine(done))

    def follow(self) -> None:
        """Let the target networks follow; there are none unless a learner makes some."""

    @torch.no_grad()
    def report(self) -> dict[str, float]:
        """Losses on held-out episodes, the same random numbers each time."""
        if len(self.held_out) == 0:
            return {}
        drawing, self.generator = self.generator, make_generator(0, stream=9, device=self.held_out.device)
        try:
            with evaluated(self.model):
                _, info = self.loss(self.held_out)
        finally:
            self.generator = drawing
        return {f"held_out/{name}": float(value) for name, value in info.items()}

    def _adam(self, *modules: nn.Module) -> torch.optim.Optimizer:
        return adam([p for m in modules for p in m.parameters()], self.config.learning_rate)

    def _set_rate(self, name: str, learning_rate: float) -> None:
        set_rate(self.optimizers[name], learning_rate)

    def _integers(self, high: int, count: int) -> Tensor:
        """int64 [count] in [0, high)."""
        return torch.randint(high, (count,), generator=self.generator, device=self.generator.device)
