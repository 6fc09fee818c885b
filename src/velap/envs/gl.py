"""OpenGL without a screen: finds a backend that draws, and is the only place that imports MuJoCo's OpenGL contexts.

`MUJOCO_GL` decides where it is set. Otherwise EGL, OSMesa and GLFW are tried in that order when the first frame is asked for.
Import `mujoco` from here, so that a `MUJOCO_GL` that MuJoCo refuses at import ends in the same RenderError.
"""

from __future__ import annotations

import importlib
import os
import sys
from typing import Any

from velap.errors import RenderError

BACKENDS = ("egl", "osmesa", "glfw")
_DISABLED = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1")
_ADVICE = (
    "Install a drawing library, `apt-get install libegl1 libgl1-mesa-dri` (EGL) or `apt-get install libosmesa6` (OSMesa), "
    "and leave MUJOCO_GL unset or set it to egl or osmesa."
)


def render_error(problem: str) -> RenderError:
    """A RenderError that says what went wrong and which Debian packages help."""
    setting = os.environ.get("MUJOCO_GL")
    return RenderError(f"{problem} (MUJOCO_GL is {'unset' if setting is None else repr(setting)}); expected 64×64 RGB frames. {_ADVICE}")


try:
    import mujoco
except Exception as error:  # PyOpenGL and ctypes fail in many ways where a library is missing
    raise render_error(f"MuJoCo cannot be imported: {type(error).__name__}: {error}") from error

__all__ = ["BACKENDS", "backend_order", "make_context", "mujoco", "render_error"]


def backend_order() -> tuple[str, ...]:
    """The backends to try, first one first."""
    setting = os.environ.get("MUJOCO_GL", "").lower().strip()
    if setting in _DISABLED:
        raise render_error("drawing is switched off")
    if setting in _ANY:
        return BACKENDS
    if setting not in BACKENDS:
        raise render_error(f"unknown backend {setting!r}, expected one of {', '.join(BACKENDS)}")
    return (setting,)


def _forget_platform(platform_before: str | None) -> None:
    """PyOpenGL binds to one platform when first imported; a failed one has to go before the next can be tried."""
    for name in [n for n in sys.modules if n.partition(".")[0] == "OpenGL" or n in ("mujoco.egl", "mujoco.egl.egl_ext", "mujoco.osmesa")]:
        del sys.modules[name]
    if platform_before is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)
    else:
        os.environ["PYOPENGL_PLATFORM"] = platform_before


def make_context(size: int) -> tuple[Any, str]:
    """A current OpenGL context for square frames of `size` [px] and the backend's name; raises RenderError if none works."""
    # llvmpipe would start a thread a core: slower for small frames, and parallel workers would fight for the cores
    os.environ.setdefault("LP_NUM_THREADS", "0")
    failures = []
    for backend in backend_order():
        platform_before = os.environ.get("PYOPENGL_PLATFORM")
        try:
            context = importlib.import_module(f"mujoco.{backend}").GLContext(size, size)
            context.make_current()
        except Exception as error:  # each backend, driver and PyOpenGL version fails with its own exception
            failures.append(f"{backend}: {type(error).__name__}: {error}")
            _forget_platform(platform_before)
        else:
            return context, backend
    raise render_error("no OpenGL backend works here: " + "; ".join(failures))
