"""How data are made: behaviours choose actions, a trajectory's seed fixes it whatever process runs it.

Letters: T transitions of one trajectory (it has T + 1 frames), A action entries, P entries of a position, H×W image [px].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from velap.data.gamepad import gamepad_play, gamepad_purpose
from velap.envs.protocol import HasTestRegion, Positioned, ScriptedTask
from velap.tasks import Recipe

Policy = Callable[[np.ndarray], np.ndarray]
"""Frame uint8 [H, W, 3] → action float [A] within the action space."""
Behaviour = Callable[[gym.Env, Recipe, np.random.Generator], Policy]
"""Called at the start of a trajectory, after the reset."""


def random_walk(env: gym.Env, recipe: Recipe, rng: np.random.Generator) -> Policy:
    """a_0 uniform in [-1, 1], then clipped Gaussian steps of `recipe.action_noise` (C.1.1), scaled to the action space."""
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    walk = rng.uniform(-1.0, 1.0, space.shape)
    first = True

    def act(frame: np.ndarray) -> np.ndarray:
        nonlocal walk, first
        if not first:
            walk = np.clip(walk + rng.normal(0.0, recipe.action_noise, space.shape), -1.0, 1.0)
        first = False
        return (low + 0.5 * (walk + 1.0) * (high - low)).astype(np.float32)

    return act


def noisy_expert(env: gym.Env, recipe: Recipe, rng: np.random.Generator) -> Policy:
    """The random walk; within `recipe.expert_radius` of the goal the expert, with Gaussian noise of `recipe.expert_noise`.

    Once the agent has been where test episodes start, the expert stays silent for the rest of the trajectory: what leads
    from there to success has to be stitched together (C.2).
    """
    space, task = env.action_space, env.unwrapped
    assert isinstance(space, gym.spaces.Box) and isinstance(task, ScriptedTask)
    walk, silent = random_walk(env, recipe, rng), False

    def act(frame: np.ndarray) -> np.ndarray:
        nonlocal silent
        silent = silent or task.in_test_region()
        if silent or task.expert_distance() > recipe.expert_radius:
            return walk(frame)
        noise = rng.normal(0.0, recipe.expert_noise, space.shape)
        return np.clip(task.expert_action() + noise, space.low, space.high).astype(np.float32)

    return act


BEHAVIOURS: dict[str, Behaviour] = {
    "random-walk": random_walk,
    "noisy-expert": noisy_expert,
    "gamepad-play": gamepad_play,
    "gamepad-purpose": gamepad_purpose,
}
"""Behaviours by name."""


def reset_options(context: int) -> dict[str, Any]:
    """Reset options of data collection in the context of that number."""
    return {"split": "train", "context": context}


def position_of(env: gym.Env) -> np.ndarray:
    """float32 [P] position of the agent [m], P = 0 where the environment does not tell."""
    task = env.unwrapped
    return np.asarray(task.agent_position(), np.float32) if isinstance(task, Positioned) else np.zeros(0, np.float32)


def run_trajectory(env: gym.Env, recipe: Recipe, shares: Mapping[str, float], seed: int, context: int,
                   trajectory: int) -> dict[str, np.ndarray]:
    """One trajectory: rows of a frame store, and what is known of it.

    Its random numbers depend on (seed, context, trajectory) alone. It ends at a reward, at the environment's own end, or as
    truncated after `recipe.max_steps`.

    Returns:
        frames uint8 [T+1, H, W, 3], actions float32 [T+1, A], rewards float32 [T+1], terminated and truncated bool [T+1],
        positions float32 [T+1, P]; length, reset_seed, context, behaviour, from_test int64 [1]. `from_test` is 1 if it leads
        from where test episodes start to a reward, else 0, or -1 where the environment does not tell.
    """
    reset_stream, policy_stream = np.random.SeedSequence(entropy=seed, spawn_key=(context, trajectory)).spawn(2)
    reset_seed = int(reset_stream.generate_state(1)[0])
    rng = np.random.default_rng(policy_stream)
    names = sorted(shares)
    chosen = int(rng.choice(len(names), p=[shares[name] for name in names]))
    frame, _ = env.reset(seed=reset_seed, options=reset_options(context))
    policy = BEHAVIOURS[names[chosen]](env, recipe, rng)
    task = env.unwrapped
    tells = isinstance(task, HasTestRegion)
    visited = tells and task.in_test_region()
    frames, positions = [np.array(frame)], [position_of(env)]
    steps: list[tuple[np.ndarray, float, bool, bool]] = []
    while len(steps) < recipe.max_steps:
        action = policy(frames[-1])
        frame, reward, terminated, truncated, _ = env.step(action)
        frames.append(np.array(frame))
        positions.append(position_of(env))
        full = len(steps) + 1 == recipe.max_steps
        steps.append((action, float(reward), bool(terminated), bool((truncated or full) and not terminated)))
        if terminated or truncated:
            break
        visited = visited or (tells and task.in_test_region())
    actions, rewards, ends, cuts = zip(*steps, strict=True)
    return {
        "frames": np.stack(frames),
        "actions": np.stack([*actions, np.zeros_like(actions[0])]).astype(np.float32),
        "rewards": np.array([*rewards, 0.0], np.float32),
        "terminated": np.array([*ends, False]),
        "truncated": np.array([*cuts, False]),
        "positions": np.stack(positions),
        "length": np.array([len(steps)]),
        "reset_seed": np.array([reset_seed]),
        "context": np.array([context]),
        "behaviour": np.array([chosen]),
        "from_test": np.array([int(visited and rewards[-1] > 0) if tells else -1]),
    }
