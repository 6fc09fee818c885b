"""`kernels.c`: networks on a few dozen rows, where PyTorch spends its time between the kernels.

The machine's C compiler builds it at first use, into the user's cache. Without a compiler a warning says how to install one,
and the networks of `inference.py` run instead, equal up to rounding; a plan then takes about twice as long. They also run on
other devices than a CPU. `VELAP_NATIVE=0` turns the C code off without a warning. W inputs, V outputs, n members.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from velap.models.networks import LEAK
from velap.native.folded import EPS, Folded
from velap.storage import replace_file

PANEL = 32
"""Columns of a weight panel, as in kernels.c."""
MOST_ROWS = 2048
"""Rows of a call up to which one thread of kernels.c is at least as fast as PyTorch on two cores. ours."""
MOST_UNITS = 4096
"""Units of a layer up to which kernels.c is used: a block of rows has to fit on the stack. ours."""
# clang for ARM knows the processor by -mcpu alone
TUNED = "-mcpu=native" if platform.machine().lower() in ("arm64", "aarch64") else "-march=native"
FLAGS = ("-O3", TUNED, "-fno-math-errno", "-ffp-contract=fast", "-shared", "-fPIC")
COMPILERS = ("cc", "gcc", "clang")
_ADVICE = ("Install a compiler (Debian and Ubuntu: apt-get install gcc libc6-dev; macOS: xcode-select --install) or name "
           "one with CC; VELAP_NATIVE=0 silences this.")
_SOURCE = Path(__file__).with_name("kernels.c")


class _Layer(ctypes.Structure):
    """`Layer` of kernels.c."""

    _fields_ = (("inputs", ctypes.c_long), ("outputs", ctypes.c_long), ("weights", ctypes.c_void_p),
                ("bias", ctypes.c_void_p), ("shift", ctypes.c_void_p))


@cache
def library() -> ctypes.CDLL | None:
    """The compiled code; None if it is turned off, or, with one warning, if it cannot be built."""
    if os.environ.get("VELAP_NATIVE") == "0":
        return None
    named = os.environ.get("CC")
    compiler = next(filter(None, map(shutil.which, [named] if named else COMPILERS)), None)
    if platform.system() == "Windows":
        problem = "velap's C code needs gcc or clang and a system other than Windows"
    elif compiler is None:
        problem = f"there is no C compiler here ({named or ', '.join(COMPILERS)})"
    else:
        try:
            return _declare(ctypes.CDLL(str(_build(compiler))))
        except (OSError, subprocess.SubprocessError) as error:
            output = (getattr(error, "stderr", None) or b"").decode(errors="replace").strip().splitlines()
            problem = f"{compiler} could not build {_SOURCE.name}: {output[0] if output else error}"
    warnings.warn(f"{problem}; plans run in PyTorch, about half as fast. {_ADVICE}", UserWarning, stacklevel=2)
    return None


def _build(compiler: str) -> Path:
    """Path of the library for this source, compiler and processor; builds it if it does not exist."""
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "velap"
    digest = hashlib.sha256("\0".join((_SOURCE.read_text(), compiler, *FLAGS, _processor())).encode()).hexdigest()[:16]
    path = root / f"native-{digest}.so"
    if not path.exists():
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            built = Path(folder) / "native.so"
            subprocess.run([compiler, *FLAGS, "-o", str(built), str(_SOURCE), "-lm"], check=True, capture_output=True,
                           timeout=60)
            replace_file(path, built.read_bytes())
    return path


def _processor() -> str:
    """What `-march=native` depends on: a cache may be shared between machines."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.exists() else []
    named = [line for line in lines if line.startswith(("model name", "flags", "Features", "CPU part"))]
    return "\n".join([platform.machine(), platform.processor(), *sorted(set(named))])


def _declare(found: ctypes.CDLL) -> ctypes.CDLL:
    number, address = ctypes.c_long, ctypes.c_void_p
    found.velap_network.argtypes = [address, number, number, address, address, number, number, number, ctypes.c_float,
                                    ctypes.c_float, address]
    found.velap_rollout.argtypes = [address, number, address, number, address, address, number, number, number, ctypes.c_int,
                                    number, number, ctypes.c_float, ctypes.c_float, address]
    found.velap_network.restype = found.velap_rollout.restype = None
    return found


def _library_for(layers: Sequence[Folded]) -> ctypes.CDLL | None:
    """The library if it can run these layers."""
    fits = all(part.dtype == torch.float32 and part.device.type == "cpu" for layer in layers for part in layer[:2])
    narrow = max(size for layer in layers for size in layer.weight.shape[-2:]) <= MOST_UNITS
    return library() if fits and narrow else None


def _width(layers: Sequence[Folded]) -> int:
    """The largest padded number of units."""
    return max(-(-size // PANEL) * PANEL for layer in layers for size in layer.weight.shape[-2:])


def native_network(layers: Sequence[Folded], otherwise: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """Inputs `[*, W_1], [*, W_2], ...`, taken side by side, → `[n, *, V]` of the members, or `[*, V]` of weights [W, V].

    `otherwise` computes the same; it runs for inputs that kernels.c does not take (other devices, types, many rows). The
    weights are copied.
    """
    found = _library_for(layers)
    if found is None:
        return otherwise
    single = layers[0].weight.dim() == 2
    members = 1 if single else len(layers[0].weight)
    width = _width(layers)
    kept, structs = _pack(layers, members)
    outputs, inputs = layers[-1].weight.shape[-1], layers[0].weight.shape[-2]
    run, fixed = found.velap_network, (ctypes.addressof(structs), members, len(layers))

    def forward(*parts: Tensor) -> Tensor:
        prefix = parts[0].shape[:-1]
        rows = prefix.numel()
        if rows > MOST_ROWS or any(part.dtype != torch.float32 or part.shape[:-1] != prefix for part in parts):
            return otherwise(*parts)
        whole = [part.contiguous() for part in parts]
        widths = [part.shape[-1] for part in whole]
        assert sum(widths) == inputs
        out = torch.empty((*prefix, outputs) if single else (members, *prefix, outputs))
        count = len(whole)
        run(*fixed, (ctypes.c_void_p * count)(*[part.data_ptr() for part in whole]), (ctypes.c_long * count)(*widths), count,
            rows, width, EPS, LEAK, out.data_ptr())
        return out

    forward.kept = (kept, structs)  # type: ignore[attr-defined]  # the addresses in the structs are those of these tensors
    return forward


def native_rollout(
    acting: Sequence[Folded], moving: Sequence[Folded], residual: bool
) -> Callable[[Tensor, Tensor, int], Tensor] | None:
    """`z [R, D], noise [R, S, m], steps → z [R, D]` after that number of steps with the actions tanh(acting(z, noise)).

    The noise of step i is number min(i, S - 1); `acting` without noise takes m = 0. `moving(z, action)` is the next latent,
    or with `residual` the change. None if kernels.c cannot run the layers. The weights are copied.
    """
    found = _library_for([*acting, *moving])
    if found is None:
        return None
    kept = [_pack(layers, 1) for layers in (acting, moving)]
    run, width = found.velap_rollout, max(_width(acting), _width(moving))
    fixed = [number for _, structs in kept for number in (ctypes.addressof(structs), len(structs))]

    def forward(z: Tensor, noise: Tensor, steps: int) -> Tensor:
        z, noise = z.contiguous(), noise.contiguous()
        assert z.dtype == noise.dtype == torch.float32
        assert z.shape[-1] + noise.shape[-1] == acting[0].weight.shape[-2]
        out = torch.empty_like(z)
        run(*fixed, z.data_ptr(), noise.data_ptr(), *noise.shape[1:], steps, residual, len(z), width, EPS, LEAK,
            out.data_ptr())
        return out

    forward.kept = kept  # type: ignore[attr-defined]  # as above
    return forward


@torch.no_grad()
def _pack(layers: Sequence[Folded], members: int) -> tuple[list[Tensor], ctypes.Array[_Layer]]:
    """Weights in panels, and the structs that point to them, member by member."""
    kept: list[Tensor] = []
    structs = (_Layer * (members * len(layers)))()
    for index, layer in enumerate(layers):
        inputs, outputs = layer.weight.shape[-2:]
        padded = -(-outputs // PANEL) * PANEL
        weight = torch.zeros(members, inputs, padded)
        weight[:, :, :outputs] = layer.weight.reshape(members, inputs, outputs)
        panels = weight.view(members, inputs, padded // PANEL, PANEL).transpose(1, 2).contiguous()
        vectors = []
        for part in (layer.bias, layer.shift):
            vectors.append(torch.zeros(members, padded))
            if part is not None:
                vectors[-1][:, :outputs] = part.reshape(members, outputs)
        kept += [panels, *vectors]
        parts = (panels, vectors[0], vectors[1] if layer.shift is not None else None)
        for member in range(members):
            addresses = [None if part is None else part[member].data_ptr() for part in parts]
            structs[member * len(layers) + index] = _Layer(inputs, outputs, *addresses)
    return kept, structs
