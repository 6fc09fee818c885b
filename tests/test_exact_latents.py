"""The ruler of exact latents: states survive their pictures, data and episodes are encoded alike, and it plays."""

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from rich.console import Console

import velap.envs  # noqa: F401 - registers the tasks
from studies.exact_latents import ExactEncoder, collect_states, pack, study_exact_latents, unpack
from velap.data.behaviours import position_of, run_trajectory
from velap.data.frames import stack_indices
from velap.errors import ConfigError
from velap.tasks import get_task


def test_states_survive_their_pictures():
    states = np.random.default_rng(0).normal(size=(2, 3, 9)).astype(np.float32)
    pictures = np.stack([np.stack([pack(state) for state in row]) for row in states])
    assert pictures.shape == (2, 3, 64, 64, 3) and np.array_equal(unpack(pictures, 9), states)


@pytest.mark.parametrize("name", ["WindowClose", "FaucetClose", "ButtonWall", "DrawerButton"])
def test_states_are_those_of_the_recorded_trajectories(name):
    task = get_task(name)
    data = collect_states(task, contexts=1)
    env = gym.make(task.env_id).unwrapped
    recorded = run_trajectory(env, task.recipe, task.shares, 0, 0, 1)
    start, length = data.store.episode_start[1], data.store.episode_length[1]
    rows = slice(start, start + length + 1)
    assert np.array_equal(recorded["actions"], data.store.actions[rows]), "drawing must not change what happens"
    assert np.allclose(recorded["positions"], data.states[rows, :3])
    assert np.allclose(env.true_state()[:3], position_of(env))


def test_data_and_episodes_are_encoded_alike():
    data = collect_states(get_task("DrawerButton"), contexts=1)
    encode = ExactEncoder(data, 32)
    rows = stack_indices(np.arange(len(data.states)), data.store.first, 3)
    of_data = encode(torch.from_numpy(data.store.frames[rows]))
    packed = np.stack([[pack(state) for state in stack] for stack in data.states[rows[:50]]])
    assert torch.allclose(of_data[:50], encode(torch.from_numpy(packed)))
    assert of_data.shape == (len(data.states), 32) and (of_data[:, 16:] == 0).all()
    moved = (data.states[2, :3] - data.states[1, :3]) / 0.008
    assert np.allclose(of_data[2, 10:13].numpy(), moved, atol=1e-4)
    with pytest.raises(ConfigError, match="latent_dim"):
        ExactEncoder(data, 8)


def test_mazes_tell_no_state():
    with pytest.raises(ConfigError, match="manipulation"):
        collect_states(get_task("SpiralMaze"), contexts=1)


@pytest.mark.parametrize("task", ["WindowClose", "DrawerButton"])
def test_the_study_learns_and_plays(tmp_path, task):
    quick = {"model": {"bank_size": 10, "success_policy": False, "held_policy": True}, "planner": {"n_iter": 20},
             "train": {"latent_steps": 2, "latent_value_steps": 2, "clone_steps": 0,
                       "member_steps": 2, "members": 2, "held_steps": 2, "distil_steps": 2,
                       "latent_horizon": 3},
             "controller": {"success_rollout": 0, "success_exponent": 0.0}}
    rows = study_exact_latents(Console(quiet=True), task, quick, quick=True, path=tmp_path / "x.json", contexts=3)
    assert [row["method"] for row in rows] == ["td3bc", "velap"] and {row["episodes"] for row in rows} == {10}
    assert json.loads((tmp_path / "x.json").read_text()) == rows
