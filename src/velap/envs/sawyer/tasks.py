"""The four manipulation tasks (App. C.2): what stands where, where episodes start, when they succeed.

The paper gives no lengths: all numbers here are ours [m], except those that Meta-World's scenes and success rules fix.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import mujoco
from velap.envs.sawyer import experts
from velap.envs.sawyer.physics import Box, SawyerTask, Vector, asset_directory, scene_xml

PRESSED = 0.05
"""Travel of a pressed button [m], of 0.06 m. ours: Meta-World's rule asks for 0.063 m, beyond the stop."""
CLOSED = 0.03
"""Largest opening of a closed drawer [m]. ours: stricter than Meta-World's 0.065 m, so that a frame tells it."""
OPEN = 0.15
"""Opening of the drawer at the start [m]; Meta-World's `maxDist`."""


def _metaworld_scene(name: str) -> Any:
    return mujoco.MjSpec.from_file(str(asset_directory() / "sawyer_xyz" / name))


class _NearOrAnywhere(SawyerTask):
    """Data start anywhere above the table, a share of them near the handle; tests start in a box far from it."""

    hand_limits = Box((-0.4, 0.4, 0.06), (0.4, 0.8, 0.3))
    test_starts: ClassVar[Box]
    near_share: ClassVar[float]
    """Share of data starts drawn from a box around the handle."""
    near_box = (0.15, 0.15, 0.12)
    """Half sizes of that box."""

    @abstractmethod
    def handle(self) -> Vector:
        """What the hand has to push, where it has to push it [3] [m]."""

    def _sample_start(self, rng: np.random.Generator, split: str) -> Vector:
        if split == "test":
            return self.test_starts.sample(rng)
        near = rng.random() < self.near_share
        return (self.hand_limits.around(self.handle(), self.near_box) if near else self.hand_limits).sample(rng)

    def in_test_region(self) -> bool:
        """Inside the box of the test starts?"""
        return self.test_starts.contains(self.agent_position())

    def objects(self) -> NDArray[np.float64]:
        """The handle [1, 3] [m]."""
        return self.handle()[None]

    def expert_distance(self) -> float:
        """From the hand to the handle [m]."""
        return float(np.linalg.norm(self.agent_position() - self.handle()))


class WindowClose(_NearOrAnywhere):
    """Shove the sash of a window to the left by its handle (C.2.1)."""

    assets: ClassVar[str] = "window"
    joints: ClassVar[tuple[str, ...]] = ("window_slide",)
    placed: ClassVar[tuple[str, ...]] = ("window",)
    contexts = Box((-0.08, 0.75, 0.2), (0.08, 0.88, 0.2))
    """Where the window stands."""
    test_starts = Box((-0.36, 0.42, 0.08), (-0.24, 0.6, 0.22))
    """Left of the window: round the handle and back with it are more than 50 steps."""
    near_share = 0.6

    @classmethod
    def scene(cls) -> Any:
        """Meta-World's window."""
        return _metaworld_scene("sawyer_window_horizontal.xml")

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body("window").pos = self.contexts.sample(rng)

    def _set_objects(self) -> None:
        self.set_joint("window_slide", 0.2)

    def handle(self) -> Vector:
        """The right side of the handle [3] [m]."""
        return self.data.site("handleCloseStart").xpos.copy()

    def succeeded(self) -> bool:
        """Is the sash at most 4 cm from shut? Meta-World's rule."""
        return bool(abs(self.data.site("handleCloseStart").xpos[0] - self.model.body("window").pos[0]) <= 0.05)

    expert_action = experts.close_window


class FaucetClose(_NearOrAnywhere):
    """Turn the handle of a faucet to the left (C.2.2)."""

    assets: ClassVar[str] = "faucet"
    joints: ClassVar[tuple[str, ...]] = ("knob_Joint_1",)
    placed: ClassVar[tuple[str, ...]] = ("faucetBase",)
    contexts = Box((-0.05, 0.76, 0.0), (0.15, 0.85, 0.0))
    """Where the faucet stands."""
    test_starts = Box((-0.38, 0.42, 0.08), (-0.3, 0.6, 0.22))
    """Left of the faucet, whose handle is pushed from the right."""
    near_share = 0.4

    @classmethod
    def scene(cls) -> Any:
        """Meta-World's faucet."""
        return _metaworld_scene("sawyer_faucet.xml")

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body("faucetBase").pos = self.contexts.sample(rng)

    def _set_objects(self) -> None:
        self.set_joint("knob_Joint_1", 0.0)

    def axis(self) -> Vector:
        """Where the handle turns, at its height [3] [m]."""
        return self.data.body("faucet_link2").xpos.copy()

    def handle_frame(self) -> tuple[Vector, Vector]:
        """Unit vectors [3] across the handle, to its right seen from the tip's side at rest, and along it to the tip."""
        rotation = self.data.body("faucet_link2").xmat.reshape(3, 3)
        return rotation[:, 0].copy(), -rotation[:, 1]

    def handle(self) -> Vector:
        """The tip of the handle, on its right side [3] [m]."""
        return self.data.site("handleStartClose").xpos.copy()

    def succeeded(self) -> bool:
        """Is the tip at most 7 cm from where a closed handle has it? Meta-World's rule."""
        target = self.model.body("faucetBase").pos + np.array([-0.175, 0.0, 0.125])
        tip = self.data.site("handleStartClose").xpos + np.array([0.0, 0.0, -0.01])
        return bool(np.linalg.norm(tip - target) <= 0.07)

    expert_action = experts.close_faucet


class _WithButton(SawyerTask):
    """Has a button to press."""

    def button(self) -> Vector:
        """The middle of the button's face [3] [m]."""
        return self.data.body("button").xpos + np.array([0.0, -0.194, 0.0])

    def button_pressed(self) -> bool:
        """Is the button in?"""
        return bool(self.data.joint("btnbox_joint").qpos[0] <= -PRESSED)


class ButtonWall(_WithButton):
    """Go round a wall and press the button behind it; the hand may not rise above the wall (C.2.3)."""

    assets: ClassVar[str] = "button-wall"
    joints: ClassVar[tuple[str, ...]] = ("btnbox_joint",)
    placed: ClassVar[tuple[str, ...]] = ("box", "wall")
    hand_limits = Box((-0.4, 0.34, 0.06), (0.4, 0.8, 0.16))
    """The upper limit of z keeps the finger tips 6 cm and more below the wall's top."""
    wall_half_width = 0.23
    wall_half_height = 0.09
    wall_half_depth = 0.015
    boxes = Box((-0.06, 0.9, 0.115), (0.06, 0.94, 0.115))
    """Where the box with the button stands."""
    wall_shift = 0.03
    """The wall's middle is at most so far beside the button: no short cut round either end."""
    wall_ys = (0.49, 0.53)
    clearance = 0.08
    """From the middle of the wall to the nearest data starts: the open hand reaches 6 cm along y."""
    front_share = 0.5
    """Share of data starts on the button's side of the wall."""
    front_half_width = 0.25
    """They are at most so far beside the button,"""
    front_y = 0.72
    """and not further away than this, where the button's face stands."""
    lee = (0.08, 0.35, 0.4)
    """Test starts: half width of their box, which is centred on the wall, and its y from and to."""

    @classmethod
    def scene(cls) -> Any:
        """Meta-World's button and a wider, higher wall; blue, since its bricks look like the table's wood."""
        size = f"{cls.wall_half_width} {cls.wall_half_depth} {cls.wall_half_height}"
        bodies = f"""
    <body name="box" pos="0 0.9 0.115">{{buttonbox}}</body>
    <body name="wall" pos="0 0.5 0">
      <body childclass="wall_base">
        <geom name="wall_face" rgba="0.30 0.42 0.70 1" type="box" size="{size}" pos="0 0 {cls.wall_half_height}"/>
        <geom name="wall" class="wall_col" type="box" size="{size}" pos="0 0 {cls.wall_half_height}" mass="1"/>
      </body>
    </body>"""
        return mujoco.MjSpec.from_string(scene_xml(("buttonbox", "wall"), bodies))

    def _place(self, rng: np.random.Generator) -> None:
        box = self.boxes.sample(rng)
        self.model.body("box").pos = box
        x = box[0] + rng.uniform(-self.wall_shift, self.wall_shift)
        self.model.body("wall").pos = x, rng.uniform(*self.wall_ys), 0.0

    def _set_objects(self) -> None:
        self.set_joint("btnbox_joint", 0.0)

    def wall(self) -> Vector:
        """The middle of the wall's foot [3] [m]."""
        return self.model.body("wall").pos.copy()

    def objects(self) -> NDArray[np.float64]:
        """The button [1, 3] [m]."""
        return self.button()[None]

    def _sample_start(self, rng: np.random.Generator, split: str) -> Vector:
        if split == "test":
            return self._test_starts().sample(rng)
        y, (low, high) = self.wall()[1], (self.hand_limits.low, self.hand_limits.high)
        if rng.random() >= self.front_share:
            return Box(low, (high[0], y - self.clearance, high[2])).sample(rng)
        x, aside = self.model.body("box").pos[0], self.front_half_width
        return Box((x - aside, y + self.clearance, low[2]), (x + aside, self.front_y, high[2])).sample(rng)

    def _test_starts(self) -> Box:
        x, (aside, y_from, y_to) = self.model.body("wall").pos[0], self.lee
        return Box((x - aside, y_from, 0.08), (x + aside, y_to, 0.15))

    def in_test_region(self) -> bool:
        """In the lee of the wall?"""
        return self._test_starts().contains(self.agent_position())

    def succeeded(self) -> bool:
        """Is the button in?"""
        return self.button_pressed()

    def expert_distance(self) -> float:
        """From the hand to the button on the button's side of the wall [m]; infinite on the other."""
        hand = self.agent_position()
        past = hand[1] > self.model.body("wall").pos[1] + self.wall_half_depth
        return float(np.linalg.norm(hand - self.button())) if past else float("inf")

    expert_action = experts.press_behind_wall


class DrawerButton(_WithButton, _NearOrAnywhere):
    """Close the drawer, then press the button beside it (C.2.4). Done while the drawer is closed and the button pressed.

    Data hold either subtask alone: an open drawer to close, or a closed one and the button to press. Tests start with both
    to do.
    """

    assets: ClassVar[str] = "drawer-button"
    joints: ClassVar[tuple[str, ...]] = ("goal_slidey", "btnbox_joint")
    placed: ClassVar[tuple[str, ...]] = ("drawer", "box")
    drawers = Box((-0.26, 0.86, 0.0), (-0.16, 0.92, 0.0))
    """Where the drawer stands."""
    boxes = Box((0.16, 0.86, 0.115), (0.26, 0.92, 0.115))
    """Where the box with the button stands."""
    test_starts = Box((-0.1, 0.42, 0.08), (0.1, 0.52, 0.24))
    drawer_share = 0.5
    """Share of data trajectories that are of the drawer."""
    near_share = 0.3

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        self._subtask, self._opening = "both", OPEN
        super().__init__(render_mode)

    @classmethod
    def scene(cls) -> Any:
        """Meta-World's drawer and button side by side."""
        bodies = """
    <body name="drawer" pos="-0.2 0.9 0">{drawer}</body>
    <body name="box" pos="0.2 0.9 0.115">{buttonbox}</body>"""
        return mujoco.MjSpec.from_string(scene_xml(("drawer", "buttonbox"), bodies))

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body("drawer").pos = self.drawers.sample(rng)
        self.model.body("box").pos = self.boxes.sample(rng)

    def _start(self, rng: np.random.Generator, split: str, context: int | None) -> None:
        self._subtask, self._opening = "both", OPEN
        if split == "train":
            self._subtask = "drawer" if rng.random() < self.drawer_share else "button"
        if self._subtask == "button":
            self._opening = rng.uniform(0.0, CLOSED / 2)
        super()._start(rng, split, context)

    def _set_objects(self) -> None:
        self.set_joint("goal_slidey", -self._opening)
        self.set_joint("btnbox_joint", 0.0)

    def drawer_handle(self) -> Vector:
        """The middle of the drawer's handle [3] [m]."""
        return self.data.body("drawer_link").xpos + np.array([0.0, -0.15, 0.0])

    def drawer_closed(self) -> bool:
        """Is the drawer open by at most `CLOSED`?"""
        return bool(self.data.joint("goal_slidey").qpos[0] >= -CLOSED)

    def subtasks(self) -> tuple[bool, bool]:
        """What is done now, in the order that it has to be done: drawer closed, button pressed."""
        return self.drawer_closed(), self.button_pressed()

    def objects(self) -> NDArray[np.float64]:
        """The drawer's handle and the button [2, 3] [m]."""
        return np.stack([self.drawer_handle(), self.button()])

    def handle(self) -> Vector:
        """What the present subtask is about: the drawer's handle or the button [3] [m]."""
        return self.drawer_handle() if self._subtask == "drawer" else self.button()

    def in_test_region(self) -> bool:
        """In the box of the test starts, with the drawer open?"""
        return super().in_test_region() and not self.drawer_closed()

    def succeeded(self) -> bool:
        """Is the drawer closed and the button in, both now?"""
        return all(self.subtasks())

    def expert_distance(self) -> float:
        """From the hand to the handle or the button [m]; infinite once a drawer trajectory has closed the drawer."""
        finished = self._subtask == "drawer" and self.drawer_closed()
        return float("inf") if finished else super().expert_distance()

    expert_action = experts.close_then_press
