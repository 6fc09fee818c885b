"""`velap bench`: ratios, verdicts, the JSON file, and the pieces that the benchmarks measure with."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from studies.speed import benchmarks, command
from studies.speed.benchmarks import Measurement, in_turns, peak_memory, synthetic_store
from studies.speed.command import BENCHMARKS, Benchmark, run_benchmarks
from velap.config import Config, EncoderPhase, JointPhase, override
from velap.data.frames import content_hash
from velap.data.loading import load_store
from velap.data.writing import write_dataset
from velap.envs.gl import BACKENDS
from velap.errors import ConfigError
from velap.methods.mppi import MPPIConfig
from velap.tasks import make_config

CPU = torch.device("cpu")
KEYS = ["name", "value", "unit", "reference_name", "reference_value", "ratio", "machine"]


@pytest.fixture
def console() -> Console:
    return Console(record=True, width=200)


@pytest.fixture
def two(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two benchmarks that measure nothing."""
    monkeypatch.setattr(command, "BENCHMARKS", {
        "fast": Benchmark(lambda device: Measurement(30.0, "steps/s", "the other one", 10.0), at_least=10),
        "slow": Benchmark(lambda device: Measurement(1.0, "ms", "the other one", 64.0), at_most=1 / 50),
    })


@pytest.mark.usefixtures("two")
def test_rows_are_printed_and_written(tmp_path: Path, console: Console) -> None:
    rows = run_benchmarks(console, tmp_path / "bench" / "cpu.json", "cpu")
    assert json.loads((tmp_path / "bench" / "cpu.json").read_text()) == rows
    assert [list(row) for row in rows] == [KEYS, KEYS]
    assert [row["ratio"] for row in rows] == [3.0, 1 / 64]
    text = console.export_text()
    assert "1/64" in text
    assert "≥ 10: no" in text
    assert "≤ 0.02: yes" in text


@pytest.mark.usefixtures("two")
def test_measuring_one_keeps_the_rows_of_the_others(
    tmp_path: Path, console: Console, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "cpu.json"
    run_benchmarks(console, path, "cpu")
    monkeypatch.setitem(command.BENCHMARKS, "slow", Benchmark(lambda device: Measurement(2.0, "ms", "the other one", 64.0)))
    run_benchmarks(console, path, "cpu", only=["slow"])
    assert [(row["name"], row["value"]) for row in json.loads(path.read_text())] == [("fast", 30.0), ("slow", 2.0)]
    path.write_text("[1]")
    with pytest.raises(ConfigError, match="does not hold the rows"):
        run_benchmarks(console, path, "cpu", only=["slow"])
    assert path.read_text() == "[1]"


def test_unknown_names_are_refused_and_nothing_is_measured(console: Console) -> None:
    with pytest.raises(ConfigError, match="unknown benchmark speed; expected some of train_frames_per_s"):
        run_benchmarks(console, None, "cpu", only=["speed"])


@pytest.mark.parametrize(("ratio", "bounds", "verdict"), [
    (0.8, {"at_least": 0.8}, "≥ 0.8: yes"), (0.79, {"at_least": 0.8}, "≥ 0.8: no"), (0.5, {"at_most": 0.02}, "≤ 0.02: no"),
    (None, {"at_least": 10}, "-"), (3.0, {}, "-"),
])
def test_verdicts(ratio: float | None, bounds: dict[str, float], verdict: str) -> None:
    assert Benchmark(lambda device: Measurement(1.0, "s", "x", None), **bounds).verdict(ratio) == verdict


def test_a_reference_that_cannot_run_gives_no_ratio() -> None:
    assert Measurement(5.0, "steps/s", "absent", None).ratio is None
    assert Measurement(5.0, "steps/s", "there", 2.0).ratio == 2.5


def test_sides_take_turns_and_the_first_round_does_not_count(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, calls = [0.0], list[str]()
    monkeypatch.setattr(benchmarks.time, "perf_counter", lambda: clock[0])

    def quick() -> None:
        calls.append("quick")
        clock[0] += 60 if len(calls) == 1 else 1

    def slow() -> None:
        calls.append("slow")
        clock[0] += 10

    assert in_turns([quick, slow], 3, CPU) == [1, 10]
    assert calls == ["quick", "slow"] * 4


def test_the_synthetic_store_has_the_shape_of_the_recipe_and_survives_a_round_trip(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    store = synthetic_store(41)
    assert store.frames.shape == (41 * 21, 64, 64, 3)
    assert store.n_transitions == 41 * 20
    assert np.flatnonzero(store.rewards).tolist() == [19, 40 * 21 + 19]
    assert store.terminated.sum() + store.truncated.sum() == 41
    write_dataset(store)
    assert load_store(benchmarks.DATASET).content_hash == content_hash(store)


def test_the_minutes_of_a_training_are_updates_over_the_rate_of_their_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [0.0]
    monkeypatch.setattr(benchmarks.time, "perf_counter", lambda: clock[0])

    class Run:
        """An update of the encoder phase takes 0.1 s, one of the joint phase 0.4 s, the first of each a minute more."""

        device = CPU
        phases = (EncoderPhase(600), JointPhase(300))

        def __init__(self) -> None:
            self.finished, self.done, self.begun = 0, 0, set[int]()

        def update(self) -> None:
            clock[0] += (0.1, 0.4)[self.finished] + 60 * (self.finished not in self.begun)
            self.begun.add(self.finished)
            self.done += 1
            if self.done == self.phases[self.finished].steps:
                self.finished, self.done = self.finished + 1, 0

    assert benchmarks.training_minutes(Run(), most=3.0) == pytest.approx((600 * 0.1 + 300 * 0.4) / 60)


def test_plan_latency_is_per_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    def small(task: str, preset: str = "default") -> Config:
        return override(make_config(task, preset), planner={"n_iter": 10, "candidates": 5})

    monkeypatch.setattr(benchmarks, "make_config", small)
    monkeypatch.setattr(benchmarks, "MPPIConfig", lambda: MPPIConfig(samples=8, horizon=2, elites=4, iterations=1))
    result = benchmarks.plan_latency(CPU, 64, 2)
    assert result.unit == "ms/environment"
    assert "8 of the 64 environments at once; VELAP 10 expansions of 5 steps; released" in result.reference_name
    assert result.value > 0
    assert result.reference_value is not None


def test_environment_steps_are_compared_with_metaworlds(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step of Meta-World's takes 10 ms; our own are measured in processor time, which other processes do not slow."""
    clock, used = [0.0], time.process_time
    monkeypatch.setattr(benchmarks.time, "perf_counter", lambda: clock[0] + used())

    def wait(steps: int) -> None:
        clock[0] += 0.01 * steps

    @contextmanager
    def slow_world(backend: str) -> Iterator[Callable[[int], object]]:
        assert backend in BACKENDS
        yield wait

    monkeypatch.setattr(benchmarks, "meta_world", slow_world)
    result = benchmarks.env_steps_per_s(CPU, "WindowClose")
    assert result.reference_value == pytest.approx(100, rel=0.1)
    assert result.value > 1
    assert result.reference_name.startswith("Meta-World's window-close-v3, step + render(64 × 64)")


def test_datasets_of_a_benchmark_lie_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    for before in (None, "mine"):
        monkeypatch.delenv("MINARI_DATASETS_PATH", raising=False)
        if before is not None:
            monkeypatch.setenv("MINARI_DATASETS_PATH", before)
        with benchmarks._datasets_in("elsewhere"):
            assert os.environ["MINARI_DATASETS_PATH"] == "elsewhere"
        assert os.environ.get("MINARI_DATASETS_PATH") == before


def test_peak_memory_is_this_process_alone() -> None:
    before = peak_memory()
    block = np.ones(60_000_000, np.uint8)
    assert 100e6 < before < 50e9
    assert peak_memory() >= before
    assert block[0] == 1


def test_the_acceptance_bounds() -> None:
    assert {name: (entry.at_least, entry.at_most) for name, entry in BENCHMARKS.items()} == {
        "train_frames_per_s": (0.8, None), "train_frames_per_s_stack3": (0.8, None), "train_minutes": (None, None),
        "plan_latency_1": (None, 1 / 50),
        "plan_latency_1_sim10": (None, 1 / 50), "plan_latency_64": (None, 1 / 50),
        "env_steps_per_s": (10, None), "sawyer_env_steps_per_s": (10, None), "collect_frames_per_s": (1, None),
        "train_rss": (None, 1)}
