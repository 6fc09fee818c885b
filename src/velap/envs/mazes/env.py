"""A square block that slides through walls seen from above (App. C.1), under velocity control."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from functools import lru_cache
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.mazes.experts import follow_shortest_path
from velap.envs.mazes.geometry import TOUCH, Layout, Rect
from velap.envs.mazes.spiral import spiral_layout
from velap.envs.pixels import PixelTask
from velap.errors import ConfigError

MAX_SPEED = 1.0
"""Top speed of the block [m/s]. ours: the way from a test start of SpiralMaze to the goal is then 150 steps (Sec. 4)."""

CONTROL_STEP = 0.05
"""Duration of an environment step [s]. ours."""

STEP_LENGTH = MAX_SPEED * CONTROL_STEP
"""Way of one step at top speed [m]."""

_SUBSTEPS = 20
_MASS = 1.0
_VELOCITY_GAIN = 400.0
"""Force per velocity error [N s/m]: the block follows the command with a time constant of mass / gain = 2.5 ms."""
_MAX_FORCE = 400.0
"""Limit of the force along each axis [N]. Turning round at top speed costs a sixth of a step of way."""
_HALF_HEIGHT = 0.05

_COLOURS = {
    "floor": "0.93 0.91 0.86 1",
    "wall": "0.22 0.24 0.28 1",
    "goal": "0.86 0.16 0.15 1",
    "block": "0.10 0.38 0.88 1",
}


def _box(rect: Rect, z: float, half_height: float, attributes: str) -> str:
    """A static box geom over the rectangle."""
    (x, y), (half_x, half_y) = rect.centre, rect.half_size
    return f'<geom type="box" pos="{x:.9g} {y:.9g} {z}" size="{half_x:.9g} {half_y:.9g} {half_height}" {attributes}/>'


def _overlaps(rect: Rect, others: Iterable[Rect]) -> list[Rect]:
    """The parts of the rectangle that lie in others."""
    parts = [Rect(max(rect.x_min, other.x_min), max(rect.y_min, other.y_min),
                  min(rect.x_max, other.x_max), min(rect.y_max, other.y_max)) for other in others]
    return [part for part in parts if part.x_max - part.x_min > TOUCH and part.y_max - part.y_min > TOUCH]


def model_xml(layout: Layout) -> str:
    """MuJoCo's description of a maze. The floor and the goal are paint: only walls and block touch each other.

    Where the goal reaches into a wall, the wall is painted too.
    """
    paint = 'contype="0" conaffinity="0"'
    height = layout.workspace.y_max - layout.workspace.y_min
    walls = "\n".join(_box(wall, _HALF_HEIGHT, _HALF_HEIGHT, 'class="wall"') for wall in layout.walls)
    red = f'rgba="{_COLOURS["goal"]}" {paint}'
    red_walls = "\n".join(_box(part, 2 * _HALF_HEIGHT, 0.002, red) for part in _overlaps(layout.goal, layout.walls))
    return f"""
<mujoco model="block maze">
  <option timestep="{CONTROL_STEP / _SUBSTEPS}" integrator="implicitfast" gravity="0 0 0" cone="pyramidal"/>
  <visual>
    <headlight ambient="0.55 0.55 0.55" diffuse="0.45 0.45 0.45" specular="0 0 0"/>
    <map znear="0.01" zfar="10"/>
  </visual>
  <default>
    <geom condim="1" solref="0.005 1" solimp="0.98 0.999 0.001"/>
    <default class="wall"><geom rgba="{_COLOURS["wall"]}" contype="1" conaffinity="2"/></default>
  </default>
  <worldbody>
    <camera name="top" pos="0 0 2" orthographic="true" fovy="{height}"/>
    {_box(layout.workspace, -0.01, 0.01, f'rgba="{_COLOURS["floor"]}" {paint}')}
    {_box(layout.goal, 0.0, 0.002, red)}
    {walls}{red_walls}
    <body name="block" pos="0 0 {_HALF_HEIGHT}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <geom name="block" type="box" size="{layout.block_half} {layout.block_half} {_HALF_HEIGHT}" mass="{_MASS}"
            rgba="{_COLOURS["block"]}" contype="2" conaffinity="1"/>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="x" kv="{_VELOCITY_GAIN}" forcerange="{-_MAX_FORCE} {_MAX_FORCE}"/>
    <velocity joint="y" kv="{_VELOCITY_GAIN}" forcerange="{-_MAX_FORCE} {_MAX_FORCE}"/>
  </actuator>
</mujoco>"""


@lru_cache(maxsize=16)
def _compiled(layout: Layout) -> Any:
    """The MjModel of a layout; never changed, so that environments may share it."""
    return mujoco.MjModel.from_xml_string(model_xml(layout))


class BlockMaze(PixelTask):
    """The block in some maze: a subclass says which layout an episode has."""

    assets: ClassVar[str] = "primitives"
    layout: Layout
    """The maze of this episode."""

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        super().__init__(render_mode)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._enter(self._choose_layout(np.random.default_rng(0), "test", None))

    @abstractmethod
    def _choose_layout(self, rng: np.random.Generator, split: str, context: int | None) -> Layout:
        """The maze of the next episode."""

    def _enter(self, layout: Layout) -> None:
        self.layout = layout
        self.model = _compiled(layout)
        self.data = mujoco.MjData(self.model)

    def _start(self, rng: np.random.Generator, split: str, context: int | None) -> None:
        layout = self._choose_layout(rng, split, context)
        if layout is not self.layout:
            self._enter(layout)
        position = layout.sample_free(rng, 1)[0] if split == "train" else layout.test_starts.sample(rng, 1)[0]
        self.set_agent_position(position)

    def _advance(self, action: NDArray[np.float64]) -> None:
        self.data.ctrl[:] = MAX_SPEED * action / max(1.0, float(np.linalg.norm(action)))
        mujoco.mj_step(self.model, self.data, nstep=_SUBSTEPS)

    def succeeded(self) -> bool:
        """Is the block's centre in the goal region?"""
        return bool(self.layout.goal.contains(self.data.qpos))

    def agent_position(self) -> NDArray[np.float64]:
        """The block's centre (x, y) [2] [m]."""
        return self.data.qpos.copy()

    def true_state(self) -> NDArray[np.float32]:
        """What a frame shows, in numbers: the block's centre [2] [m]. For studies and tests; agents never see it."""
        return self.agent_position().astype(np.float32)

    def set_agent_position(self, position: NDArray[np.float64]) -> None:
        """Put the block to rest at (x, y) [2] [m]; raises ConfigError where it does not fit."""
        position = np.asarray(position, dtype=np.float64)
        if position.shape != (2,) or not self.layout.is_free(position):
            raise ConfigError(f"the block does not fit at {position.tolist()}; expected one of `free_positions`.")
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = position
        mujoco.mj_forward(self.model, self.data)

    def in_test_region(self) -> bool:
        """Could a test episode start at the block's place?"""
        return bool(self.layout.test_starts.contains(self.data.qpos))

    def free_positions(self, rng: np.random.Generator, count: int) -> NDArray[np.float64]:
        """Block centres [count, 2] [m], uniform over the free space outside the goal."""
        return self.layout.sample_free(rng, count)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom, top of the frame [m], as matplotlib's `imshow` takes it."""
        space = self.layout.workspace
        return space.x_min, space.x_max, space.y_min, space.y_max

    def geodesic_steps(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Shortest way to the goal from block centres [*, 2] [m], at top speed [*] [steps]."""
        return self.layout.geodesic(positions) / STEP_LENGTH

    def expert_action(self) -> NDArray[np.float32]:
        """The action [2] that follows the shortest way; no training data come from it."""
        return follow_shortest_path(self.layout, self.agent_position(), STEP_LENGTH)


class SpiralMaze(BlockMaze):
    """From the outer end of a spiral corridor to its red inner end, 150 steps away (App. C.1.1). One context."""

    _LAYOUT: ClassVar[Layout] = spiral_layout()

    def _choose_layout(self, rng: np.random.Generator, split: str, context: int | None) -> Layout:
        return self._LAYOUT
