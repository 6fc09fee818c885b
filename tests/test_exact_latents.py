"""The ruler of exact latents: states survive their pictures, data and episodes are encoded alike, and it plays."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console

import velap.envs  # noqa: F401 - registers the tasks
from studies.exact_latents import (
    SIDE,
    ExactEncoder,
    Layout,
    collect_states,
    pack,
    study_exact_latents,
    unpack,
    without_drawing,
)
from velap.config import ModelConfig
from velap.data.behaviours import position_of, run_trajectory
from velap.data.frames import stack_indices
from velap.errors import ConfigError
from velap.tasks import Recipe, Task, get_task


def test_states_survive_their_pictures():
    states = np.random.default_rng(0).normal(size=(2, 3, 9)).astype(np.float32)
    pictures = np.stack([np.stack([pack(state, Layout(3, 4)) for state in row]) for row in states])
    found, layout = unpack(pictures)
    assert pictures.shape == (2, 3, SIDE, SIDE, 3) and np.array_equal(found, states) and layout == (3, 4)


@pytest.mark.parametrize("name", ["ObstacleMaze", "WindowClose", "FaucetClose", "ButtonWall", "DrawerButton"])
def test_states_are_those_of_the_recorded_trajectories(name):
    task = get_task(name)
    data = collect_states(task, contexts=1)
    env = gym.make(task.env_id).unwrapped
    recorded = run_trajectory(env, task.recipe, task.shares, 0, 0, 1)
    start, length = data.episode_start[1], data.episode_length[1]
    rows = slice(start, start + length + 1)
    assert np.array_equal(recorded["actions"], data.actions[rows]), "drawing must not change what happens"
    assert np.allclose(recorded["positions"], unpack(data.frames[rows])[0][:, : len(position_of(env))])
    assert np.allclose(env.true_state()[: len(position_of(env))], position_of(env))


def test_data_and_episodes_are_encoded_alike():
    data = collect_states(get_task("DrawerButton"), contexts=1)
    states, layout = unpack(data.frames)
    encoder = ExactEncoder(ModelConfig(latent_dim=32), (64, 64))
    features = encoder.fit(torch.from_numpy(data.frames), torch.from_numpy(data.last), 0)
    rows = stack_indices(np.arange(len(states)), data.first, 3)
    of_data = encoder.encode(features[torch.from_numpy(rows)])
    packed = np.stack([[pack(state, layout) for state in stack] for stack in states[rows[:50]]])
    assert torch.allclose(of_data[:50], encoder(torch.from_numpy(packed)))
    assert of_data.shape == (len(states), 32) and (of_data[:, 16:] == 0).all()
    moved = (states[2, :3] - states[1, :3]) / 0.008
    assert np.allclose(of_data[2, 10:13].numpy(), moved, atol=1e-4)
    with pytest.raises(ConfigError, match="latent_dim"):
        ExactEncoder(ModelConfig(latent_dim=8), (64, 64)).fit(torch.from_numpy(data.frames), torch.from_numpy(data.last), 0)


def test_the_bars_of_a_room_are_part_of_its_state():
    room = gym.make("velap/ObstacleMaze-v0").unwrapped
    room.reset(seed=1000)
    lower, upper = room.true_state()[2:4], room.true_state()[4:6]
    assert lower[1] < upper[1] and lower[0] * upper[0] < 0, "the bars stand at opposite sides"
    held = [wall for wall in room.layout.walls if wall.contains(lower) or wall.contains(upper)]
    assert len(held) == 2


def test_what_has_no_state_is_refused():
    with pytest.raises(ConfigError, match="Blind has no true state"):
        without_drawing(Task("Blind", "CartPole-v1", 10, Recipe(1, 1, 1)))


@pytest.mark.parametrize("task", ["SpiralMaze", "WindowClose", "DrawerButton"])
def test_the_study_learns_and_plays(tmp_path, monkeypatch, task):
    quick = {"model": {"bank_size": 10}, "planner": {"n_iter": 20},
             "train": {"latent": {"steps": 2, "horizon": 3}, "values": {"steps": 2}, "clone": {"steps": 0},
                       "ensemble": {"steps": 2, "members": 2}}}
    monkeypatch.setattr("velap.config.training.DISTIL_STEPS", 2)
    rows = study_exact_latents(Console(quiet=True), task, quick, quick=True, path=tmp_path / "x.json", contexts=3)
    assert [row["method"] for row in rows] == ["td3bc", "velap"] and {row["episodes"] for row in rows} == {10}
    assert json.loads((tmp_path / "x.json").read_text()) == rows
