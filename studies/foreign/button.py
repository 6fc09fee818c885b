"""One more Meta-World task through velap's registry: press a button from above (`button-press-topdown`).

    python -c "import studies.foreign.button, velap; velap.make_dataset('ButtonTopdown')"

collects the Minari dataset `velap/ButtonTopdown-v0`. The scene is Meta-World's own, seen from the arm's other side than
velap's tasks. Lengths are in metres.
"""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

import velap
from studies.bake_meshes import collect_blocks, collect_parts
from velap.envs.gl import mujoco
from velap.envs.pixels import FRAME_SIZE
from velap.envs.sawyer.experts import go
from velap.envs.sawyer.physics import ACTION_SCALE, Box, SawyerTask, Vector, asset_directory
from velap.envs.sawyer.scene import Drawing, SawyerScene
from velap.envs.sawyer.view import View
from velap.tasks import Recipe, Task

VIEW = View(position=(-1.05, 0.1, 0.95), target=(0.0, 0.68, 0.16), fovy=36.0)
"""From the left of the arm and above."""
PRESSED = 0.05
"""Travel of a pressed button, of 0.06 m; as velap's ButtonWall has it."""


class ButtonTopdown(SawyerTask):
    """The hand starts low before a box, has to rise over it and to press the button on its top."""

    assets: ClassVar[str] = "button-topdown"
    joints: ClassVar[tuple[str, ...]] = ("btnbox_joint",)
    placed: ClassVar[tuple[str, ...]] = ("box",)
    hand_limits = Box((-0.35, 0.4, 0.08), (0.35, 0.88, 0.44))
    boxes = Box((-0.1, 0.78, 0.12), (0.1, 0.86, 0.12))
    """Where the box stands; Meta-World's range but for 2 cm."""
    test_starts = Box((-0.3, 0.42, 0.1), (0.3, 0.52, 0.2))
    near_share = 0.4
    """Share of data starts above and around the button."""

    @classmethod
    def scene(cls) -> Any:
        """Meta-World's scene."""
        return mujoco.MjSpec.from_file(str(asset_directory() / "sawyer_xyz" / "sawyer_button_press_topdown.xml"))

    def _place(self, rng: np.random.Generator) -> None:
        self.model.body("box").pos = self.boxes.sample(rng)

    def _set_objects(self) -> None:
        self.set_joint("btnbox_joint", 0.0)

    def _sample_start(self, rng: np.random.Generator, split: str) -> Vector:
        if split == "test":
            return self.test_starts.sample(rng)
        near = rng.random() < self.near_share
        return (self.hand_limits.around(self.button(), (0.15, 0.15, 0.15)) if near else self.hand_limits).sample(rng)

    def in_test_region(self, position: Vector | None = None) -> bool:
        """In the box of the test starts?"""
        return self.test_starts.contains(self.agent_position() if position is None else position)

    def button(self) -> Vector:
        """The middle of the button's top [3]."""
        return self.data.body("button").xpos + np.array([0.0, 0.0, 0.194])

    def objects(self) -> NDArray[np.float64]:
        """The button [1, 3]."""
        return self.button()[None]

    def succeeded(self) -> bool:
        """Is the button in?"""
        return bool(self.data.joint("btnbox_joint").qpos[0] <= -PRESSED)

    def expert_distance(self) -> float:
        """From the finger tips to the button."""
        return float(np.linalg.norm(self.agent_position() - [0.0, 0.0, 0.05] - self.button()))

    def expert_action(self) -> NDArray[np.float32]:
        """Up, over the button, down."""
        hand, mocap, button = self.agent_position(), self.mocap_position(), self.button()
        high = button[2] + 0.08
        if np.abs(hand[:2] - button[:2]).max() < 0.035:
            return go(mocap, np.array([*button[:2], mocap[2] - ACTION_SCALE]))
        if hand[2] < high - 0.03 and np.linalg.norm(hand[:2] - button[:2]) < 0.24:  # beside the box: up first
            return go(mocap, np.array([*mocap[:2], high + 0.01]))
        return go(mocap, np.array([*button[:2], high]))

    def render(self, size: int = FRAME_SIZE) -> NDArray[np.uint8]:
        """The view of the camera, uint8 [size, size, 3]."""
        return drawing().draw(self.model, self.data, size)


@cache
def drawing() -> SawyerScene:
    """What a small picture shows of the scene, four times as fast as all of Meta-World's meshes."""
    model = ButtonTopdown.scene().compile()
    return SawyerScene(Drawing(tuple(collect_parts(model, VIEW)), tuple(collect_blocks(model, VIEW))), model, VIEW)




gym.register("ButtonTopdown-v0", ButtonTopdown, max_episode_steps=150)
TASK = velap.register_task("ButtonTopdown")(Task(
    name="ButtonTopdown",
    env_id="studies.foreign.button:ButtonTopdown-v0",
    max_steps=150,
    recipe=Recipe(contexts=150, trajectories=10, max_steps=40, expert_radius=0.15),
    behaviours={"random-walk": 0.6, "noisy-expert": 0.4},
))
