"""Pixel tasks: one frame an observation, a sparse 0/1 reward that ends the episode; rendering.

Shapes: frames are uint8 [H, W, 3], RGB, first row at the top.
"""

from __future__ import annotations

import atexit
import operator
import os
import threading
from abc import abstractmethod
from typing import Any, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from velap.envs.gl import make_context, mujoco, render_error
from velap.errors import ConfigError

FRAME_SIZE = 64
"""Side of an observation [px], App. B."""

SPLITS = ("train", "test")

Frame = NDArray[np.uint8]


class Renderer:
    """Draws square frames of a fixed camera. What costs most is off: reflections, fog, sky, multisampling, and unless asked
    for shadows."""

    def __init__(self, model: Any, size: int, shadow_map: int = 0) -> None:
        """`model` is any MjModel with the same meshes and textures as those drawn later; `size` [px]. `shadow_map` is the
        side of the map of shadows [px]; 0 draws none."""
        self.size = size
        # the only fields of the model that a context reads besides its assets; put back, since models are shared
        quality, visual = model.vis.quality, model.vis.global_
        before = quality.offsamples, quality.shadowsize, visual.offwidth, visual.offheight
        quality.offsamples, quality.shadowsize, visual.offwidth, visual.offheight = 0, shadow_map, size, size
        try:
            self._gl, self._context, self.backend = make_context(model, size)
        finally:
            quality.offsamples, quality.shadowsize, visual.offwidth, visual.offheight = before
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=max(64, 2 * model.ngeom))
        for flag in ("REFLECTION", "SKYBOX", "FOG", "HAZE"):
            self._scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{flag}").value] = 0
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW.value] = shadow_map > 0
        self._option = mujoco.MjvOption()
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
        self._rect = mujoco.MjrRect(0, 0, size, size)
        self._buffer = np.empty((size, size, 3), dtype=np.uint8)

    def draw(self, model: Any, data: Any, camera: int = 0) -> Frame:
        """What the fixed camera sees, an owned uint8 [size, size, 3]; raises RenderError on a frame of one colour."""
        self._gl.make_current()
        self._camera.fixedcamid = camera
        mujoco.mjv_updateScene(model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene)
        mujoco.mjr_render(self._rect, self._scene, self._context)
        mujoco.mjr_readPixels(self._buffer, None, self._rect, self._context)
        frame = self._buffer[::-1].copy()
        if frame.min() == frame.max():
            raise render_error(f"{self.backend} drew a frame of one value, {frame.flat[0]}")
        return frame

    def close(self) -> None:
        """Free the context."""
        self._context.free()
        self._gl.free()


_renderers: dict[tuple[Any, ...], Renderer] = {}


def shared_renderer(assets: str, model: Any, size: int, shadow_map: int = 0) -> Renderer:
    """The renderer of this process and thread for frames of `size` [px] of models with the same `assets`, a name.

    A context costs a hundred frames to make, so that environments of one kind share one; a forked child makes its own.
    """
    key = (os.getpid(), threading.get_ident(), assets, size, shadow_map)
    if key not in _renderers:
        _renderers[key] = Renderer(model, size, shadow_map)
        atexit.register(_close, key)  # registered after MuJoCo's own clean-up, hence run before it
    return _renderers[key]


def _close(key: tuple[Any, ...]) -> None:
    """Free a renderer, in the process that made it."""
    if key[0] == os.getpid():
        _renderers.pop(key).close()


def _number(context: Any) -> int | None:
    """The number of a context as an int; -1 for anything that is no integer."""
    try:
        return None if context is None else operator.index(context)
    except TypeError:
        return -1


class PixelTask(gymnasium.Env[Frame, NDArray[np.float32]]):
    """Base of every task: frames in, bounded actions out, reward 1 on success and nothing else (Sec. 4).

    A subclass sets `assets`, `model`, `data` and `action_space`, and says how to start, act and judge.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}
    assets: ClassVar[str]
    """Name of what the renderer keeps on the graphics side: tasks with the same meshes and textures may share it."""
    model: Any
    data: Any

    def __init__(self, render_mode: str | None = "rgb_array") -> None:
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"render_mode is {render_mode!r}; expected None or 'rgb_array'.")
        self.render_mode = render_mode
        self.observation_space = gymnasium.spaces.Box(0, 255, (FRAME_SIZE, FRAME_SIZE, 3), np.uint8)

    @abstractmethod
    def _start(self, rng: np.random.Generator, split: str, context: int | None) -> None:
        """Put the world into a start state of the split, in that context or in a random one."""

    @abstractmethod
    def _advance(self, action: NDArray[np.float64]) -> None:
        """One control step with an action[A] inside the action space."""

    @abstractmethod
    def succeeded(self) -> bool:
        """Is the task done in the present state?"""

    @abstractmethod
    def agent_position(self) -> NDArray[np.float64]:
        """Where the agent is [2 or 3] [m]."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Frame, dict[str, Any]]:
        """Start an episode.

        `options` may hold `split`: "train" starts as in data collection, "test" (the default) as in evaluation; and
        `context`: the number of an initialisation of everything except the agent (Table 10), by default drawn anew. Each
        split numbers its own contexts; they do not overlap. Tasks with one context ignore it.
        """
        self.start(options, seed)
        return self.render(), {"success": False}

    def start(self, options: dict[str, Any] | None = None, seed: int | None = None) -> None:
        """`reset` without a frame."""
        super().reset(seed=seed)
        options = options or {}
        split, context = options.get("split", "test"), _number(options.get("context"))
        if not set(options) <= {"split", "context"} or split not in SPLITS or (context is not None and context < 0):
            raise ConfigError(f"reset options are {options!r}; expected split, one of {SPLITS}, or context, an int from 0.")
        self._start(self.np_random, split, context)

    def step(self, action: NDArray[np.floating[Any]]) -> tuple[Frame, float, bool, bool, dict[str, Any]]:
        """One control step; actions outside the bounds are clipped."""
        success = self.advance(action)
        return self.render(), float(success), success, False, {"success": success}

    def advance(self, action: NDArray[np.floating[Any]]) -> bool:
        """`step` without a frame, for physics at full speed: True on success."""
        space = self.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        values = np.asarray(action, dtype=np.float64)
        if values.shape != space.shape or not np.isfinite(values).all():
            raise ConfigError(f"the action is {action!r}; expected {space.shape} finite numbers within the action space.")
        self._advance(np.clip(values, space.low, space.high))
        return self.succeeded()

    def render(self, size: int = FRAME_SIZE) -> Frame:
        """The static camera's view, uint8 [size, size, 3], owned by the caller."""
        return shared_renderer(self.assets, self.model, size).draw(self.model, self.data)
