"""A training of milliseconds: noise of 16 × 16 pixels, a small encoder of the tests' own, a few updates of every phase."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import Config, JointPhase, LatentPhase, ModelConfig, TrainConfig, override
from velap.data.frames import FrameStore
from velap.models.encoders.base import Encoder
from velap.models.networks import LEAK, MLP
from velap.registry import ENCODERS, register_encoder
from velap.training.loop import Trainer

if "tiny" not in ENCODERS:

    @register_encoder("tiny")
    class TinyEncoder(Encoder):
        """Two convolutions and a dense layer, in single precision: frames need only 10 pixels."""

        def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
            super().__init__()
            layers: list[nn.Module] = []
            channels, sides = 3 * config.frame_stack, list(size)
            for _ in range(2):
                layers.append(nn.Conv2d(channels, 4, 4, 2))
                layers += [nn.BatchNorm2d(4)] if config.norm == "batch" else []
                layers.append(nn.LeakyReLU(LEAK))
                channels, sides = 4, [(side - 4) // 2 + 1 for side in sides]
            self.convolutions = nn.Sequential(*layers)
            self.dense = MLP(4 * sides[0] * sides[1], (8,), config.latent_dim, config.norm)

        def encode(self, stacks: Tensor) -> Tensor:
            """uint8 [M, N, H, W, 3] -> [M, D]."""
            m, n, h, w, c = stacks.shape
            images = stacks.permute(0, 1, 4, 2, 3).reshape(m, n * c, h, w).float() / 127.5 - 1
            return self.dense(self.convolutions(images).flatten(1))


SMALL = ModelConfig(encoder="tiny", frame_stack=2, latent_dim=4, bank_size=10)
QUICK = TrainConfig(phases=(JointPhase(6, windows=3, window=5), LatentPhase(6, horizon=3)), checkpoint_every=2, log_every=2)
FRAMES = torch.zeros(1, 2, 16, 16, 3, dtype=torch.uint8)


def make_store(episodes: int = 12, length: int = 6) -> FrameStore:
    """Noise; the first two episodes end in a success."""
    rng = np.random.default_rng(0)
    n = episodes * (length + 1)
    rewards, terminated, truncated = np.zeros(n, np.float32), np.zeros(n, bool), np.zeros(n, bool)
    ends = np.arange(length - 1, n, length + 1)
    rewards[ends[:2]] = 1
    terminated[ends[:2]] = True
    truncated[ends[2:]] = True
    return FrameStore(
        frames=rng.integers(0, 255, (n, 16, 16, 3), dtype=np.uint8),
        actions=rng.uniform(-2, 2, (n, 3)).astype(np.float32),
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
        episode_start=np.arange(episodes) * (length + 1),
        episode_length=np.full(episodes, length),
        action_low=np.full(3, -2, np.float32),
        action_high=np.full(3, 2, np.float32),
        dataset_id="test/noise-v0",
        content_hash="abc",
    )


def config(model: ModelConfig = SMALL, **train: Any) -> Config:
    """`QUICK` with fields replaced, phases by their labels: `config(joint={"steps": 2}, c3=0.5)`."""
    return override(Config("test", "default", model=model, train=QUICK), train=train)


def trainer(path: Path, norm: str = "layer", **train: Any) -> Trainer:
    """A run of `config`."""
    return make(path, config(dataclasses.replace(SMALL, norm=norm), **train))  # type: ignore[arg-type]


def make(path: Path, settings: Config, seed: int = 0) -> Trainer:
    """A run of a config on `make_store`."""
    return Trainer(settings, make_store(), path, seed, torch.device("cpu"))


def until(run: Trainer, label: str) -> Any:
    """Update until the first update of a phase is done; its learner."""
    while run.learner is None or run.learner.phase.label != label:
        run.update()
    return run.learner


def to_end(run: Trainer) -> Trainer:
    """Update to the end."""
    while run.step < run.total:
        run.update()
    return run


def straight_and_resumed(path: Path, settings: Config, stop: int) -> tuple[Trainer, Trainer]:
    """A run to its end, and one that is saved after `stop` updates and resumed; their weights have the same bits."""
    straight, broken, again = (make(path / name, settings) for name in ("straight", "broken", "broken"))
    to_end(straight)
    for _ in range(stop):
        broken.update()
    broken.run_dir.mkdir(parents=True, exist_ok=True)
    broken.save()
    again.resume()
    assert again.step == stop
    to_end(again)
    expected = straight.model.state_dict()
    assert [name for name, value in again.model.state_dict().items() if not torch.equal(value, expected[name])] == []
    return straight, again


def weights(module: nn.Module) -> dict[str, Tensor]:
    """A copy of what a module holds."""
    return {name: value.clone() for name, value in module.state_dict().items()}


def moved(before: dict[str, Tensor], module: nn.Module) -> set[str]:
    """Parts of a module, by the first word of their names, that changed."""
    after = module.state_dict()
    return {name.split(".")[0] for name, value in before.items() if not torch.equal(value, after[name])}


def touched(module: nn.Module) -> bool:
    """Some parameter has a gradient."""
    return any(p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters())
