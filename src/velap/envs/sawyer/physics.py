"""The Sawyer arm of Meta-World 3.1.1 under its own control law (App. C.2): physics, contexts and starts.

The scenes are Meta-World's own XML files, and a step does what Meta-World's step does to the physics, to the last bit: an
action moves a mocap body that the hand is welded to, and opens or closes the gripper. Its observations and shaped rewards
are left out; they cost more than the physics. World axes: x to the right, y away from the arm's base, z up from the table
[m].
"""

from __future__ import annotations

import importlib.util
import os
import threading
from abc import abstractmethod
from functools import cache
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray

from velap.envs.gl import mujoco
from velap.envs.pixels import FRAME_SIZE, Frame, PixelTask
from velap.envs.sawyer.scene import SawyerScene, load_drawing
from velap.errors import ConfigError, VelapError

ACTION_SCALE = 0.01
"""Way of the mocap body at action 1, along each axis [m/step]; Meta-World's `action_scale`."""
FRAME_SKIP = 5
"""Physics steps of 2.5 ms in a control step; Meta-World's `frame_skip`."""
SETTLE_STEPS = 80
"""Control steps that bring the hand from home to a start, without contacts [steps]. ours: Meta-World takes 50 to its one
start, ours are up to 0.5 m away; what is left of the way after 80 steps is 4 mm, the weld's give under the arm's weight."""
_HOME = (0.0, 0.6, 0.2)
_HAND_QUATERNION = (1.0, 0.0, 1.0, 0.0)
_WELD = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 5.0)
"""Meta-World's `reset_mocap_welds`: anchor, relative pose, torque scale."""
_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_MAX_TRIES = 200

Vector = NDArray[np.float64]
"""A position [3] [m]."""


def asset_directory() -> Path:
    """Where Meta-World keeps its scenes, meshes and textures."""
    found = importlib.util.find_spec("metaworld")
    if found is None or not found.submodule_search_locations:
        raise ConfigError("Meta-World is not installed; expected the package metaworld 3.1.1, whose assets make the scenes. "
                          "`pip install metaworld==3.1.1`.")
    return Path(found.submodule_search_locations[0]) / "assets"


def scene_xml(objects: tuple[str, ...], bodies: str) -> str:
    """A scene of Meta-World's arm and table with `bodies`, XML in which `{name}` stands for the file of an object."""
    assets = asset_directory()
    parts = assets / "objects" / "assets"
    needed = "\n".join(f'<include file="{parts / name}_dependencies.xml"/>' for name in objects)
    inside = bodies.format(**{name: f'<include file="{parts / name}.xml"/>' for name in objects})
    return f"""
<mujoco>
  <compiler meshdir="{assets / "sawyer_xyz"}" texturedir="{assets / "sawyer_xyz"}"/>
  <include file="{assets / "scene" / "basic_scene.xml"}"/>
  <include file="{parts / "xyz_base_dependencies.xml"}"/>
  {needed}
  <worldbody>
    <include file="{parts / "xyz_base.xml"}"/>
    {inside}
  </worldbody>
  <actuator>
    <position ctrllimited="true" ctrlrange="-1 1" joint="r_close" kp="400" user="1"/>
    <position ctrllimited="true" ctrlrange="-1 1" joint="l_close" kp="400" user="1"/>
  </actuator>
  <equality><weld body1="mocap" body2="hand" solref="0.02 1"/></equality>
</mujoco>"""


class Box:
    """An axis-aligned region of hand positions [m]."""

    def __init__(self, low: ArrayLike, high: ArrayLike) -> None:
        self.low, self.high = np.array(low, np.float64), np.array(high, np.float64)

    def around(self, centre: Vector, half_sizes: tuple[float, float, float]) -> Box:
        """The part of this box within half_sizes[3] of centre[3] [m]."""
        return Box(np.maximum(self.low, centre - half_sizes), np.minimum(self.high, centre + half_sizes))

    def sample(self, rng: np.random.Generator) -> Vector:
        """A uniform point [3] [m]."""
        return rng.uniform(self.low, self.high)

    def contains(self, position: Vector) -> bool:
        """Is position[3] [m] inside?"""
        return bool(((position >= self.low) & (position <= self.high)).all())


class SawyerTask(PixelTask):
    """An arm before objects whose places are the context of the episode.

    A subclass says what stands there, and is a `ScriptedTask` `WithObjects` (`velap.envs.protocol`).
    """

    joints: ClassVar[tuple[str, ...]]
    """Joints of the objects."""
    placed: ClassVar[tuple[str, ...]]
    """Bodies that the context puts somewhere."""
    hand_limits: ClassVar[Box]
    """Where the mocap body may go. ours: within Meta-World's limits, so that the hand stays in the camera's sight."""

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        kind: Any = type(self)
        compiled, self._home = _prepared(kind)
        self.model = compiled.__copy__()  # the context moves bodies of the model
        self.data = mujoco.MjData(self.model)
        self._hand = self.model.body("hand").id
        self._hand_bodies = _subtree(self.model, self.model.body("right_l6").id)
        self._start(np.random.default_rng(0), "test", None)

    @classmethod
    @abstractmethod
    def scene(cls) -> Any:
        """The MjSpec of the scene."""

    @abstractmethod
    def _place(self, rng: np.random.Generator) -> None:
        """Draw a context: move the objects' bodies."""

    @abstractmethod
    def _set_objects(self) -> None:
        """Put the objects' joints into their state at the start."""

    @abstractmethod
    def _sample_start(self, rng: np.random.Generator, split: str) -> Vector:
        """A hand position [3] [m] of the split; called again where the hand would touch something."""

    def _start(self, rng: np.random.Generator, split: str, context: int | None) -> None:
        mujoco.mj_setState(self.model, self.data, self._home, _STATE)
        # each split numbers its own contexts: those of the training data are never test contexts
        stream = _CONTEXT_STREAMS[split]
        self._place(rng if context is None else np.random.default_rng([stream, context]))
        self._set_objects()
        mujoco.mj_forward(self.model, self.data)  # where the objects are, for starts that are near them
        for _ in range(_MAX_TRIES):
            self._settle(self._sample_start(rng, split))
            self._set_objects()
            mujoco.mj_forward(self.model, self.data)
            if not self._touching() and not self.succeeded():
                return
        raise VelapError(f"{type(self).__name__} found no free start in {_MAX_TRIES} tries; expected one. Its regions "
                         "overlap the objects: report the seed.")

    def _settle(self, position: Vector) -> None:
        """Bring the open hand from home to position[3] [m], through everything. Depends on the position alone."""
        mujoco.mj_setState(self.model, self.data, self._home, _STATE)
        settle(self.model, self.data, position, SETTLE_STEPS)
        self.data.time = 0.0

    def _touching(self) -> bool:
        """Does the hand touch anything but itself?"""
        bodies = self.model.geom_bodyid
        sides = np.isin(bodies[self.data.contact.geom], self._hand_bodies)  # bool [C, 2]
        return bool((sides[:, 0] != sides[:, 1]).any())

    def _advance(self, action: NDArray[np.float64]) -> None:
        limits = self.hand_limits
        self.data.mocap_pos[0] = np.clip(self.data.mocap_pos[0] + action[:3] * ACTION_SCALE, limits.low, limits.high)
        self.data.mocap_quat[0] = _HAND_QUATERNION
        self.data.ctrl[:] = action[3], -action[3]
        mujoco.mj_step(self.model, self.data, nstep=FRAME_SKIP)
        mujoco.mj_forward(self.model, self.data)

    def agent_position(self) -> Vector:
        """The hand [3] [m]; the finger tips are 5 cm below."""
        return self.data.xpos[self._hand].copy()

    def render(self, size: int = FRAME_SIZE) -> Frame:
        """The static camera's view, uint8 [size, size, 3], owned by the caller."""
        kind: Any = type(self)
        return _shared_scene(os.getpid(), threading.get_ident(), kind).draw(self.model, self.data, size)

    def set_joint(self, name: str, value: float) -> None:
        """Put an object's joint to rest at a value [m or rad]."""
        self.data.joint(name).qpos, self.data.joint(name).qvel = value, 0.0

    def true_state(self) -> NDArray[np.float32]:
        """What a frame shows, in numbers: hand [3] [m], joints of the objects [m or rad], x and y of placed bodies [m], and
        how far the fingers are open [m]. For studies and tests; agents never see it."""
        joints = [float(self.data.joint(name).qpos[0]) for name in self.joints]
        places = [value for name in self.placed for value in self.model.body(name).pos[:2]]
        return np.array([*self.agent_position(), *joints, *places, self.data.joint("r_close").qpos[0]], np.float32)

    def mocap_position(self) -> Vector:
        """Where the hand is pulled to [3] [m]."""
        return self.data.mocap_pos[0].copy()


_CONTEXT_STREAMS = {"train": 20231106, "test": 20231107}
"""Keep the random numbers of numbered contexts apart from those of seeds."""


@cache
def _shared_scene(process: int, thread: int, task: Any) -> SawyerScene:
    """The drawing model of a task in this process and thread: a context belongs to one thread, and a fork makes its own."""
    return SawyerScene(load_drawing(task.assets), _prepared(task)[0])


def settle(model: Any, data: Any, position: Vector | tuple[float, ...], steps: int) -> None:
    """Pull the open hand to position[3] [m] for some control steps [steps], through everything."""
    flags = model.opt.disableflags
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT.value
    data.mocap_pos[0], data.mocap_quat[0], data.ctrl[:] = position, _HAND_QUATERNION, (-1.0, 1.0)
    mujoco.mj_step(model, data, nstep=steps * FRAME_SKIP)
    model.opt.disableflags = flags


def _subtree(model: Any, root: int) -> NDArray[np.int64]:
    """Ids of a body and all below it."""
    inside = [root]
    for body in range(root + 1, model.nbody):
        if model.body_parentid[body] in inside:
            inside.append(body)
    return np.array(inside)


@cache
def _prepared(task: Any) -> tuple[Any, NDArray[np.float64]]:
    """The compiled model of a task, never changed, and the physics state of the hand at rest at home."""
    model = task.scene().compile()
    for number in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_WELD.value):
        model.eq_data[number] = _WELD
    data = mujoco.MjData(model)
    settle(model, data, _HOME, 200)
    state = np.empty(mujoco.mj_stateSize(model, _STATE))
    mujoco.mj_getState(model, data, state, _STATE)
    return model, state
