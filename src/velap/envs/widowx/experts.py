"""Scripted experts of the two tasks: they read positions of objects, which the agents have to see.

Each is a function of the current state alone. All positions are in world axes [m], rotations about the vertical [rad].
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from velap.envs.widowx.arm import ACTION_SCALE, ROTATION_SCALE, Vector

if TYPE_CHECKING:
    from velap.envs.widowx.rope import Rope
    from velap.envs.widowx.sponge import Sponge
    from velap.envs.widowx.task import WidowXTask

Action = NDArray[np.float32]


def go(task: WidowXTask, target: Vector, rotation: float | None = None) -> Action:
    """The action that takes the commanded pose straight along each axis towards `target` [3] and `rotation`."""
    position, turned = task.command()
    turn = 0.0 if rotation is None else (rotation - turned) / ROTATION_SCALE
    return np.clip(np.append((target - position) / ACTION_SCALE, turn), -1.0, 1.0).astype(np.float32)


def push_sponge(task: Sponge) -> Action:
    """Over the sponge to its side away from the region, down, and push with the broad side of the fingers."""
    hand, sponge = task.agent_position(), task.sponge()
    way = task.region()[:2] - sponge[:2]
    ahead = way / np.linalg.norm(way)
    aside = np.array([-ahead[1], ahead[0]])
    offset = hand[:2] - sponge[:2]
    along, across = float(offset @ ahead), float(offset @ aside)
    rotation = float(np.arctan2(ahead[1], ahead[0]))
    rotation = min((rotation, rotation - np.pi, rotation + np.pi), key=lambda turn: abs(turn - task.command()[1]))
    low, high = 0.03, 0.085
    if hand[2] < 0.05 and along < -0.03 and abs(across) < 0.03:
        steer = np.clip(-across / 0.03, -1.0, 1.0)
        push = task.command()[0][:2] + 0.01 * ahead + 0.01 * steer * aside
        return go(task, np.append(push, low), rotation)
    behind = np.clip(sponge[:2] - 0.075 * ahead, task.low[:2], task.high[:2])
    if np.abs(hand[:2] - behind).max() < 0.015:
        return go(task, np.append(behind, low), rotation)
    if hand[2] < high - 0.02 and np.linalg.norm(offset) < 0.11:
        return go(task, np.append(task.command()[0][:2], high), rotation)
    return go(task, np.append(behind, high), rotation)


def unwind_rope(task: Rope) -> Action:
    """Round the pole against the rope's sense, then down onto the region."""
    hand, pole = task.agent_position(), task.pole()
    sweep, radius, height = task.sweep(), 0.085, 0.05
    if not task.unwound() or sweep < np.radians(90):
        angle = np.arctan2(hand[1] - pole[1], hand[0] - pole[0]) + 0.25
        return go(task, np.array([pole[0] + radius * np.cos(angle), pole[1] + radius * np.sin(angle), height]))
    near = np.hypot(*(hand - task.region())[:2]) < 0.02
    return go(task, np.append(task.region()[:2], 0.035 if near else height))
