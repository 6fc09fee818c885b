"""What `velap diagnose` measures in an environment: test starts, Q^g along the expert's path, distances in a maze.

P probed states, M pairs of them, B starts, T transitions of an episode, N stacked frames, H x W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from velap.data.commands import past_commands
from velap.data.frames import stack_indices
from velap.envs.mazes.env import STEP_LENGTH
from velap.envs.mazes.geometry import Layout, Rect
from velap.envs.protocol import Expert, Mapped, Walled
from velap.evaluation.evaluate import Player, reset_options
from velap.evaluation.rollout import FrameReader, play_without_frames
from velap.models.velap import LatentModel
from velap.report.diagnose.model import ValueCurve, local_steps, rank_correlation, value_curve
from velap.report.diagnose.plans import Starts
from velap.report.figures import probe

PROBED = 400
"""Probed states of a maze. ours."""
GOALS = 16
"""Probed states that distances are measured to. ours."""
NEAR = 20.0
"""π^l is for pairs up to this distance [steps]. ours: the length of the mazes' random walks."""
_POINT = 1e-4
"""Half side of the goal region that replaces a point [m]."""


@dataclass(frozen=True, kw_only=True)
class Scene:
    """True distances in a maze, and Q^l and Q^g."""

    seed: int
    goal_steps: NDArray[np.float64]
    """[P] shortest way to the goal at top speed [steps]."""
    values: NDArray[np.float64]
    """[P] Q^g [Q-value]."""
    pair_steps: NDArray[np.float64]
    """[M] shortest way between two states at top speed [steps]."""
    pair_local: NDArray[np.float64]
    """[M] log_γ Q_min between them [steps]."""

    @property
    def value_rho(self) -> float:
        """Spearman's rho of Q^g and nearness to the goal."""
        return rank_correlation(self.values, -self.goal_steps)

    @property
    def local_rho(self) -> float:
        """Spearman's rho of Q^l's steps and the true ones, all pairs."""
        return rank_correlation(self.pair_local, self.pair_steps)

    @property
    def near_rho(self) -> float:
        """The same for pairs up to `NEAR` apart."""
        near = self.pair_steps <= NEAR
        return rank_correlation(self.pair_local[near], self.pair_steps[near])

    def aliased(self, limit: float, apart: float) -> float | None:
        """Share of the pairs more than `apart` [steps] apart that are at most `limit` [steps] apart by Q^l."""
        far = self.pair_steps > apart
        return float((self.pair_local[far] <= limit).mean()) if far.any() else None


def has_layout(env: gym.Env[Any, Any]) -> bool:
    """Whether true distances can be computed: a maze of ours."""
    return isinstance(env.unwrapped, Mapped) and isinstance(env.unwrapped, Walled)


def distances_to(layout: Layout, points: NDArray[np.float64], goal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shortest ways of the block's centre from points [*, 2] to the point goal [2] [m] at top speed [*] [steps]."""
    x, y = goal
    here = replace(layout, goal=Rect(x - _POINT, y - _POINT, x + _POINT, y + _POINT))
    return here.geodesic(points) / STEP_LENGTH


def look_at_scene(model: LatentModel, env: gym.Env[Any, Any], read: FrameReader, frame_stack: int, seed: int,
                  count: int = PROBED) -> Scene:
    """Probe the maze of that test seed."""
    rng = np.random.default_rng(seed)
    seen = probe(model, env, read, frame_stack=frame_stack, rng=rng, count=count, seed=seed)
    world: Any = env.unwrapped
    places = np.stack([world.layout.nearest_free(place) for place in seen.positions])
    latents = torch.from_numpy(seen.latents).to(next(model.parameters()).device)
    true, local = [], []
    for goal in rng.choice(count, min(GOALS, count), replace=False):
        others = np.arange(count) != goal
        true.append(distances_to(world.layout, places[others], places[goal]))
        start = latents[torch.from_numpy(np.flatnonzero(others)).to(latents.device)]
        local.append(local_steps(model, start, latents[goal].expand_as(start)))
    pair_steps, pair_local, goal_steps = np.concatenate(true), np.concatenate(local), world.geodesic_steps(places)
    # rounding may leave a block that touches a wall without any way
    known, reachable = np.isfinite(pair_steps), np.isfinite(goal_steps)
    return Scene(
        seed=seed,
        goal_steps=goal_steps[reachable],
        values=seen.values[reachable].astype(np.float64),
        pair_steps=pair_steps[known],
        pair_local=pair_local[known])


def stack_all(frames: Sequence[NDArray[np.uint8]], frame_stack: int) -> NDArray[np.uint8]:
    """Every state of an episode [T + 1, N, H, W, 3] from its frames."""
    rows = stack_indices(np.arange(len(frames)), np.zeros(len(frames), np.int64), frame_stack)
    return np.stack(frames)[rows]


def first_states(player: Player, env: gym.Env[Any, Any], seeds: Sequence[int]) -> Starts:
    """The starts of episodes."""
    read, stacks = player.frames_of(env), []
    for seed in seeds:
        observation, _ = env.reset(seed=seed, options=reset_options(env))
        stacks.append(stack_all([read(observation)], player.config.model.frame_stack)[0])
    return Starts(tuple(f"start {seed}" for seed in seeds), np.stack(stacks))


def expert_curves(model: LatentModel, env: gym.Env[Any, Any], frame_stack: int, seeds: Sequence[int]) -> list[ValueCurve]:
    """Q^g along the scripted expert's successful episodes; empty without an expert."""
    world: Any = env.unwrapped
    if not isinstance(env.unwrapped, Expert) or env.spec is None or env.spec.max_episode_steps is None:
        return []
    device, curves, space = next(model.parameters()).device, [], world.action_space
    for seed in seeds:
        frames: list[NDArray[np.uint8]] = []
        taken: list[NDArray[np.floating[Any]]] = []

        def act(seen: list[NDArray[np.uint8]] = frames, done: list[NDArray[np.floating[Any]]] = taken
                ) -> NDArray[np.floating[Any]]:
            seen.append(world.render())
            done.append(np.clip(world.expert_action(), space.low, space.high))
            return done[-1]

        if play_without_frames(world, act, seed, env.spec.max_episode_steps) is None:
            continue
        stacks = torch.from_numpy(stack_all([*frames, world.render()], frame_stack))
        actions = torch.from_numpy(np.stack([*taken, np.zeros_like(taken[0])]).astype(np.float32)).to(device)
        with torch.inference_mode():
            commands = past_commands(model.to_unit(actions), torch.zeros(len(actions), dtype=torch.long, device=device),
                                     model.memory)
            parts = zip(stacks.split(512), commands.split(512), strict=True)
            latents = torch.cat([model.encode(part.to(device), before) for part, before in parts]).float()
        curves.append(value_curve(model, f"expert from start {seed}", latents))
    return curves
