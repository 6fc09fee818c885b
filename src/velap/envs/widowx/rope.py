"""Rope (App. E.1): unwind a rope from a pole and bring its held end to a marked region.

ours: the paper gives no dimensions. The other end is tied to a clamp beside the pole. At the start the rope goes the long
way round the pole, so that it is too short to let the held end into the region nearby; once the hand has led it back round
the pole, it is long enough. Letters: S segments.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.sawyer.view import View
from velap.envs.widowx import experts
from velap.envs.widowx.arm import GRIPPER_BIT, ROPE_BIT, Vector
from velap.envs.widowx.task import CONTROL_STEP, TIME_STEP, WidowXTask, scene_xml

SEGMENTS = 11
"""Capsules of the chain."""
LENGTH = 0.185
"""Length of the rope [m]."""
ROPE_RADIUS = 0.006
"""[m]"""
POLE_RADIUS = 0.026
"""[m]"""
POLE_HEIGHT = 0.10
"""Higher than the hand may lift the rope [m]."""
CLAMP = np.array([0.0, -0.06, 0.012])
"""Where the rope is tied, from the foot of the pole [3] [m]."""
REGION_RADIUS = 0.025
"""Radius of the marked region [m]."""
PLACED = 0.045
"""Greatest height of a held end that is placed on the region [m]."""
_POLES = np.array([0.235, -0.01]), np.array([0.255, 0.01])
"""Where the foot of the pole stands [m]: low and high corner."""
_REGIONS = np.array([0.087, 0.087]), np.array([0.097, 0.097])
"""Where the middle of the region is, from the foot of the pole [m]: low and high corner."""
_STARTS, _NEAR_STARTS, _TEST_STARTS = ((-250, 160), (0.07, 0.15)), ((75, 160), (0.07, 0.15)), ((-245, -210), (0.075, 0.085))
"""Where the held end starts in data, in those of them that are near the goal, and in tests: the rope's sweep round the pole
[degrees] and the distance from the pole [m]."""
NEAR_SHARE = 0.35
"""Share of data episodes that start near the goal, the rope unwound. ours."""
SETTLE_STEPS = 8
"""Control steps in which a laid rope comes to rest [steps]."""
_GAP = POLE_RADIUS + ROPE_RADIUS + 0.001


def _segment_xml(number: int) -> str:
    """The segment of that number and all that follow it."""
    size, inner = LENGTH / SEGMENTS, ""
    if number + 1 < SEGMENTS:
        inner = _segment_xml(number + 1)
    position = "0 0 0" if number == 0 else f"{size} 0 0"
    tip = f'<site name="tip" pos="{size} 0 0" size="0.002" group="4"/>' if number + 1 == SEGMENTS else ""
    return f"""<body name="rope{number}" pos="{position}">
      <joint name="rope{number}" type="ball" damping="0.0003" armature="2e-5" stiffness="0.0005"/>
      <geom type="capsule" size="{ROPE_RADIUS}" fromto="0 0 0 {size} 0 0" mass="0.004" rgba="0.10 0.62 0.22 1"
            contype="{ROPE_BIT}" conaffinity="0" condim="1"/>{tip}{inner}</body>"""


def lay(sweep: float, start: Vector, end: Vector, angle: float, length: float) -> Vector | None:
    """A curve round the origin from start[3] to end[3] [m] that sweeps `sweep` [rad] and is `length` [m] long.

    `angle` is that of the start. The radius goes from one end's to the other's with a bump, which is as large as the length
    asks for, but not below the pole's. Gives its S + 1 corners, equally far apart, or None where the rope is too short.
    """
    part = np.linspace(0.0, 1.0, 200)
    radii = np.hypot(start[0], start[1]) * (1 - part) + np.hypot(end[0], end[1]) * part
    turned = angle + sweep * part

    def curve(bump: float) -> tuple[Vector, Vector]:
        radius = np.maximum(radii + bump * np.sin(np.pi * part), _GAP)
        points = np.stack([radius * np.cos(turned), radius * np.sin(turned), start[2] + (end[2] - start[2]) * part], -1)
        return points, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=-1))])

    low, high = -0.3, 0.3
    if curve(low)[1][-1] > length:
        return None
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (middle, high) if curve(middle)[1][-1] < length else (low, middle)
    points, along = curve(low)
    at = np.linspace(0.0, along[-1], SEGMENTS + 1)
    return np.stack([np.interp(at, along, points[:, axis]) for axis in range(3)], -1)


class Rope(WidowXTask):
    """Done when the rope is off the pole and its held end on the region. A context is a place of pole and clamp."""

    assets: ClassVar[str] = "widowx rope"
    view: ClassVar[View] = View(position=(0.60, 0.06, 0.54), target=(0.25, -0.01, 0.02), fovy=31.5)
    _corners: Vector
    """Of the rope when it is laid, from the foot of the pole [S + 1, 3] [m]."""
    low, high = np.array([0.15, -0.12, 0.025]), np.array([0.36, 0.13, 0.07])

    @classmethod
    def scene(cls) -> str:
        """A green rope from a clamp to the hand, a red pole, and a blue disc."""
        x, y, z = CLAMP
        return scene_xml(cls.view, f"""
    <body name="region">
      <geom type="cylinder" size="{REGION_RADIUS} 0.0005" pos="0 0 0.0005" rgba="0.12 0.30 0.75 1" contype="0"
            conaffinity="0"/>
    </body>
    <body name="pole" pos="0.245 0 0">
      <geom name="pole" type="capsule" size="{POLE_RADIUS}" fromto="0 0 0 0 0 {POLE_HEIGHT - POLE_RADIUS}"
            rgba="0.75 0.30 0.18 1" contype="0" conaffinity="{GRIPPER_BIT | ROPE_BIT}" condim="1"/>
      <geom name="clamp" type="box" size="0.01 0.01 {z}" pos="{x} {y - 0.008} {z}" rgba="0.30 0.30 0.34 1" contype="0"
            conaffinity="0"/>
      <body pos="{x} {y} {z}">{_segment_xml(0)}</body>
    </body>""", '<connect site1="tip" site2="ee" solref="0.01 1" solimp="0.95 0.99 0.002"/>')

    def _place(self, rng: np.random.Generator, split: str) -> None:
        pole = rng.uniform(*_POLES)
        self.model.body("pole").pos[:2] = pole
        self.model.body("region").pos[:2] = pole + rng.uniform(*_REGIONS)

    def _sample_start(self, rng: np.random.Generator, split: str) -> tuple[Vector, float]:
        pole = self.pole()
        angle, near = float(np.arctan2(CLAMP[1], CLAMP[0])), rng.random() < NEAR_SHARE
        while True:
            (least, most), radii = _TEST_STARTS if split == "test" else _NEAR_STARTS if near else _STARTS
            sweep, radius = np.radians(rng.uniform(least, most)), rng.uniform(*radii)
            turned = angle + sweep
            position = pole + np.array([radius * np.cos(turned), radius * np.sin(turned), rng.uniform(0.03, 0.06)])
            done = np.hypot(*(position - self.region())[:2]) < REGION_RADIUS + 0.005
            if done or ((position < self.low) | (position > self.high)).any():
                continue
            corners = lay(sweep, CLAMP, position - pole, angle, LENGTH)
            if corners is not None:
                self._corners = corners
                return position, rng.uniform(-0.6, 0.6)

    def _settle(self) -> None:
        """Lay the rope along its corners and let it come to rest."""
        before, quaternion = np.eye(3), np.empty(4)
        for number, (x, y, z) in enumerate(np.diff(self._corners, axis=0)):
            yaw, pitch = np.arctan2(y, x), -np.arctan2(z, np.hypot(x, y))
            (sy, cy), (sp, cp) = (np.sin(yaw), np.cos(yaw)), (np.sin(pitch), np.cos(pitch))
            axes = np.array([[cy * cp, -sy, cy * sp], [sy * cp, cy, sy * sp], [-sp, 0.0, cp]])
            mujoco.mju_mat2Quat(quaternion, (before.T @ axes).ravel())
            self.data.joint(f"rope{number}").qpos = quaternion
            before = axes
        mujoco.mj_step(self.model, self.data, nstep=SETTLE_STEPS * round(CONTROL_STEP / TIME_STEP))
        self.data.qvel[:] = 0
        mujoco.mj_forward(self.model, self.data)

    def pole(self) -> Vector:
        """The pole's foot [3] [m]."""
        return self.model.body("pole").pos.copy()

    def region(self) -> Vector:
        """The middle of the marked region [3] [m]."""
        return self.model.body("region").pos.copy()

    def points(self) -> Vector:
        """The rope's joints and its held end, from the foot of the pole [S + 1, 3] [m]."""
        first = self.model.body("rope0").id
        ends = np.concatenate([self.data.xpos[first : first + SEGMENTS], self.agent_position()[None]])
        return ends - self.pole()

    def sweep(self) -> float:
        """The angle that the rope sweeps round the pole from the clamp to the held end, counter-clockwise [rad]."""
        points = self.points()
        angles = np.unwrap(np.arctan2(points[:, 1], points[:, 0]))
        return float(angles[-1] - angles[0])

    def unwound(self) -> bool:
        """Does the rope go the short way from the clamp to the region, where its sweep is 135 degrees and not -225?"""
        return self.sweep() > np.radians(-45)

    def on_region(self) -> bool:
        """Is the held end on the region?"""
        hand = self.agent_position()
        return bool(np.hypot(*(hand - self.region())[:2]) <= REGION_RADIUS and hand[2] <= PLACED)

    def subtasks(self) -> tuple[bool, bool]:
        """What is done now, in the order that it has to be done: rope unwound, held end on the region."""
        return self.unwound(), self.on_region()

    def succeeded(self) -> bool:
        """Is the rope unwound and its held end on the region?"""
        return all(self.subtasks())

    def true_state(self) -> NDArray[np.float32]:
        """Hand [3] [m], its rotation [rad], rope from the pole's foot [3 (S + 1)], x and y of pole and region [4] [m]."""
        places = np.concatenate([self.pole()[:2], self.region()[:2]])
        return np.concatenate([self.agent_position(), [self.command()[1]], self.points().ravel(), places]).astype(np.float32)

    def in_test_region(self) -> bool:
        """Is the hand near the region and the rope still wrapped?"""
        return bool(np.hypot(*(self.agent_position() - self.region())[:2]) < 0.09) and self.sweep() < np.radians(-180)

    def expert_distance(self) -> float:
        """The way of the held end round the pole to the region, at least the straight one [m]."""
        target = self.region() - self.pole()
        missing = np.arctan2(target[1], target[0]) - np.arctan2(CLAMP[1], CLAMP[0]) - self.sweep()
        straight = np.hypot(*(self.agent_position() - self.region())[:2])
        return float(max(straight, 0.1 * abs(missing)))

    expert_action = experts.unwind_rope
