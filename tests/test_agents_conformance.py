"""Conformance over the registry: every method, from a checkpoint and a head on disk, obeys the `Agent` protocol."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

import tiny_training  # noqa: F401 - registers the tiny encoder
from velap import api
from velap.config import Config, override
from velap.errors import CheckpointError, ConfigError, UnknownTaskError
from velap.methods.base import Agent, get_method, learning_methods, make_agent
from velap.methods.heads import Head, load_head, make_head, save_head
from velap.methods.iris import SubgoalHead
from velap.models.checkpoint import load_checkpoint, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.registry import METHODS

LOW, HIGH = np.array([-1.0, 0.0, 2.0], np.float32), np.array([1.0, 4.0, 2.5], np.float32)
ACTIONS = gym.spaces.Box(LOW, HIGH)
SIDE, STACK = 16, 2
QUICK: dict[str, dict[str, Any]] = {
    "mppi": {"samples": 24, "horizon": 6, "elites": 4, "iterations": 2, "replan_every": 3},
    "mbop": {"samples": 24, "horizon": 6, "elites": 4, "iterations": 2, "replan_every": 3},
    "iris": {"samples": 8},
    "iris-multistep": {"samples": 8, "rollout": 3},
}
WHOLE = ("velap",)
"""Methods that act by the whole checkpoint."""
HORIZON = 3
"""How far ahead the subgoals of the test's heads lie [steps]."""


def small_config() -> Config:
    model = {"encoder": "tiny", "frame_stack": STACK, "latent_dim": 5, "bank_size": 8}
    base = Config(task="toy", preset="default")
    return override(base, model=model, controller={"n_replan": 4},
                    planner={"n_iter": 12, "candidates": 4, "n_sim": 2, "discard_low_exponent": 1e4,
                             "discard_high_exponent": 1e-6})


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A joint checkpoint of random weights with the head of every method beside it."""
    path = tmp_path_factory.mktemp("run") / "model.safetensors"
    config = small_config()
    torch.manual_seed(0)
    model = LatentModel(config.model, Spaces(SIDE, SIDE, tuple(LOW.tolist()), tuple(HIGH.tolist())), 0.96)
    model.step_distance.fill_(0.5)
    model.bank_latents.normal_()
    model.bank_rows.copy_(torch.arange(8))
    save_checkpoint(path, model, config, {"seed": "3"})
    _, _, metadata = load_checkpoint(path)
    for method in learning_methods():
        head = make_head(method, config.model, 3)
        if isinstance(head, SubgoalHead):
            head.steps_ahead.fill_(HORIZON)
        save_head(path.with_name(f"{method}.safetensors"), head, metadata, {"seed": "3"})
    return path


def head_of(checkpoint: Path, method: str) -> Head | None:
    _, _, metadata = load_checkpoint(checkpoint)
    return load_head(checkpoint.with_name(f"{method}.safetensors"), metadata) if get_method(method).learns else None


def build(checkpoint: Path, method: str) -> Agent:
    model, config, _ = load_checkpoint(checkpoint)
    settings = get_method(method).settings_of("default", QUICK.get(method))
    return make_agent(method, model, config, ACTIONS, head_of(checkpoint, method), settings)


def frames_of(batch: int, first: int = 0, time: int = 0) -> np.ndarray:
    """[batch, STACK, SIDE, SIDE, 3]: row i is picture `first + i` of a film at `time`."""
    pictures = [np.random.default_rng((first + row, time)).integers(0, 256, (STACK, SIDE, SIDE, 3), np.uint8)
                for row in range(batch)]
    return np.stack(pictures)


def play(agent: Agent, batch: int, steps: int = 7, first: int = 0) -> np.ndarray:
    """Actions [steps, batch, A] over a film, without a reset."""
    return np.stack([agent.act(frames_of(batch, first, time)) for time in range(steps)])


every_method = pytest.mark.parametrize("method", METHODS)


@every_method
@pytest.mark.parametrize("batch", [1, 7])
def test_actions_are_in_the_box_and_the_same_under_the_same_seeds(checkpoint: Path, method: str, batch: int) -> None:
    agent = build(checkpoint, method)
    assert (agent.method, agent.frame_stack) == (method, STACK)
    seeds = np.arange(batch) + 5
    agent.reset(np.ones(batch, bool), seeds)
    first = play(agent, batch)
    assert first.shape == (7, batch, 3)
    assert first.dtype == np.float32
    assert (first >= LOW - 1e-6).all() and (first <= HIGH + 1e-6).all()
    assert agent.last_plan_ms.shape == (batch,)
    agent.reset(np.ones(batch, bool), seeds)
    np.testing.assert_array_equal(play(agent, batch), first)
    np.testing.assert_array_equal(play(_reset(build(checkpoint, method), seeds), batch), first)


def _reset(agent: Agent, seeds: np.ndarray) -> Agent:
    agent.reset(np.ones(len(seeds), bool), seeds)
    return agent


@pytest.mark.parametrize("method", ["mppi", "mbop", "iris", "iris-multistep", "random"])
def test_other_seeds_give_other_actions(checkpoint: Path, method: str) -> None:
    one, other = (play(_reset(build(checkpoint, method), np.array([seed])), 1) for seed in (1, 2))
    assert np.abs(one - other).max() > 1e-4


@every_method
def test_reset_of_some_rows_starts_them_anew_and_leaves_the_others(checkpoint: Path, method: str) -> None:
    some = np.array([False, True, False, False, True, False, False])
    seeds = np.arange(7)
    agent, untouched = (_reset(build(checkpoint, method), seeds) for _ in range(2))
    play(agent, 7, steps=2)
    play(untouched, 7, steps=2)
    agent.reset(some, np.where(some, 20 + seeds, 99))
    after, unbroken = play(agent, 7), play(untouched, 7)
    np.testing.assert_allclose(after[:, ~some], unbroken[:, ~some], rtol=1e-4, atol=1e-5)
    new = play(_reset(build(checkpoint, method), np.where(some, 20 + seeds, 99)), 7)
    np.testing.assert_allclose(after[:, some], new[:, some], rtol=1e-4, atol=1e-5)


@every_method
def test_a_row_does_not_depend_on_the_batch_it_is_in(checkpoint: Path, method: str) -> None:
    together = play(_reset(build(checkpoint, method), np.arange(7) + 40), 7)
    for row in (0, 3, 6):
        alone = play(_reset(build(checkpoint, method), np.array([40 + row])), 1, first=row)
        np.testing.assert_allclose(alone[:, 0], together[:, row], rtol=1e-4, atol=1e-5)


@every_method
def test_act_without_reset_and_with_another_batch(checkpoint: Path, method: str) -> None:
    agent = build(checkpoint, method)
    assert agent.act(frames_of(1)).shape == (1, 3)
    assert agent.act(frames_of(2)).shape == (2, 3)
    assert agent.last_plan_ms.shape == (2,)
    agent.reset(np.array([True, False]))
    assert agent.act(frames_of(2)).shape == (2, 3)


@every_method
def test_plans_are_timed_in_the_rows_that_plan(checkpoint: Path, method: str) -> None:
    agent = _reset(build(checkpoint, method), np.arange(2))
    period = 3 if method in QUICK else 0
    for time in range(8):
        agent.act(frames_of(2, time=time))
        planned = np.isfinite(agent.last_plan_ms)
        if method == "velap":  # plans anew where a promise is broken; the first step always plans
            assert planned.all() or time > 0
            continue
        assert planned.tolist() == [period > 0 and time % period == 0] * 2
        assert (agent.last_plan_ms[planned] > 0).all()


@every_method
def test_the_python_interface_finds_the_head(checkpoint: Path, method: str) -> None:
    loaded = api.load(checkpoint, method, device="cpu")
    assert loaded.method == method
    if method in QUICK:
        return  # the whole sample counts; the others act as those built here
    seeds = np.array([4, 5])
    np.testing.assert_array_equal(play(_reset(loaded, seeds), 2), play(_reset(build(checkpoint, method), seeds), 2))


@every_method
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
def test_on_a_gpu_actions_are_those_of_the_cpu(checkpoint: Path, method: str) -> None:
    model, config, metadata = load_checkpoint(checkpoint, "cuda")
    head = load_head(checkpoint.with_name(f"{method}.safetensors"), metadata, "cuda") if get_method(method).learns else None
    settings = get_method(method).settings_of("default", QUICK.get(method))
    agent = _reset(make_agent(method, model, config, ACTIONS, head, settings), np.arange(7))
    on_cpu = play(_reset(build(checkpoint, method), np.arange(7)), 7)
    # Half precision moves elites now and then.
    assert np.abs(play(agent, 7)[0] - on_cpu[0]).mean() < 0.05


def test_methods_are_those_of_table_1_and_three_of_ours() -> None:
    assert set(METHODS) == {"velap", "bc", "bc-success", "td3bc", "iql", "iql-sparse", "mppi", "mbop", "iris",
                            "iris-multistep", "random"}
    assert len({get_method(method).label for method in METHODS}) == len(METHODS)


@every_method
def test_the_config_hash_covers_all_that_decides_the_method(checkpoint: Path, method: str) -> None:
    _, config, _ = load_checkpoint(checkpoint)
    head = head_of(checkpoint, method)
    kind = get_method(method)
    own = kind.config_hash(config, head)
    others = {get_method(other).config_hash(config, head_of(checkpoint, other)) for other in METHODS if other != method}
    assert own not in others
    assert (own == config.hash()) == (method == "velap")
    planner, clone = {"planner": {"n_iter": 7}}, {"train": {"clone": {"steps": 9}}}
    for changes in (planner, clone):
        changed = kind.config_hash(override(config, **changes), head)
        assert (own != changed) == (method in WHOLE), "what the tree and its controller alone act by"
    assert own != kind.config_hash(override(config, model={"n_global": 3}), head)
    assert own == kind.config_hash(config, head, kind.settings_of("default"))
    paper = dataclasses.replace(config, preset="paper")
    assert kind.config_hash(paper, head) == kind.config_hash(paper, head, kind.settings_of("paper"))
    changed_settings = {"velap": {"planner": "mine"}} | QUICK
    if method in changed_settings:
        assert own != kind.config_hash(config, head, kind.settings_of("default", changed_settings[method]))
    if head is not None:
        head.weights_sha256 = "0" * 64
        assert own != kind.config_hash(config, head)


@pytest.mark.parametrize("method", learning_methods())
def test_a_missing_or_wrong_head_is_named(checkpoint: Path, method: str) -> None:
    model, config, _ = load_checkpoint(checkpoint)
    with pytest.raises(ConfigError, match=f"got none; train it with `velap train TASK --method {method}`"):
        make_agent(method, model, config, ACTIONS)
    with pytest.raises(ConfigError, match=f"--method {method}"):
        get_method(method).config_hash(config)
    other = "iql" if method == "bc" else "bc"
    with pytest.raises(ConfigError, match=f"{method!r} acts by its own head and got one of {other!r}"):
        make_agent(method, model, config, ACTIONS, head_of(checkpoint, other))


@every_method
def test_a_head_of_other_weights_is_foreign(checkpoint: Path, tmp_path: Path, method: str) -> None:
    if not get_method(method).learns:
        return
    model, config, _ = load_checkpoint(checkpoint)
    other = tmp_path / "model.safetensors"
    with torch.no_grad():
        next(model.parameters()).add_(1.0)
    save_checkpoint(other, model, config, {"seed": "3"})
    with pytest.raises(CheckpointError, match="foreign"):
        api.load(other, method, head=checkpoint.with_name(f"{method}.safetensors"))
    with pytest.raises(CheckpointError, match=f"no head at .*{method}.safetensors"):
        api.load(other, method)


def test_unknown_methods_and_fields_are_named() -> None:
    with pytest.raises(UnknownTaskError, match=r"'mcts'; expected one of bc, bc-success, "):
        make_agent("mcts", None, small_config(), ACTIONS)
    with pytest.raises(UnknownTaskError, match="--checkpoint"):
        make_agent("velap", None, small_config(), ACTIONS)
    with pytest.raises(ConfigError, match=r"'mppi' has no field \['beta'\]; expected some of \['samples'"):
        get_method("mppi").settings_of("default", {"beta": 0.5})
    with pytest.raises(ConfigError, match=r"'velap' has no field \['samples'\]; expected some of \['planner'\]"):
        get_method("velap").settings_of("default", {"samples": 3})
    with pytest.raises(ConfigError, match="'td3bc' has no field"):
        get_method("td3bc").settings_of("default", {"samples": 3})


def test_an_unknown_planner_is_named(checkpoint: Path) -> None:
    model, config, _ = load_checkpoint(checkpoint)
    with pytest.raises(UnknownTaskError, match="unknown planner 'rrt'; expected one of est"):
        make_agent("velap", model, config, ACTIONS, settings=get_method("velap").settings_of("default", {"planner": "rrt"}))


def test_a_plan_is_as_long_as_what_is_executed_of_it(checkpoint: Path) -> None:
    model, config, _ = load_checkpoint(checkpoint)
    with pytest.raises(ConfigError, match="`replan_every` is 5 and `horizon` 4"):
        make_agent("mppi", model, config, ACTIONS, settings=get_method("mppi").settings_of("default", {"horizon": 4}))


def test_settings_are_those_of_the_paper() -> None:
    for method in ("mppi", "mbop"):
        settings = dataclasses.asdict(get_method(method).settings_of("paper"))
        assert dataclasses.asdict(get_method(method).settings_of("default")) == settings | {"goal_ends": True}
        assert settings["goal_ends"] is False
        counts = [settings[name] for name in ("samples", "horizon", "elites", "iterations", "replan_every")]
        assert counts == [1000, 50, 64, 5, 5]
    assert get_method("mbop").settings_of("paper").beta == 0.7
    assert dataclasses.asdict(get_method("iris-multistep").settings_of("paper")) == {"samples": 256, "rollout": 5}
    assert get_method("iris").settings_of("paper").rollout == 1
