"""Small data on frozen latents, with known answers, and a small joint checkpoint, for the tests of the learners."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import torch

import tiny_training  # noqa: F401 - registers the tiny encoder
from velap.config import Config, ModelConfig
from velap.data.frames import FrameStore
from velap.models.checkpoint import load_checkpoint, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.training.frozen import LatentData

SMALL = ModelConfig(encoder="tiny", frame_stack=1, latent_dim=2, bank_size=4)


def corridor(length: int = 8, copies: int = 40, seed: int = 0) -> LatentData:
    """Walks on the points 0 … length - 1 of a line; entering the last one is rewarded and ends the task.

    A coin decides between the actions +1 (right) and -1 (left, or stay at the wall). z = (position / length, 1). So the
    return of always going right from position p is γ^(length - 2 - p).
    """
    rng = np.random.default_rng(seed)
    rows: list[tuple[float, float, float, bool, int]] = []
    for _ in range(copies):
        first, position = len(rows), int(rng.integers(length - 1))
        episode = []
        for _ in range(4 * length):
            action = rng.choice([-1.0, 1.0])
            following = max(position + int(action), 0)
            done = following == length - 1
            episode.append((position, action, float(done), done))
            position = following
            if done:
                break
        episode.append((position, 0.0, 0.0, False))
        rows += [(*row, first + len(episode) - 1) for row in episode]
    position, action, reward, ended, last = (np.array(column) for column in zip(*rows, strict=True))
    inside = torch.from_numpy(np.flatnonzero(np.arange(len(rows)) < last))
    rewards = torch.from_numpy(reward).float()
    empty = torch.zeros(0, dtype=torch.int64)
    return LatentData(
        latents=torch.from_numpy(np.stack([position / length, np.ones(len(rows))], 1)).float(),
        actions=torch.from_numpy(action).float()[:, None], rewards=rewards, terminated=torch.from_numpy(ended.astype(bool)),
        last=torch.from_numpy(last.astype(np.int64)), training=inside, held_out=inside[:20],
        rewarded=inside[rewards[inside] > 0], success_training=empty, success_held_out=empty, discount=0.9,
        dataset_id="test/corridor-v0")


def noise_store(episodes: int = 20, length: int = 6, successes: int = 2) -> FrameStore:
    """Random frames and actions in [-2, 2]; the first `successes` episodes end in a reward."""
    rng = np.random.default_rng(0)
    n = episodes * (length + 1)
    rewards, terminated, truncated = np.zeros(n, np.float32), np.zeros(n, bool), np.zeros(n, bool)
    ends = np.arange(length - 1, n, length + 1)
    rewards[ends[:successes]] = 1
    terminated[ends[:successes]] = True
    truncated[ends[successes:]] = True
    actions = rng.uniform(-2, 2, (n, 3)).astype(np.float32)
    actions[np.arange(length, n, length + 1)] = 0
    return FrameStore(
        frames=rng.integers(0, 255, (n, 16, 16, 3), dtype=np.uint8), actions=actions, rewards=rewards, terminated=terminated,
        truncated=truncated, episode_start=np.arange(episodes) * (length + 1), episode_length=np.full(episodes, length),
        action_low=np.full(3, -2, np.float32), action_high=np.full(3, 2, np.float32), dataset_id="test/noise-v0",
        content_hash=f"hash{successes}")


def joint_checkpoint(path: Path, store: FrameStore, seed: int = 0, preset: str = "default", norm: str = "layer") -> Path:
    """A joint checkpoint with random weights that says it was trained on `store`."""
    config = Config("test", preset, model=dataclasses.replace(SMALL, norm=norm))  # type: ignore[arg-type]
    torch.manual_seed(seed)
    model = LatentModel(config.model, Spaces(16, 16, (-2.0,) * 3, (2.0,) * 3), config.train.discount)
    save_checkpoint(path, model, config, {"seed": str(seed), "dataset_hash": store.content_hash})
    return path


def metadata_of(checkpoint: Path) -> dict[str, str]:
    """Metadata of a joint checkpoint."""
    return load_checkpoint(checkpoint)[2]
