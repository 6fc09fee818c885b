"""An arm's operator with a gamepad (App. E.1): presses along one axis or two, at full or half tilt, held for some steps.

ours: the paper says that its data were made with a gamepad and are largely suboptimal or entirely random. Actions [4] are
displacements along x, y and z, and a rotation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import gymnasium as gym
import numpy as np

from velap.envs.protocol import ScriptedTask

if TYPE_CHECKING:
    from velap.data.behaviours import Policy
    from velap.tasks import Recipe

PAUSE_SHARE = 0.15
"""Share of decisions to pause."""
DETOUR_SHARE = 0.12
"""Share of decisions of a purposeful operator to press at random."""
TWO_AXES_SHARE = 0.3
"""Share of presses along two axes: both sticks at once."""
PLAY_STEPS = (2, 9)
"""A random press is held so long: from, and below [steps]."""
PURPOSE_STEPS = (1, 5)
"""A purposeful press or a pause is held so long: from, and below [steps]."""
GIVE_UP = 0.7
"""Share of `recipe.expert_radius` at which an operator gives up who has come from further away."""
_LIFT = np.array([0.0, 0.0, 1.0, 0.0])
_LIFT_STEPS = 10
"""Steps that bring the hand to its greatest height [steps]."""


def gamepad_play(env: gym.Env, recipe: Recipe, rng: np.random.Generator) -> Policy:
    """Random presses."""
    return _operator(env, recipe, rng, purposeful=False)


def gamepad_purpose(env: gym.Env, recipe: Recipe, rng: np.random.Generator) -> Policy:
    """What the scripted expert would do, but along one or two axes at a time, with pauses and detours."""
    return _operator(env, recipe, rng, purposeful=True)


def _operator(env: gym.Env, recipe: Recipe, rng: np.random.Generator, purposeful: bool) -> Policy:
    """Both behaviours.

    An operator who started further than `recipe.expert_radius` from the goal, or who has been where test episodes start,
    lifts the hand at `GIVE_UP` of that distance and presses at random above everything for the rest of the trajectory: all
    successes start near the goal, and the way from a test start to success has to be stitched together.
    """
    task = env.unwrapped
    assert isinstance(task, ScriptedTask)
    far = task.expert_distance() > recipe.expert_radius
    press, left, lifted = np.zeros(4), 0, 0

    def decide() -> tuple[np.ndarray, int]:
        if rng.random() < PAUSE_SHARE:
            return np.zeros(4), int(rng.integers(*PURPOSE_STEPS))
        if not purposeful or lifted or rng.random() < DETOUR_SHARE:
            return _random_press(rng), int(rng.integers(*PLAY_STEPS))
        return _press_towards(task.expert_action().astype(np.float64), rng), int(rng.integers(*PURPOSE_STEPS))

    def act(frame: np.ndarray) -> np.ndarray:
        nonlocal press, left, far, lifted
        far = far or task.in_test_region()
        if lifted or (far and task.expert_distance() < GIVE_UP * recipe.expert_radius):
            lifted += 1
            if lifted <= _LIFT_STEPS:
                return _LIFT.astype(np.float32)
        if left == 0:
            press, left = decide()
        left -= 1
        return (press * (1.0 - _LIFT) if lifted else press).astype(np.float32)

    return act


def _random_press(rng: np.random.Generator) -> np.ndarray:
    """One axis or two at random [4], full or half tilt."""
    axes, press = rng.choice(4, size=1 + int(rng.random() < TWO_AXES_SHARE), replace=False), np.zeros(4)
    press[axes] = rng.choice([-1.0, 1.0], size=len(axes)) * rng.choice([0.5, 1.0])
    return press


def _press_towards(wanted: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One axis or two of `wanted` [4], drawn by their size, full or half tilt [4]."""
    size, press = np.abs(wanted), np.zeros(4)
    count = min(1 + int(rng.random() < TWO_AXES_SHARE), int(np.count_nonzero(size)))
    if count:
        axes = rng.choice(4, size=count, replace=False, p=size / size.sum())
        press[axes] = np.sign(wanted[axes]) * np.where(size[axes] > 0.5, 1.0, 0.5)
    return press
