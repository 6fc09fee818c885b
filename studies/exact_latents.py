"""`velap study exact-latents`: what dynamics, values, search and controller can do where the latent is the true state.

A ruler, not a method: it reads positions that agents have to see, and tells how much of what fails is the encoder's. No
frame is drawn, so that a training takes minutes and fifty episodes half of one. Letters: F frames, S entries of a state, N
stacked frames, D latent dimensions.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from velap.config import Config, override
from velap.data.behaviours import run_trajectory
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler
from velap.envs.protocol import WithTrueState
from velap.errors import ConfigError
from velap.evaluation.console import ProgressBar
from velap.evaluation.evaluate import make_env, reset_options
from velap.evaluation.rollout import FrameReader, Rollout, make_envs
from velap.methods.base import make_agent
from velap.models.velap import LatentModel, Spaces
from velap.runs import make_generator, write_atomic
from velap.tasks import Task, get_task, make_config
from velap.training.diagnostics import measure_latents
from velap.training.joint import JointLearner

EPISODES, QUICK_EPISODES, FIRST_SEED = 50, 10, 1000
"""Validation episodes."""
BATCH = 25
METHODS = ("td3bc", "velap")
"""π^g alone, and the planner: both act by what was learnt on the true states."""
HAND, STEP = 0.08, 0.008
"""What counts as one in a latent: so much of the hand's place, and so much of its way in a step [m]."""
JOINT_SHARE, LEAST = 0.2, 1e-3
"""Joints count in this share of their range in the data, places in their deviation; neither in less than `LEAST`."""
SIDE = 64
"""Of the pictures that carry a state in their bytes [px]."""


def pack(state: NDArray[np.float32]) -> NDArray[np.uint8]:
    """A state [S] in the first bytes of a picture uint8 [64, 64, 3]."""
    picture = np.zeros(SIDE * SIDE * 3, np.uint8)
    raw = np.frombuffer(state.astype(np.float32).tobytes(), np.uint8)
    picture[: len(raw)] = raw
    return picture.reshape(SIDE, SIDE, 3)


def unpack(pictures: NDArray[np.uint8], entries: int) -> NDArray[np.float32]:
    """States [*, S] of pictures uint8 [*, 64, 64, 3]."""
    flat = np.ascontiguousarray(pictures.reshape(*pictures.shape[:-3], -1)[..., : 4 * entries])
    return flat.view(np.float32)


@dataclass(frozen=True)
class States:
    """The data of a task without its pictures."""

    store: FrameStore
    """Its frames [F, 1, 1, 3] hold the number of their row, base 256."""
    states: NDArray[np.float32]
    """[F, S] `SawyerTask.true_state`."""
    joints: int
    """How many of the entries after the hand's three are joints."""


def collect_states(task: Task, contexts: int | None = None, seed: int = 0, view: ProgressBar | None = None) -> States:
    """The trajectories that `velap collect` records, step for step, without drawing; `contexts` of them all where given."""
    env: Any = make_env(task.env_id).unwrapped
    if not isinstance(env.unwrapped, WithTrueState):
        raise ConfigError(f"{task.name} tells no true state; expected one of the manipulation tasks.")
    env.render = env.true_state  # what the data hold in place of frames
    runs = []
    count = contexts or task.recipe.contexts
    for context in range(count):
        for trajectory in range(task.recipe.trajectories):
            runs.append(run_trajectory(env, task.recipe, task.shares, seed, context, trajectory))
        if view is not None:
            view.show(context + 1)
    rows = {name: np.concatenate([run[name] for run in runs])
            for name in ("frames", "actions", "rewards", "terminated", "truncated", "length")}
    number = np.arange(len(rows["rewards"]))
    frames = np.stack([number >> 16, number >> 8 & 255, number & 255], -1).astype(np.uint8).reshape(-1, 1, 1, 3)
    space = env.action_space
    store = FrameStore.from_arrays(frames=frames, actions=rows["actions"], rewards=rows["rewards"],
                                   terminated=rows["terminated"], truncated=rows["truncated"],
                                   episode_length=rows["length"], action_low=space.low, action_high=space.high,
                                   dataset_id=f"{task.name}/states")
    return States(store, rows["frames"].astype(np.float32), len(env.joints))


class ExactEncoder:
    """Stands in for φ: hand, joints and places in sizes that count alike, and the hand's last two steps; zeros behind."""

    def __init__(self, data: States, latent_dim: int) -> None:
        self._states = data.states
        self._latent_dim, entries = latent_dim, data.states.shape[1]
        if entries + 6 > latent_dim:
            raise ConfigError(f"config field `latent_dim` is {latent_dim}; expected at least {entries + 6} for this state.")
        self._mean = data.states.mean(0)
        scale = data.states.std(0)
        scale[:3] = HAND
        joints = slice(3, 3 + data.joints)
        scale[joints] = JOINT_SHARE * np.ptp(data.states[:, joints], axis=0)
        self._scale = np.maximum(scale, LEAST)

    def __call__(self, frames: Tensor, commands: Tensor | None = None) -> Tensor:
        """Frames of the data [*, N, 1, 1, 3] or packed states [*, N, 64, 64, 3] -> latents [*, D]."""
        pictures = frames.numpy()
        if pictures.shape[-3] == 1:
            digits = pictures[..., 0, 0, :].astype(np.int64)
            states = self._states[digits @ np.array([65536, 256, 1])]
        else:
            states = unpack(pictures, self._states.shape[1])
        return torch.from_numpy(self.latents(states))

    def latents(self, states: NDArray[np.float32]) -> NDArray[np.float32]:
        """Stacked states [*, N, S], oldest first -> [*, D]."""
        hand = states[..., :3]
        last = hand[..., -1, :] - hand[..., max(hand.shape[-2] - 2, 0), :]
        before = hand[..., max(hand.shape[-2] - 2, 0), :] - hand[..., max(hand.shape[-2] - 3, 0), :]
        known = np.concatenate([(states[..., -1, :] - self._mean) / self._scale, last / STEP, before / STEP], -1)
        latent = np.zeros((*known.shape[:-1], self._latent_dim), np.float32)
        latent[..., : known.shape[-1]] = known
        return latent


def learn(data: States, config: Config, seed: int, view: ProgressBar | None = None) -> LatentModel:
    """A model in eval mode, taught by all phases of the config that work on a frozen encoder."""
    train = dataclasses.replace(config.train, encoder_steps=0, joint_steps=0, reconstruction=0.0)
    device = torch.device("cpu")
    sampler = WindowSampler(data.store, train, config.model.frame_stack, device, np.zeros(0, np.int64))
    store = data.store
    spaces = Spaces(SIDE, SIDE, tuple(map(float, store.action_low)), tuple(map(float, store.action_high)))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        # the true state holds the speed of the hand, and there is no picture to measure
        blind = dataclasses.replace(config.model, latent_dim=config.model.learnt_dim, command_memory=0.0, moment_colours=0,
                                    slow_features=0, keep_moments=False)
        model = LatentModel(blind, spaces, train.discount, train.precision).train()
    model.encode = ExactEncoder(data, blind.latent_dim)  # type: ignore[method-assign]
    learner = JointLearner(model, train, sampler, make_generator(seed, stream=1, device=device))
    learner.begin_latent_phase()
    done = 0
    for phase, steps in train.phases:
        for step in range(steps):
            learner.frozen_step(phase, step, steps)
            done += 1
            if view is not None:
                view.show(done, title=f"exact latents, {phase} phase")
    model.eval()
    measure_latents(model, sampler, make_generator(seed, stream=2))
    return model


def play(task: Task, model: LatentModel, config: Config, *, method: str, seeds: range,
         view: ProgressBar | None = None) -> list[Any]:
    """Episodes of a method that sees packed states."""
    def make() -> gym.Env[Any, Any]:
        env = make_env(task.env_id)
        world: Any = env.unwrapped
        world.render = lambda size=SIDE: pack(world.true_state())
        return env

    envs = make_envs(make, min(BATCH, len(seeds)))
    agent = make_agent(method, model, config, envs[0].action_space)
    rollout = Rollout(envs, agent, FrameReader(envs[0], SIDE), reset_options=reset_options(envs[0]))
    episodes = []
    for episode in rollout.run(seeds):
        episodes.append(episode)
        if view is not None:
            view.show(len(episodes))
    return episodes


def study_exact_latents(
    console: Console, name: str, changes: Mapping[str, dict[str, Any]] | None = None, seed: int = 0, quick: bool = False,
    path: Path | None = None, contexts: int | None = None,
) -> list[dict[str, Any]]:
    """Collect, learn, play and print; the figures go to `path` as JSON where given. One row a method."""
    task = get_task(name)
    config = override(make_config(name), **(changes or {}))
    began = time.monotonic()
    with ProgressBar(console, f"states of {name}", contexts or task.recipe.contexts) as view:
        data = collect_states(task, contexts, view=view)
    steps = sum(count for phase, count in config.train.phases if phase not in ("encoder", "joint"))
    with ProgressBar(console, "exact latents", steps) as view:
        model = learn(data, config, seed, view)
    seeds = range(FIRST_SEED, FIRST_SEED + (QUICK_EPISODES if quick else EPISODES))
    rows: list[dict[str, Any]] = []
    for method in METHODS:
        with ProgressBar(console, f"{method} on {name}", len(seeds)) as view:
            episodes = play(task, model, config, method=method, seeds=seeds, view=view)
        rows.append({"task": name, "method": method, "train_seed": seed, "first_seed": seeds[0], "episodes": len(episodes),
                     "solved": sum(episode.success for episode in episodes),
                     "mean_steps": float(np.mean([episode.steps for episode in episodes])), "config_hash": config.hash()})
        console.print(f"{method}: {rows[-1]['solved']} of {len(episodes)} solved, {rows[-1]['mean_steps']:.0f} steps",
                      markup=False)
    console.print(f"{time.monotonic() - began:.0f} s. The latent was the true state: a ruler, not a result.", markup=False)
    if path is not None:
        write_atomic(path, (json.dumps(rows, indent=1) + "\n").encode())
        console.print(f"written to {path}", markup=False)
    return rows
