"""What a trained model knows of scenes that no training saw: errors of a linear probe, and of rollouts of h.

Letters: S entries of a state, P entries of the agent's position, C scenes, F frames, D latent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import KFold, cross_val_predict
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from studies.exact_latents import without_drawing
from velap.config import Config
from velap.data.behaviours import random_walk
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler
from velap.envs.protocol import Mapped
from velap.evaluation.evaluate import make_env
from velap.models.velap import LatentModel
from velap.tasks import get_task
from velap.training.diagnostics import horizons
from velap.training.encoding import encode_rows

FIRST_SEED = 1000
"""Seed of the first scene. ours: validation seeds."""
SCENES, HORIZON, LENGTH = 200, 30, 40
"""Scenes that are measured, longest rollout, and length of the random walk in each [steps]."""
FOLDS = 5
"""Parts of the scenes: a probe is fitted on all but one and tried on that one."""
DIGITS = 4


@dataclass(frozen=True)
class Walks:
    """A random walk in each of some scenes that no training saw (SpiralMaze has one scene)."""

    store: FrameStore
    states: NDArray[np.float32]
    """[F, S] true states."""
    position: int
    """P: the first entries of a state."""


@lru_cache(maxsize=2)
def walks(name: str, states: bool, count: int = SCENES, length: int = LENGTH) -> Walks:
    """`count` scenes of the seeds from 1000. The agent starts anywhere and walks as in the data, until a success."""
    task = get_task(name)
    env: Any = without_drawing(task) if states else make_env(task.env_id)
    world = env.unwrapped
    mapped = isinstance(world, Mapped)
    rows: dict[str, list[Any]] = {name: [] for name in ("frames", "actions", "rewards", "terminated", "states")}
    lengths = []
    for seed in range(FIRST_SEED, FIRST_SEED + count):
        rng = np.random.default_rng([seed, 13])
        # numbered contexts are those of the data; the split `train` starts anywhere, in mazes only in those of the data
        frame, _ = world.reset(seed=seed, options={"split": "test" if mapped else "train"})
        if mapped:
            world.set_agent_position(world.free_positions(rng, 1)[0])
            frame = world.render()
        act, ended, steps = random_walk(world, task.recipe, rng), False, 0
        while True:
            rows["frames"].append(frame)
            rows["states"].append(world.true_state())
            if ended or steps == length:
                break
            action = act(frame)
            frame, reward, ended, _, _ = world.step(action)
            for name, value in (("actions", action), ("rewards", reward), ("terminated", ended)):
                rows[name].append(value)
            steps += 1
        for name, value in (("actions", np.zeros_like(action)), ("rewards", 0.0), ("terminated", False)):
            rows[name].append(value)
        lengths.append(steps)
    arrays: dict[str, Any] = {name: np.stack(values) for name, values in rows.items()}
    space, found = env.action_space, arrays.pop("states")
    store = FrameStore.from_arrays(**arrays, truncated=np.zeros(len(found), bool), episode_length=lengths,
                                   action_low=space.low, action_high=space.high, dataset_id=f"{task.name}/walks")
    return Walks(store, found, len(world.agent_position()))


@torch.inference_mode()
def measure(model: LatentModel, config: Config, unseen: Walks) -> dict[str, Any]:
    """Errors of a linear probe and of rollouts in unseen scenes, each as [mean, ends of the 95 % interval].

    `probe`: root mean square error in deviations of the states, one state a scene; `position_cm`: of the agent's position
    [cm]. `rollout`: for 1 to `HORIZON` steps, distance of h's prediction from the encoded truth in mean one-step lengths;
    `moved`: of the start from it.
    """
    store = unseen.store
    sampler = WindowSampler(store, config.train, config.model.frame_stack, next(model.parameters()).device,
                            np.empty(0, np.int64))
    chosen = store.episode_start + np.random.default_rng(FIRST_SEED).integers(store.episode_length + 1)
    latents = encode_rows(model, sampler, torch.from_numpy(chosen)).cpu().numpy()
    errors = probe(latents, unseen.states[chosen])
    deviation = unseen.states[chosen].std(0)
    told = deviation > 1e-6
    place = np.square(errors[:, : unseen.position]).sum(1)
    spans = [(int(start), int(start + length))
             for start, length in zip(store.episode_start, store.episode_length, strict=True)]
    found = horizons(model, sampler, spans, range(1, HORIZON + 1), None)
    one_step = float(found[0].moved.mean())

    def curve(field: str) -> list[list[float]]:
        return [interval(_by_walk(getattr(each, field), store.episode_length, each.length) / one_step) for each in found]

    return {"first_seed": FIRST_SEED, "scenes": len(chosen),
            "probe": root(interval(np.square(errors[:, told] / deviation[told]).mean(1))),
            "position_cm": [round(100 * value, DIGITS) for value in root(interval(place))],
            "rollout": curve("error"), "moved": curve("moved")}


def probe(latents: NDArray[np.floating[Any]], states: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Errors [C, S] of ridge regression from latents [C, D] to states [C, S], each scene by a fit on other scenes."""
    ridge = make_pipeline(StandardScaler(), RidgeCV(np.logspace(-4, 4, 9), alpha_per_target=True))
    guessed = cross_val_predict(ridge, latents.astype(np.float64), states, cv=KFold(FOLDS))
    difference: NDArray[np.float64] = guessed - states
    return difference


def _by_walk(values: torch.Tensor, lengths: NDArray[np.int64], horizon: int) -> NDArray[np.float64]:
    """Means over the starts of each walk that is long enough: they depend on each other."""
    starts = [int(length) - horizon + 1 for length in lengths if length >= horizon]
    return np.array([float(part.mean()) for part in values.cpu().split(starts)])


def interval(values: NDArray[np.floating[Any]]) -> list[float]:
    """Mean and 95 % interval (normal) of independent values."""
    mean, error = float(values.mean()), 1.96 * float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 0.0
    return [round(value, DIGITS) for value in (mean, mean - error, mean + error)]


def root(values: Sequence[float]) -> list[float]:
    """Square roots."""
    return [round(max(value, 0.0) ** 0.5, DIGITS) for value in values]
