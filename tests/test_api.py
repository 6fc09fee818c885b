"""The Python interface with objects: a typed config, frames from memory, loggers, an agent of one's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import velap
from tiny_training import QUICK, SMALL, make_store
from velap.errors import ConfigError


class Circle:
    """Pushes a block around, and remembers what it was shown."""

    method = "circle"
    frame_stack = 2

    def __init__(self) -> None:
        self.last_plan_ms = np.full(3, np.nan)
        self.seeds: list[int] = []

    def reset(self, mask: NDArray[np.bool_], seeds: NDArray[np.int64] | None = None) -> None:
        assert seeds is not None
        self.seeds += seeds[mask].tolist()
        self.last_plan_ms = np.full(len(mask), np.nan)

    def act(self, frames: NDArray[np.uint8]) -> NDArray[np.float32]:
        assert frames.shape[1:] == (2, 64, 64, 3)
        return np.full((len(frames), 2), 0.5, np.float32)


def tiny_config() -> velap.Config:
    return velap.Config("toy", "default", model=SMALL, train=QUICK)


def train(**options: Any) -> Path:
    return velap.train(tiny_config(), make_store(), seed=3, device="cpu", **options)


def test_a_typed_config_trains_on_frames_in_memory(tmp_path: Path) -> None:
    checkpoint = train(out=tmp_path / "run", loggers=["jsonl"])
    assert {path.name for path in (tmp_path / "run").iterdir()} >= {"model.safetensors", "metrics.jsonl", "config.json"}
    assert not list((tmp_path / "run").rglob("*tfevents*"))
    saved = json.loads((tmp_path / "run" / "config.json").read_text())
    assert saved["model"]["latent_dim"] == 4
    agent = velap.load(checkpoint, "td3bc", device="cpu")
    assert agent.frame_stack == 2
    assert np.isfinite(agent.act(np.zeros((1, 2, 16, 16, 3), np.uint8))).all()


def test_a_logger_of_ones_own_hears_of_every_phase(tmp_path: Path) -> None:
    class Heard:
        def __init__(self) -> None:
            self.names: set[str] = set()
            self.closed = False

        def log(self, step: int, phase: str, seconds: float, values: dict[str, float]) -> None:
            self.names |= set(values)

        def close(self) -> None:
            self.closed = True

    heard = Heard()
    train(out=tmp_path / "run", loggers=[heard])
    assert heard.closed
    assert {"global/loss", "dynamics/loss"} <= heard.names
    assert not (tmp_path / "run" / "metrics.jsonl").exists()


def test_a_config_without_data_and_data_without_a_config_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="got a config and no data"):
        velap.train(tiny_config(), out=tmp_path)
    with pytest.raises(ConfigError, match="a config first"):
        velap.train("SpiralMaze", make_store(), out=tmp_path)
    with pytest.raises(ConfigError, match="got a FrameStore and image_key"):
        velap.train(tiny_config(), make_store(), out=tmp_path, image_key="camera")


def test_any_agent_is_evaluated_on_a_task() -> None:
    agent = Circle()
    summary = velap.evaluate(agent, env="SpiralMaze", episodes=3, first_seed=1000, max_steps=4, batch=2)
    assert (summary.method, summary.episodes, summary.successes, summary.mean_steps) == ("circle", 3, 0, 4.0)
    assert sorted(agent.seeds) == [1000, 1001, 1002]
    with pytest.raises(ConfigError, match="got an agent and no environment"):
        velap.evaluate(agent, episodes=1)


def test_every_public_name_loads() -> None:
    assert all(getattr(velap, name) is not None for name in velap.__all__)
