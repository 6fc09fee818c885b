"""OpenGL without a screen: finds a backend that draws, and is the only place that imports MuJoCo.

`MUJOCO_GL` decides where it is set. Otherwise, on Linux, a process of its own tries EGL, OSMesa and GLFW in that order, and
`MUJOCO_GL` is set to the first one that makes a context, for this process and its children. The trial needs a process of its
own: a backend that fails stays loaded, and the next one cannot be tried beside it. Import `mujoco` from here, so that a
`MUJOCO_GL` that MuJoCo refuses at import ends in the same RenderError.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from typing import Any

from velap.errors import RenderError

BACKENDS = ("egl", "osmesa", "glfw")
_DISABLED = ("disable", "disabled", "off", "false", "0")
_ANY = ("", "enable", "enabled", "on", "true", "1")
_PROBE_SECONDS = 60
_working: list[str] = []
_ADVICE = (
    "Install a drawing library, `apt-get install libegl1 libgl1-mesa-dri` (EGL) or `apt-get install libosmesa6` (OSMesa), "
    "and leave MUJOCO_GL unset or set it to egl or osmesa."
)


def render_error(problem: str) -> RenderError:
    """A RenderError that says what went wrong and which Debian packages help."""
    setting = repr(os.environ["MUJOCO_GL"]) if "MUJOCO_GL" in os.environ else "unset"
    return RenderError(f"{problem} (MUJOCO_GL is {setting}); expected an RGB picture. {_ADVICE}")


def choose_backend() -> str:
    """The backend that `MUJOCO_GL` names, or else the first one that draws, which is then set there.

    Raises RenderError where drawing is switched off, no such backend exists, or none draws.
    """
    setting = os.environ.get("MUJOCO_GL", "").lower().strip()
    if setting in _DISABLED:
        raise render_error("drawing is switched off")
    if setting not in _ANY:
        return setting
    if sys.platform != "linux":
        return "cgl" if sys.platform == "darwin" else "glfw"
    failures = []
    for backend in BACKENDS:
        failure = _probe(backend)
        if failure is None:
            os.environ["MUJOCO_GL"] = backend
            return backend
        failures.append(f"{backend}: {failure}")
    raise render_error("no OpenGL backend works here: " + "; ".join(failures))


def _probe(backend: str) -> str | None:
    """Does the backend make a context in a process of its own? The reason where it does not."""
    # a destructor reads `_context` even where the constructor failed
    code = f"from mujoco.{backend} import GLContext; GLContext._context = None; GLContext(64, 64).make_current()"
    environment = {**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": "" if backend == "glfw" else backend}
    try:
        done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False,
                              timeout=_PROBE_SECONDS)
    except subprocess.TimeoutExpired:
        return f"no context within {_PROBE_SECONDS} s"
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]


try:
    if "mujoco" not in sys.modules and os.environ.get("MUJOCO_GL", "").lower().strip() in _ANY:
        choose_backend()  # MuJoCo reads MUJOCO_GL when it is imported
    import mujoco
except RenderError:
    raise
except Exception as error:  # PyOpenGL and ctypes fail in many ways where a library is missing
    raise render_error(f"MuJoCo cannot be imported: {type(error).__name__}: {error}") from error

__all__ = ["BACKENDS", "choose_backend", "make_context", "mujoco", "render_error", "working_backend"]


def working_backend() -> str:
    """The backend that draws in this process; raises RenderError before the first frame."""
    if not _working:
        raise render_error("nothing has been drawn yet in this process")
    return _working[0]


def make_context(model: Any, size: int) -> tuple[Any, Any, str]:
    """OpenGL context (current), MuJoCo's context for square frames of `size` [px], and the backend's name."""
    # llvmpipe would start a thread a core: no faster for small frames, and parallel workers would fight for the cores
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = _working[0] if _working else choose_backend()
    try:
        window = importlib.import_module(f"mujoco.{backend}").GLContext(size, size)
        window.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_50.value)
    except Exception as error:  # each backend, driver and PyOpenGL version fails with its own exception
        raise render_error(f"the OpenGL backend {backend} does not work here: {type(error).__name__}: {error}") from error
    _working[:] = [backend]
    return window, context, backend
