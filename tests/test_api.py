"""The Python interface with objects: a typed config, frames from memory, loggers, an agent of one's own."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from numpy.typing import NDArray

import velap
from tiny_training import QUICK, SMALL, make_store
from velap.data.frames import Reading
from velap.errors import ConfigError, DatasetError


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


def solved(reward: float, info: Any, terminated: bool) -> bool:
    """A rule of a user: at once."""
    return True


def test_a_rule_and_an_environment_may_be_functions(tmp_path: Path) -> None:
    def make(size: int = 64) -> gym.Env[Any, Any]:
        return gym.make("velap.envs:velap/SpiralMaze-v0", disable_env_checker=size == 64)

    summary = velap.evaluate(Circle(), env=make, env_kwargs={"size": 64}, episodes=2, max_steps=4, success=solved)
    assert (summary.task, summary.successes, summary.mean_steps) == ("make", 2, 1.0)
    env = make()
    with pytest.raises(ConfigError, match="a function that makes a new environment at each call"):
        velap.evaluate(Circle(), env=env, episodes=1)  # type: ignore[arg-type]  # it is the mistake
    with pytest.raises(ConfigError, match="records to write; expected a Gymnasium id"):
        velap.evaluate("mine", tmp_path / "model.safetensors", env=make)


def test_a_checkpoint_is_its_run_directory_and_data_may_be_a_path(tmp_path: Path) -> None:
    run = train(out=tmp_path / "run", loggers=[]).parent
    frames = np.random.default_rng(0).integers(0, 256, (1, 2, 16, 16, 3), np.uint8)
    expected = velap.load(run / "model.safetensors", "td3bc", device="cpu").act(frames)
    np.testing.assert_array_equal(velap.load(run, "td3bc", device="cpu").act(frames), expected)
    velap.train(tiny_config(), make_store(), seed=3, device="cpu", out=run, method="bc", loggers=[],
                changes={"head": {"steps": 2}})
    assert velap.load(run, "bc", device="cpu").act(frames).shape == (1, 3), "its head lies beside it"
    with pytest.raises(DatasetError, match="nowhere"):
        velap.train(tmp_path / "nowhere.npz")


def test_a_head_learns_from_the_data_of_its_joint_checkpoint(tmp_path: Path) -> None:
    train(out=tmp_path, loggers=[])
    other = dataclasses.replace(make_store(), content_hash="def", reading=Reading(success="reward>=0.5"))
    with pytest.raises(ConfigError, match=r"learnt from the data abc, .*the data are def now, read by .*reward>=0.5"):
        velap.train(tiny_config(), other, seed=3, device="cpu", out=tmp_path, method="bc")


@pytest.mark.parametrize("changes", [{"planner.n_iter": 3}, {"planner": 3}])
def test_changes_of_another_form_show_the_right_one(changes: Any, tmp_path: Path) -> None:
    for call in (lambda: velap.train("SpiralMaze", changes=changes),
                 lambda: velap.load(train(out=tmp_path, loggers=[]), changes=changes)):
        with pytest.raises(ConfigError, match=r"such as \{'planner': \{'n_iter': 500\}\}"):
            call()


def test_every_public_name_loads() -> None:
    assert all(getattr(velap, name) is not None for name in velap.__all__)
