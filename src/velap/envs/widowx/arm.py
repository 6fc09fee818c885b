"""A WidowX 200: its MuJoCo description and its inverse kinematics.

Joints, link lengths, limits, efforts and masses are those of Interbotix's `wx200.urdf.xacro`; the shapes are boxes, capsules
and cylinders. The gripper points straight down, so that the five joints reach any position and any rotation about the
vertical. World axes: x away from the base, y to its left, z up from the table [m].
"""

from __future__ import annotations

import mink
import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco

JOINTS = ("waist", "shoulder", "elbow", "wrist_angle", "wrist_rotate")
HOME = (0.0, 0.1874, 0.2201, 1.1633, 0.0)
"""Joint angles with the gripper above the middle of the table, pointing down [rad]."""
SOLVE_STEPS = 20
"""Steps of inverse kinematics from home to any pose of the workspace. ours: 10 come as near as 0.1 µm."""

ACTION_SCALE = 0.01
"""Displacement of the commanded position at action 1, along each axis [m/step]. ours."""
ROTATION_SCALE = 0.1
"""Displacement of the commanded rotation at action 1 [rad/step]. ours."""
GRIPPER_BIT, SPONGE_BIT, ROPE_BIT = 1, 2, 4
"""MuJoCo's contact bits of what moves: each is a `contype`, and what it touches has it in its `conaffinity`."""

Vector = NDArray[np.float64]

_GRIPPER = f'contype="{GRIPPER_BIT}" conaffinity="0" rgba="0.16 0.16 0.18 1"'
ARM_XML = f"""
<body name="base" childclass="arm">
  <geom type="box" size="0.06 0.05 0.02" pos="-0.02 0 0.02"/>
  <geom type="cylinder" size="0.04 0.016" pos="0 0 0.056"/>
  <body name="shoulder_link" pos="0 0 0.072" gravcomp="1">
    <joint name="waist" axis="0 0 1" range="-3.14158 3.14158" actuatorfrcrange="-8 8"/>
    <inertial mass="0.481" pos="0 0 0.007" diaginertia="3.8e-4 5.6e-4 5.9e-4"/>
    <geom type="box" size="0.025 0.035 0.028" pos="0 0 0.03"/>
    <body name="upper_arm_link" pos="0 0 0.03865" gravcomp="1">
      <joint name="shoulder" axis="0 1 0" range="-1.3963 1.9722" actuatorfrcrange="-18 18"/>
      <inertial mass="0.298" pos="0.012 0 0.139" diaginertia="1.7e-3 1.6e-3 1.5e-4"/>
      <geom type="capsule" size="0.018" fromto="0 0 0 0 0 0.2"/>
      <geom type="capsule" size="0.018" fromto="0 0 0.2 0.05 0 0.2"/>
      <body name="forearm_link" pos="0.05 0 0.2" gravcomp="1">
        <joint name="elbow" axis="0 1 0" range="-1.8850 1.6232" actuatorfrcrange="-13 13"/>
        <inertial mass="0.284" pos="0.121 0 0" diaginertia="6.8e-5 1.2e-3 1.2e-3"/>
        <geom type="capsule" size="0.016" fromto="0 0 0 0.2 0 0"/>
        <body name="wrist_link" pos="0.2 0 0" gravcomp="1">
          <joint name="wrist_angle" axis="0 1 0" range="-1.7453 2.1468" actuatorfrcrange="-5 5"/>
          <inertial mass="0.085" pos="0.042 0 0.011" diaginertia="3.1e-5 2.8e-5 3.2e-5"/>
          <geom type="capsule" size="0.016" fromto="0 0 0 0.065 0 0"/>
          <body name="gripper_link" pos="0.065 0 0" gravcomp="1">
            <joint name="wrist_rotate" axis="1 0 0" range="-3.14158 3.14158" actuatorfrcrange="-1 1"/>
            <inertial mass="0.16" pos="0.03 0 0" diaginertia="5e-5 6e-5 6e-5"/>
            <geom type="box" size="0.022 0.020 0.018" pos="0.02 0 0"/>
            <geom name="bar" type="box" size="0.011 0.042 0.012" pos="0.053 0 0" {_GRIPPER}/>
            <geom name="left_finger" type="box" size="0.024 0.006 0.011" pos="0.086 0.015 0" {_GRIPPER}/>
            <geom name="right_finger" type="box" size="0.024 0.006 0.011" pos="0.086 -0.015 0" {_GRIPPER}/>
            <site name="ee" pos="0.093575 0 0" size="0.004" group="4"/>
          </body>
        </body>
      </body>
    </body>
  </body>
</body>"""
"""The body tree of the arm; its class `arm` is in DEFAULTS_XML."""

DEFAULTS_XML = """
<default class="arm">
  <joint damping="1.5" armature="0.02" frictionloss="0.02"/>
  <geom rgba="0.13 0.13 0.15 1" contype="0" conaffinity="0"/>
</default>"""
ACTUATORS_XML = "\n".join(f'<position name="{joint}" joint="{joint}" kp="{gain}" kv="{gain / 12}"/>'
                          for joint, gain in zip(JOINTS, (60, 120, 120, 40, 10), strict=True))
"""Servos: position control within the efforts of the URDF."""


def pose(position: Vector, rotation: float) -> mink.SE3:
    """The end effector at position [3] [m], pointing down, rotated about the vertical by `rotation` [rad]."""
    sine, cosine = np.sin(rotation), np.cos(rotation)
    axes = np.array([[0.0, -sine, cosine], [0.0, cosine, sine], [-1.0, 0.0, 0.0]])
    return mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(axes), np.asarray(position, np.float64))


class Kinematics:
    """Joint angles for poses of the end effector, within the limits of the joints (mink)."""

    def __init__(self) -> None:
        model = mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler angle="radian"/><default>{DEFAULTS_XML}</default><worldbody>{ARM_XML}</worldbody></mujoco>')
        self._configuration = mink.Configuration(model, np.array(HOME))
        self._task = mink.FrameTask("ee", "site", position_cost=1.0, orientation_cost=0.1)
        self._limits = [mink.ConfigurationLimit(model)]

    def solve(self, position: Vector, rotation: float, start: Vector | None = None, steps: int = SOLVE_STEPS) -> Vector:
        """Joint angles [5] [rad] whose pose is nearest to position [3] [m] and rotation [rad].

        Found in `steps` steps from the angles `start` [5], by default HOME, so that they depend on the target alone.
        """
        configuration = self._configuration
        configuration.update(np.array(HOME) if start is None else start)
        self._task.set_target(pose(position, rotation))
        for _ in range(steps):
            velocity = mink.solve_ik(configuration, [self._task], 1.0, "daqp", damping=1e-4, limits=self._limits)
            configuration.integrate_inplace(velocity, 1.0)
        return configuration.q.copy()

