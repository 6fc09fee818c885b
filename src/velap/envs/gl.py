"""OpenGL without a screen: finds a backend that draws, and is the only place that imports MuJoCo's OpenGL contexts.

`MUJOCO_GL` decides where it is set. Otherwise EGL, OSMesa and GLFW are tried in that order for the first frame.
Import `mujoco` from here, so that a `MUJOCO_GL` that MuJoCo refuses at import ends in the same RenderError.
"""

from __future__ import annotations

import ctypes.util
import importlib
import os
import subprocess
import sys
import warnings
from typing import Any

from velap.errors import RenderError

BACKENDS = ("egl", "osmesa", "glfw")
_working: list[str] = []
_DISABLED = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1")
_ADVICE = (
    "Install a drawing library, `apt-get install libegl1 libgl1-mesa-dri` (EGL) or `apt-get install libosmesa6` (OSMesa), "
    "and leave MUJOCO_GL unset or set it to egl or osmesa."
)


def render_error(problem: str) -> RenderError:
    """A RenderError that says what went wrong and which Debian packages help."""
    setting = repr(os.environ["MUJOCO_GL"]) if "MUJOCO_GL" in os.environ else "unset"
    return RenderError(f"{problem} (MUJOCO_GL is {setting}); expected an RGB picture. {_ADVICE}")


try:
    import mujoco
except Exception as error:  # PyOpenGL and ctypes fail in many ways where a library is missing
    raise render_error(f"MuJoCo cannot be imported: {type(error).__name__}: {error}") from error

__all__ = ["BACKENDS", "backend_order", "make_context", "mujoco", "render_error", "working_backend"]


def working_backend() -> str:
    """The backend that draws in this process; raises RenderError before the first frame."""
    if not _working:
        raise render_error("nothing has been drawn yet in this process")
    return _working[0]


def backend_order() -> tuple[str, ...]:
    """The backends to try, first one first."""
    setting = os.environ.get("MUJOCO_GL", "").lower().strip()
    if setting in _DISABLED:
        raise render_error("drawing is switched off")
    if setting in _ANY:
        # MuJoCo loads OpenGL through libEGL once that is in the process: a broken EGL would take OSMesa down with it
        return BACKENDS[1:] if ctypes.util.find_library("OSMesa") and not _egl_draws() else BACKENDS
    if setting not in BACKENDS:
        raise render_error(f"unknown backend {setting!r}, expected one of {', '.join(BACKENDS)}")
    return (setting,)


def _egl_draws() -> bool:
    """Does EGL make a context in a process of its own?"""
    code = "from mujoco.egl import GLContext; GLContext(64, 64).make_current()"
    environment = {**os.environ, "MUJOCO_GL": "egl", "PYOPENGL_PLATFORM": "egl"}
    try:
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, timeout=60, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode == 0


def _forget_platform(platform_before: str | None) -> None:
    """PyOpenGL binds to one platform when first imported; a failed one has to go before the next can be tried."""
    bound = ("OpenGL", "mujoco.egl", "mujoco.osmesa")
    for name in [name for name in sys.modules if name in bound or name.startswith(tuple(f"{b}." for b in bound))]:
        del sys.modules[name]
    if platform_before is None:
        os.environ.pop("PYOPENGL_PLATFORM", None)
    else:
        os.environ["PYOPENGL_PLATFORM"] = platform_before


def make_context(model: Any, size: int) -> tuple[Any, Any, str]:
    """OpenGL context (current), MuJoCo's context for square frames of `size` [px], and the backend's name.

    The backend that worked first in a process stays. Raises RenderError with every backend's reason if none works.
    """
    # llvmpipe would start a thread a core: no faster for small frames, and parallel workers would fight for the cores
    os.environ.setdefault("LP_NUM_THREADS", "0")
    failures = []
    for backend in _working or backend_order():
        platform_before = os.environ.get("PYOPENGL_PLATFORM")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # GLFW warns of what it then raises
                maker = importlib.import_module(f"mujoco.{backend}").GLContext
                maker._context = None  # its destructor reads this even where its constructor failed
                window = maker(size, size)
                window.make_current()
                context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
        except Exception as error:  # each backend, driver and PyOpenGL version fails with its own exception
            failures.append(f"{backend}: {type(error).__name__}: {error}")
            if not _working:
                _forget_platform(platform_before)
        else:
            _working[:] = [backend]
            return window, context, backend
    raise render_error("no OpenGL backend works here: " + "; ".join(failures))
