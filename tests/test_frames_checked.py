"""`act` takes the frames that the model was trained on, in any strides, and names every other kind."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from velap.config import override
from velap.errors import ObservationError
from velap.methods.base import Agent, make_agent
from velap.models.velap import LatentModel, Spaces
from velap.tasks import make_config

Change = Callable[[np.ndarray], np.ndarray]
ACTIONS = gym.spaces.Box(-1, 1, (2,))


@pytest.fixture(scope="module", params=["td3bc", "velap"])
def agent(request: pytest.FixtureRequest) -> Agent:
    """An agent by random weights, two frames of 64 pixels a state."""
    config = override(make_config("SpiralMaze"), model={"frame_stack": 2}, planner={"n_iter": 8, "candidates": 2})
    torch.manual_seed(0)
    model = LatentModel(config.model, Spaces(64, 64, (-1.0,) * 2, (1.0,) * 2), config.train.discount)
    return make_agent(request.param, model, config, ACTIONS)


@pytest.fixture
def frames(agent: Agent) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (2, 2, 64, 64, 3), np.uint8)


@pytest.mark.parametrize(("change", "text"), [
    (lambda f: (f / 255).astype(np.float32), r"type float32 .*expected uint8 .*floats in 0 to 1 by np.round\(255 \* frames"),
    (lambda f: f.astype(float), r"type float64 .*Convert values in 0 to 255"),
    (lambda f: f.astype(np.int64), "type int64"),
    (lambda f: f > 9, "type bool"),
    (lambda f: f.astype(object), "type object"),
    (lambda f: f[0], r"shape \[\d, 64, 64, 3\].*frames\[None\]"),
    (lambda f: f[0, 0], r"shape \[64, 64, 3\]"),
    (lambda f: f[:0], r"shape \[0, .*1 or more"),
    (lambda f: f.repeat(2, 2).repeat(2, 3), r"shape \[2, \d, 128, 128, 3\].*size"),
    (lambda f: np.moveaxis(f, -1, 2), r"np.moveaxis\(frames, 2, -1\)"),
    (lambda f: np.concatenate([f, f], 1), r"newest \d frames"),
    (lambda f: f[..., :1], r"64, 64, 1\]"),
    (lambda f: np.concatenate([f, f[..., :1]], -1), r"64, 64, 4\]"),
], ids=["unit floats", "byte floats", "int64", "bool", "object", "no batch axis", "one picture", "no row", "128 px",
        "channel first", "too many", "grey", "alpha"])
def test_other_frames_are_named_and_leave_the_episode_as_it_is(agent: Agent, frames: np.ndarray,
                                                               change: Change, text: str) -> None:
    agent.reset(np.ones(2, bool), np.array([4, 5]))
    expected = [agent.act(frames) for _ in range(2)]
    agent.reset(np.ones(2, bool), np.array([4, 5]))
    first = agent.act(frames)
    with pytest.raises(ObservationError, match=text):
        agent.act(change(frames))
    np.testing.assert_array_equal([first, agent.act(frames)], expected)


@pytest.mark.parametrize("view", [
    lambda f: f[:, :, ::-1][:, :, ::-1], np.asfortranarray,
    lambda f: np.moveaxis(np.ascontiguousarray(np.moveaxis(f, -1, 2)), 2, -1),
], ids=["negative strides", "column order", "moved axis"])
def test_a_view_gives_the_action_of_its_values(agent: Agent, frames: np.ndarray, view: Change) -> None:
    agent.reset(np.ones(2, bool), np.array([4, 5]))
    expected = agent.act(frames)
    agent.reset(np.ones(2, bool), np.array([4, 5]))
    np.testing.assert_array_equal(agent.act(view(frames)), expected)


def test_a_flipped_view_gives_the_action_of_the_flipped_picture(agent: Agent, frames: np.ndarray) -> None:
    agent.reset(np.ones(2, bool))
    expected = agent.act(frames[:, :, ::-1].copy())
    agent.reset(np.ones(2, bool))
    np.testing.assert_array_equal(agent.act(frames[:, :, ::-1]), expected)


def test_pictures_that_cannot_be_written_are_read(agent: Agent, frames: np.ndarray) -> None:
    """Frames of shared memory or of a server are read-only; torch warns of them."""
    agent.reset(np.ones(2, bool))
    expected = agent.act(frames)
    locked = frames.copy()
    locked.setflags(write=False)
    agent.reset(np.ones(2, bool))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(agent.act(locked), expected)


WRONG_STARTS = [
    ((np.array([0]),), r"mask of type int64 and shape \[1\]; expected bool \[B\]"), (([1, 0],), "mask of type int64"),
    ((True,), r"mask of type bool and shape \[\]"), ((None,), "mask of type object"),
    ((np.ones((2, 1), bool),), r"\[2, 1\]"),
    ((np.zeros(0, bool),), r"shape \[0\]"), ((np.ones(2, bool), 7), r"seeds of type int64 and shape \[\]"),
    ((np.ones(2, bool), [7]), "an integer of 0 or more for each of the 2 rows"), ((np.ones(2, bool), [-1, 0]), "0 or more"),
    ((np.ones(2, bool), [0.5, 1.0]), "seeds of type float64")]


@pytest.mark.parametrize(("start", "text"), WRONG_STARTS)
def test_a_wrong_start_is_named_and_leaves_the_episode_as_it_is(agent: Agent, frames: np.ndarray, start: tuple[Any, ...],
                                                                text: str) -> None:
    """Numbers of rows are not a mask, and one seed is not one for each row."""
    agent.reset(np.ones(2, bool), np.array([4, 5]))
    expected = [agent.act(frames) for _ in range(2)]
    agent.reset([True, True], [4, 5])
    first = agent.act(frames)
    with pytest.raises(ObservationError, match=text):
        agent.reset(*start)
    np.testing.assert_array_equal([first, agent.act(frames)], expected)


@pytest.mark.parametrize("method", ["mppi", "random"])
def test_every_kind_of_agent_names_a_wrong_start(method: str, agent: Agent) -> None:
    config = make_config("SpiralMaze")
    model = LatentModel(config.model, Spaces(64, 64, (-1.0,) * 2, (1.0,) * 2), config.train.discount)
    for start, text in WRONG_STARTS:
        with pytest.raises(ObservationError, match=text):
            make_agent(method, model, config, ACTIONS).reset(*start)


def test_random_actions_need_a_batch_as_well() -> None:
    agent = make_agent("random", None, override(make_config("SpiralMaze"), model={"frame_stack": 1}), ACTIONS)
    with pytest.raises(ObservationError, match=r"\[B, 1, H, W, 3\]"):
        agent.act(np.zeros((3, 64, 64, 3), np.uint8))
