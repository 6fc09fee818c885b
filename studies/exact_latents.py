"""`velap study exact-latents`: success of dynamics, values, search and controller when the latent is the true state.

An upper bound, not a method: it reads positions that agents have to see, and shows which failures are the encoder's. It
renders no frame, so that a training takes minutes. Letters: S entries of a state, N stacked frames, D latent dimensions.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from velap.config import Config, ModelConfig, override
from velap.data.behaviours import run_trajectory
from velap.data.frames import FrameStore
from velap.envs.protocol import WithTrueState
from velap.errors import ConfigError
from velap.evaluation.console import ProgressBar
from velap.evaluation.evaluate import make_env
from velap.evaluation.rollout import FrameReader, Rollout, make_envs
from velap.methods.base import make_agent
from velap.models.encoders.base import Encoder
from velap.models.velap import LatentModel
from velap.registry import register_encoder
from velap.runs import make_generator, write_atomic
from velap.tasks import Task, get_task, make_config
from velap.training.diagnostics import measure_latents
from velap.training.loop import Trainer

EPISODES, QUICK_EPISODES, FIRST_SEED = 50, 10, 1000
"""Validation episodes."""
BATCH = 25
METHODS = ("td3bc", "velap")
"""π^g alone, and the planner."""
UNITS = {2: (0.2, 0.05), 3: (0.08, 0.008)}
"""Units of the latent by the entries of the agent's position: where a block or a hand is, and its way in a step [m]."""
JOINT_SHARE, LEAST = 0.2, 1e-3
"""Units of joints, as a share of their range in the data, and the smallest unit; the unit of places is their deviation."""
SIDE = 16
"""Side of the pictures that carry a state in their bytes [px]."""


class Layout(NamedTuple):
    """The first entries of a state."""

    position: int
    """Of the agent's position."""
    joints: int
    """Joints of objects, behind the position."""


def pack(state: NDArray[np.float32], layout: Layout) -> NDArray[np.uint8]:
    """A state [S] as a picture uint8 [SIDE, SIDE, 3]: S, the layout, then the bytes of the state."""
    raw = np.frombuffer(state.astype(np.float32).tobytes(), np.uint8)
    picture = np.zeros(SIDE * SIDE * 3, np.uint8)
    picture[: 3 + len(raw)] = np.concatenate([np.array([len(state), *layout], np.uint8), raw])
    return picture.reshape(SIDE, SIDE, 3)


def pack_world(world: Any) -> NDArray[np.uint8]:
    """The true state of a world that knows it, packed."""
    return pack(world.true_state(), Layout(len(world.agent_position()), len(getattr(world, "joints", ()))))


def unpack(pictures: NDArray[np.uint8]) -> tuple[NDArray[np.float32], Layout]:
    """States [*, S] of pictures uint8 [*, SIDE, SIDE, 3], and their layout."""
    flat = pictures.reshape(*pictures.shape[:-3], -1)
    entries, *layout = (int(value) for value in flat.reshape(-1, flat.shape[-1])[0, :3])
    return np.ascontiguousarray(flat[..., 3 : 3 + 4 * entries]).view(np.float32), Layout(*layout)


def without_drawing(task: Task) -> gym.Env[Any, Any]:
    """The task's environment, without a time limit, with packed states in place of its frames."""
    made = make_env(task.env_id)
    kind: Any = type(made.unwrapped)
    if not isinstance(made.unwrapped, WithTrueState):
        raise ConfigError(f"{task.name} has no true state; expected a task whose environment is "
                          "`velap.envs.protocol.WithTrueState`.")

    class Undrawn(kind):
        spec = made.spec

        def __init__(self) -> None:
            super().__init__()
            self.observation_space = gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)

        def render(self, size: int = SIDE) -> NDArray[np.uint8]:
            return pack_world(self)

    env: gym.Env[Any, Any] = Undrawn()
    return env


def collect_states(task: Task, contexts: int | None = None, seed: int = 0, view: ProgressBar | None = None) -> FrameStore:
    """The trajectories that `velap collect` records, with packed states in place of frames; of the first `contexts` if
    given."""
    env = without_drawing(task)
    runs = []
    for context in range(contexts or task.recipe.contexts):
        for trajectory in range(task.recipe.trajectories):
            runs.append(run_trajectory(env, task.recipe, task.shares, seed, context, trajectory))
        if view is not None:
            view.show(context + 1)
    rows = {name: np.concatenate([run[name] for run in runs])
            for name in ("frames", "actions", "rewards", "terminated", "truncated", "length")}
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    return FrameStore.from_arrays(frames=rows["frames"], actions=rows["actions"], rewards=rows["rewards"],
                                  terminated=rows["terminated"], truncated=rows["truncated"],
                                  episode_length=rows["length"], action_low=space.low, action_high=space.high,
                                  dataset_id=f"{task.name}/states")


@register_encoder("exact-states")
class ExactEncoder(Encoder):
    """Position, joints and places in comparable units, and the agent's last two steps; zeros behind."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__()
        self.latent_dim = config.latent_dim
        self.register_buffer("entries", torch.zeros(2, dtype=torch.int64))
        self.register_buffer("mean", torch.zeros(config.latent_dim))
        self.register_buffer("scale", torch.ones(config.latent_dim))
        self.entries: Tensor
        """S, and how many of them are the agent's position."""
        self.mean: Tensor
        self.scale: Tensor
        """float32 [S], unit of each entry; longer than S."""

    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Find the unit of each entry [S] from the states of the data."""
        states, layout = unpack(frames.cpu().numpy())
        entries, place = states.shape[1], layout.position
        if entries + 2 * place > self.latent_dim:
            raise ConfigError(f"config field `latent_dim` is {self.latent_dim}; expected at least {entries + 2 * place} for "
                              "this state.")
        scale = states.std(0)
        scale[:place] = UNITS[place][0]
        moving = slice(place, place + layout.joints)
        scale[moving] = JOINT_SHARE * np.ptp(states[:, moving], axis=0)
        self.entries.copy_(torch.tensor([entries, place]))
        self.mean[:entries] = torch.from_numpy(states.mean(0))
        self.scale[:entries] = torch.from_numpy(np.maximum(scale, LEAST))
        return frames

    def encode(self, stacks: Tensor) -> Tensor:
        """Packed states uint8 [M, N, SIDE, SIDE, 3], oldest first -> latents [M, D]."""
        states = torch.from_numpy(unpack(stacks.cpu().numpy())[0]).to(stacks.device)
        entries, place = self.entries.tolist()
        where = states[..., :place]
        now, before, oldest = (where[:, max(where.shape[1] - back, 0)] for back in (1, 2, 3))
        step = UNITS[place][1]
        latent = states.new_zeros(len(states), self.latent_dim)
        latent[:, :entries] = (states[:, -1] - self.mean[:entries]) / self.scale[:entries]
        latent[:, entries : entries + 2 * place] = torch.cat([now - before, before - oldest], -1) / step
        return latent


def on_states(config: Config) -> Config:
    """The config with the true state in place of φ and phases on frozen latents alone. The state contains the hand's
    speed."""
    train = dataclasses.replace(config.train, phases=tuple(phase for phase in config.train.phases if phase.frozen))
    model = dataclasses.replace(config.model, encoder="exact-states", command_dims=0)
    return dataclasses.replace(config, model=model, train=train)


def learn(data: FrameStore, config: Config, seed: int, view: ProgressBar | None = None) -> LatentModel:
    """A model in eval mode, trained by all phases of `on_states`."""
    trainer = Trainer(config, data, Path("runs") / "exact", seed, torch.device("cpu"))
    while trainer.step < trainer.total:
        trainer.update()
        if view is not None:
            view.show(trainer.step, title=f"exact latents, {trainer.phase} phase")
    model = trainer.model.eval()
    measure_latents(model, trainer.sampler, make_generator(seed, stream=2))
    return model


def play(task: Task, model: LatentModel, config: Config, *, method: str, seeds: range,
         view: ProgressBar | None = None) -> list[Any]:
    """Episodes of a method that sees packed states."""
    def make() -> gym.Env[Any, Any]:
        return gym.wrappers.TimeLimit(without_drawing(task), task.max_steps)

    envs = make_envs(make, min(BATCH, len(seeds)))
    agent = make_agent(method, model, config, envs[0].action_space)
    rollout = Rollout(envs, agent, FrameReader(envs[0], SIDE), reset_options={"split": "test"})
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
    """Collect, learn, play and print; writes the figures to `path` as JSON if given. One row a method."""
    task = get_task(name)
    config = on_states(override(make_config(name), **(changes or {})))
    began = time.monotonic()
    with ProgressBar(console, f"states of {name}", contexts or task.recipe.contexts) as view:
        data = collect_states(task, contexts, view=view)
    with ProgressBar(console, "exact latents", config.train.steps) as view:
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
    console.print(f"{time.monotonic() - began:.0f} s; the latent was the true state: an upper bound", markup=False)
    if path is not None:
        write_atomic(path, (json.dumps(rows, indent=1) + "\n").encode())
        console.print(f"written to {path}", markup=False)
    return rows
