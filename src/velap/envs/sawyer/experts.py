"""Scripted experts of the manipulation tasks: they read positions of objects, which the agents have to see.

Each is a function of the current state alone, so that it continues from anywhere. The gripper is a pair of fingers at ±5 cm
along y, 3 cm wide along x, from 5 cm below the hand to the gripper's base above it. All positions are [3] [m] in world axes:
x right, y away from the arm's base, z up.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from velap.envs.sawyer.physics import ACTION_SCALE

if TYPE_CHECKING:
    from velap.envs.sawyer.tasks import ButtonWall, DrawerButton, FaucetClose, WindowClose

Action = NDArray[np.float32]
Vector = NDArray[np.float64]

_OPEN, _CLOSE = -1.0, 1.0


def go(mocap: Vector, target: Vector, grip: float = _CLOSE) -> Action:
    """The action that pulls the mocap body from `mocap` straight along each axis towards `target`."""
    return np.append(np.clip((target - mocap) / ACTION_SCALE, -1.0, 1.0), grip).astype(np.float32)


def close_window(task: WindowClose) -> Action:
    """Go round in front of the handle to its right side, then shove it to the left with the gripper's base."""
    hand, mocap, handle = task.agent_position(), task.mocap_position(), task.handle()
    y, z = handle[1] - 0.03, handle[2] - 0.08  # the gripper's base is 7 cm above the hand
    if hand[0] < handle[0] + 0.015:
        front = handle[1] - 0.14
        if hand[1] > front + 0.03:  # beside or behind the handle on its left side: come out first
            return go(mocap, np.array([hand[0], front, mocap[2]]))
        return go(mocap, np.array([handle[0] + 0.08, front, z]))
    if max(abs(hand[1] - y), abs(hand[2] - z)) > 0.025:
        return go(mocap, np.array([max(handle[0] + 0.06, min(hand[0], handle[0] + 0.1)), y, z]))
    return go(mocap, np.array([mocap[0] - ACTION_SCALE, y, z]))


def close_faucet(task: FaucetClose) -> Action:
    """Come over the handle to its right side, go down, and turn the handle to the left."""
    hand, mocap, axis = task.agent_position(), task.mocap_position(), task.axis()
    across, along = task.handle_frame()  # unit vectors: from the handle's left to its right side, from the axis to the tip
    offset = hand - axis
    side, reach = float(offset @ across), float(offset @ along)
    low, high = axis[2] + 0.01, axis[2] + 0.1
    aim = axis + 0.14 * along
    if side < 0.025:
        beside = aim + 0.075 * across
        if hand[2] < high - 0.02 and reach < 0.27:  # on the wrong side of the handle: over it, not through it
            return go(mocap, np.array([*mocap[:2], high + 0.01]))
        return go(mocap, np.array([*beside[:2], high + 0.01]))
    if hand[2] > low + 0.02 or abs(reach - 0.14) > 0.04:
        beside = aim + max(0.06, min(side, 0.09)) * across
        clear = side > 0.045
        return go(mocap, np.array([*beside[:2], low if clear else mocap[2]]))
    push = mocap - ACTION_SCALE * across + (0.14 - reach) * along
    return go(mocap, np.array([*push[:2], low]))


def press(mocap: Vector, hand: Vector, button: Vector) -> Action:
    """Line up before the button's face and push it in with the far finger."""
    height = button[2] + 0.035
    if abs(hand[0] - button[0]) > 0.025 or abs(hand[2] - height) > 0.03:
        return go(mocap, np.array([button[0], button[1] - 0.09, height]))
    return go(mocap, np.array([button[0], mocap[1] + ACTION_SCALE, height]))


def press_behind_wall(task: ButtonWall) -> Action:
    """Go round the nearer end of the wall, then press the button."""
    hand, mocap, wall, button = task.agent_position(), task.mocap_position(), task.wall(), task.button()
    if hand[1] > wall[1] + 0.06:
        return press(mocap, hand, button)
    side = 1.0 if hand[0] >= wall[0] else -1.0
    past = wall[0] + side * (task.wall_half_width + 0.05)
    height = button[2] + 0.03
    if (past - hand[0]) * side > 0.015:  # still in the lee of the wall
        return go(mocap, np.array([past + side * 0.005, min(mocap[1], wall[1] - 0.1), height]))
    return go(mocap, np.array([past, wall[1] + 0.1, height]))


def close_drawer(task: DrawerButton) -> Action:
    """Come before the handle, over the drawer where needed, and push."""
    hand, mocap, handle = task.agent_position(), task.mocap_position(), task.drawer_handle()
    front, high = handle[1] - 0.075, 0.26
    x = float(np.clip(hand[0], handle[0] - 0.03, handle[0] + 0.03))
    before = hand[1] < handle[1] - 0.05
    if before and abs(hand[0] - handle[0]) < 0.05 and abs(hand[2] - handle[2]) < 0.035:
        return go(mocap, np.array([x, mocap[1] + ACTION_SCALE, handle[2]]))
    if before:
        return go(mocap, np.array([x, front, handle[2]]))
    if hand[2] < high - 0.03 and abs(hand[0] - handle[0]) < 0.19:
        return go(mocap, np.array([*mocap[:2], high]))
    return go(mocap, np.array([x, front - 0.01, max(high, mocap[2]) if abs(hand[0] - handle[0]) < 0.19 else mocap[2]]))


def close_then_press(task: DrawerButton) -> Action:
    """Close the drawer, come back, press the button."""
    if not task.drawer_closed():
        return close_drawer(task)
    hand, mocap, button = task.agent_position(), task.mocap_position(), task.button()
    front = min(task.drawer_handle()[1], button[1]) - 0.08
    if abs(hand[0] - button[0]) > 0.16:  # still before the drawer: step back, then sideways
        sideways = button[0] if hand[1] < task.drawer_handle()[1] - 0.04 else mocap[0]
        return go(mocap, np.array([sideways, front, button[2] + 0.035]))
    return press(mocap, hand, button)
