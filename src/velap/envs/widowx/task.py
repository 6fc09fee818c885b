"""What the two tasks share: the arm's control law, the webcam, and how contexts are numbered."""

from __future__ import annotations

from abc import abstractmethod
from functools import cache
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.pixels import FRAME_SIZE, Frame, PixelTask, shared_renderer
from velap.envs.sawyer.view import View
from velap.envs.widowx.arm import (
    ACTION_SCALE,
    ACTUATORS_XML,
    ARM_XML,
    DEFAULTS_XML,
    JOINTS,
    ROPE_BIT,
    ROTATION_SCALE,
    SPONGE_BIT,
    Kinematics,
    Vector,
)
from velap.envs.widowx.webcam import Webcam

CONTROL_STEP = 0.1
"""Duration of an environment step [s]. ours: 15,000 steps take 25 minutes then; the paper says less than an hour."""
TIME_STEP = 0.00625
"""Physics step [s]."""
LEASH = 0.02
"""Largest distance of the commanded position from the real one, along each axis [m]. ours: it limits the force on what
stands in the way, and a command in the other direction has its effect at once."""
MAX_ROTATION = np.pi / 2
"""Largest commanded rotation to either side [rad]."""
SHADOW_MAP = 128
"""Side of the shadow map [px]. ours: sharp enough for frames of 64 px."""
_CONTEXT_STREAMS = {"train": 0, "test": 1}
"""Each split numbers its own contexts: those of the training data are never test contexts."""


def scene_xml(view: View, bodies: str, equality: str = "") -> str:
    """A scene of the arm on its table with `bodies`, XML, seen by a camera that faces the robot across the table."""
    camera = " ".join(f"{value:.9g}" for value in view.axes[:2].ravel())
    position = " ".join(map(str, view.position))
    return f"""
<mujoco model="widowx">
  <compiler angle="radian"/>
  <option timestep="{TIME_STEP}" integrator="implicitfast" cone="pyramidal"/>
  <visual>
    <headlight ambient="0.35 0.35 0.35" diffuse="0.15 0.15 0.15" specular="0 0 0"/>
    <quality shadowsize="{SHADOW_MAP}" numslices="8" numstacks="4" numquads="1"/>
    <map znear="0.05" zfar="10" shadowclip="0.6"/>
  </visual>
  <statistic extent="1" center="0.25 0 0"/>
  <default>{DEFAULTS_XML}</default>
  <worldbody>
    <light directional="true" pos="0.45 -0.35 1" dir="-0.25 0.35 -1" castshadow="true" ambient="0 0 0"
           diffuse="0.55 0.54 0.52" specular="0 0 0"/>
    <camera name="webcam" pos="{position}" xyaxes="{camera}" fovy="{view.fovy}"/>
    <geom name="table" type="plane" size="0.7 0.7 0.01" rgba="0.80 0.76 0.70 1" contype="0"
          conaffinity="{SPONGE_BIT | ROPE_BIT}" friction="0.6 0.005 0.0001"/>
    {ARM_XML}
    {bodies}
  </worldbody>
  <equality>{equality}</equality>
  <actuator>{ACTUATORS_XML}</actuator>
</mujoco>"""


class WidowXTask(PixelTask):
    """The arm before something to move. A subclass says what lies there, where episodes start and when they succeed.

    It is a `ScriptedTask` (`velap.envs.protocol`).

    Actions [4]: displacement of the end effector along x, y and z, and rotation about the vertical.
    """

    low: ClassVar[Vector]
    """Least position that the end effector may be commanded to [3] [m]: within the arm's reach, fingers above the table."""
    high: ClassVar[Vector]
    """Greatest one [3] [m]."""
    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": round(1 / CONTROL_STEP)}

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        kind: Any = type(self)
        self.model = _compiled(kind).__copy__()  # contexts move bodies of the model
        self.data = mujoco.MjData(self.model)
        self._kinematics = Kinematics()
        self._ee = self.model.site("ee").id
        self._arm = np.array([self.model.joint(name).qposadr[0] for name in JOINTS])
        self._start(np.random.default_rng(0), "test", None)

    @classmethod
    @abstractmethod
    def scene(cls) -> str:
        """The scene, MuJoCo's XML."""

    @abstractmethod
    def _place(self, rng: np.random.Generator, split: str) -> None:
        """Draw a context: move the bodies of the model that it is about."""

    @abstractmethod
    def _sample_start(self, rng: np.random.Generator, split: str) -> tuple[Vector, float]:
        """A free pose of the end effector in the present context: position [3] [m] and rotation [rad]."""

    @abstractmethod
    def region(self) -> Vector:
        """The middle of the marked region [3] [m]."""

    def _start(self, rng: np.random.Generator, split: str, context: int | None) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self._webcam = Webcam(int(rng.integers(2**31)))
        self._place(rng if context is None else np.random.default_rng([_CONTEXT_STREAMS[split], context]), split)
        position, rotation = self._sample_start(rng, split)
        self.set_hand(position, rotation)
        self._settle()

    def _settle(self) -> None:
        """Let what lies there come to rest."""
        mujoco.mj_forward(self.model, self.data)

    def set_hand(self, position: Vector, rotation: float) -> None:
        """Put the hand to rest at position [3] [m] and rotation [rad]."""
        self._target, self._rotation = np.array(position, np.float64), float(rotation)
        self._joints = self._kinematics.solve(self._target, self._rotation)
        self.data.qpos[self._arm] = self.data.ctrl[:] = self._joints

    def _advance(self, action: NDArray[np.float64]) -> None:
        hand = self.agent_position()
        target = np.clip(self._target + ACTION_SCALE * action[:3], hand - LEASH, hand + LEASH)
        self._target = np.clip(target, self.low, self.high)
        self._rotation = float(np.clip(self._rotation + ROTATION_SCALE * action[3], -MAX_ROTATION, MAX_ROTATION))
        self._joints = self._kinematics.solve(self._target, self._rotation, self._joints, steps=1)
        self.data.ctrl[:] = self._joints
        mujoco.mj_step(self.model, self.data, nstep=round(CONTROL_STEP / TIME_STEP))
        mujoco.mj_forward(self.model, self.data)
        self._webcam.tick()

    def agent_position(self) -> Vector:
        """The end effector, between the finger tips [3] [m]."""
        return self.data.site_xpos[self._ee].copy()

    def command(self) -> tuple[Vector, float]:
        """Where the end effector is commanded to: position [3] [m], rotation [rad]."""
        return self._target.copy(), self._rotation

    def render(self, size: int = FRAME_SIZE) -> Frame:
        """The webcam's picture, uint8 [size, size, 3], owned by the caller."""
        return self._webcam.expose(shared_renderer(self.assets, self.model, size, SHADOW_MAP).draw(self.model, self.data))


@cache
def _compiled(task: type[WidowXTask]) -> Any:
    """The model of a task; never changed."""
    return mujoco.MjModel.from_xml_string(task.scene())
