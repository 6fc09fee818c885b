"""Sponge (App. E.1): push a sponge onto a marked region; the hand starts between the two."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from velap.envs.sawyer.view import View
from velap.envs.widowx import experts
from velap.envs.widowx.arm import GRIPPER_BIT, SPONGE_BIT, Vector
from velap.envs.widowx.task import WidowXTask, scene_xml

HALF_SIZE = (0.045, 0.030, 0.0175)
"""Half the sponge's length, width and height [m]: a kitchen sponge."""
REGION_HALF = 0.045
"""Half the side of the marked region [m]."""
REGION = np.array([0.25, 0.125])
"""The middle of the marked region [m]."""
_SPONGES = {
    "near": (np.array([0.20, 0.00]), np.array([0.30, 0.07])),
    "anywhere": (np.array([0.20, -0.11]), np.array([0.30, 0.11])),
    "test": (np.array([0.21, -0.10]), np.array([0.29, -0.04])),
}
"""Where the sponge's centre starts [m]: low and high corners of boxes."""
_TEST_HANDS = np.array([0.20, 0.04, 0.03]), np.array([0.30, 0.075, 0.06])
"""Where the hand starts in tests [m]: between sponge and region, low."""
NEAR_SHARE, NEAR_HAND_SHARE = 0.5, 0.7
"""Shares of data episodes whose sponge starts near the region, and whose hand starts near the sponge. ours."""
_NEAR = np.array([0.06, 0.13, 0.02]), np.array([0.06, 0.05, 0.06])
"""How near that is to either side along each axis [m]: rather behind the sponge than before it."""
_MAX_TURN = 0.6
"""Largest rotation of sponge and hand at the start [rad]."""


class Sponge(WidowXTask):
    """Done when the sponge's centre is over the marked region. A context is a pose of the sponge."""

    assets: ClassVar[str] = "widowx sponge"
    view: ClassVar[View] = View(position=(0.60, 0.06, 0.54), target=(0.225, -0.01, 0.02), fovy=38.0)
    low, high = np.array([0.17, -0.18, 0.025]), np.array([0.32, 0.18, 0.11])

    @classmethod
    def scene(cls) -> str:
        """A yellow sponge with a green scouring side, and a blue square."""
        x, y, z = HALF_SIZE
        return scene_xml(cls.view, f"""
    <geom name="region" type="box" size="{REGION_HALF} {REGION_HALF} 0.0005" pos="{REGION[0]} {REGION[1]} 0.0005"
          rgba="0.12 0.30 0.75 1" contype="0" conaffinity="0"/>
    <body name="sponge" pos="0.25 -0.07 {z}">
      <joint name="sponge_x" type="slide" axis="1 0 0"/>
      <joint name="sponge_y" type="slide" axis="0 1 0"/>
      <joint name="sponge_z" type="slide" axis="0 0 1"/>
      <joint name="sponge_ball" type="ball"/>
      <geom name="sponge" type="box" size="{x} {y} {z}" mass="0.05" contype="{SPONGE_BIT}"
            conaffinity="{GRIPPER_BIT}" friction="0.6 0.005 0.0001" solref="0.03 1" solimp="0.8 0.95 0.004" rgba="0 0 0 0"/>
      <geom type="box" size="{x} {y} {0.7 * z}" pos="0 0 {-0.3 * z}" mass="0" contype="0" conaffinity="0"
            rgba="0.95 0.78 0.12 1"/>
      <geom type="box" size="{x} {y} {0.3 * z}" pos="0 0 {0.7 * z}" mass="0" contype="0" conaffinity="0"
            rgba="0.15 0.50 0.22 1"/>
    </body>""")

    def _place(self, rng: np.random.Generator, split: str) -> None:
        where = "test" if split == "test" else "near" if rng.random() < NEAR_SHARE else "anywhere"
        body, place = self.model.body("sponge"), REGION
        while np.abs(place - REGION).max() <= REGION_HALF + 0.005:
            place = rng.uniform(*_SPONGES[where])
        body.pos = *place, HALF_SIZE[2]
        turn = rng.uniform(-_MAX_TURN, _MAX_TURN)
        body.quat = np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2)

    def _sample_start(self, rng: np.random.Generator, split: str) -> tuple[Vector, float]:
        reach, sponge = np.hypot(*HALF_SIZE[:2]) + 0.03, self.model.body("sponge").pos
        low, high = _TEST_HANDS if split == "test" else (self.low, self.high)
        if split == "train" and rng.random() < NEAR_HAND_SHARE:
            low, high = np.maximum(low, sponge - _NEAR[0]), np.minimum(high, sponge + _NEAR[1])
        while True:
            position = rng.uniform(low, high)
            if np.linalg.norm(position[:2] - sponge[:2]) > reach or position[2] > 0.07:
                return position, rng.uniform(-_MAX_TURN, _MAX_TURN)

    def region(self) -> Vector:
        """The middle of the marked region [3] [m]."""
        return np.append(REGION, 0.0)

    def sponge(self) -> Vector:
        """The sponge's centre [3] [m]."""
        return self.data.body("sponge").xpos.copy()

    def succeeded(self) -> bool:
        """Is the sponge's centre over the region?"""
        return bool(np.abs(self.sponge()[:2] - REGION).max() <= REGION_HALF)

    def in_test_region(self) -> bool:
        """Is the sponge far from the region and the hand between them?"""
        hand, (low, high), sponge = self.agent_position(), _SPONGES["test"], self.sponge()[:2]
        far = bool(((sponge >= low - 0.005) & (sponge <= high + 0.005)).all())
        return far and bool(((hand >= _TEST_HANDS[0] - 0.005) & (hand <= _TEST_HANDS[1] + 0.005)).all())

    def objects(self) -> NDArray[np.float64]:
        """The sponge [1, 3] [m]."""
        return self.sponge()[None]

    def true_state(self) -> NDArray[np.float32]:
        """Hand [3] [m], its rotation [rad], sponge [3] [m] and its rotation matrix's first column [3]."""
        along = self.data.body("sponge").xmat.reshape(3, 3)[:, 0]
        return np.concatenate([self.agent_position(), [self.command()[1]], self.sponge(), along]).astype(np.float32)

    def expert_distance(self) -> float:
        """From the sponge to the middle of the region [m]."""
        return float(np.linalg.norm(self.sponge()[:2] - REGION))

    expert_action = experts.push_sponge
