"""Memory of a process that belongs to us."""

from __future__ import annotations

import contextlib
import ctypes


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks for the rest of the process: activations of some 16 MB are otherwise mapped and zeroed
    anew by the kernel at every update.

    Measured: 127 → 91 ms for the encoder's forward and backward pass of 252 frames on one core. No effect elsewhere.
    """
    trim_threshold, top_pad, mmap_max = -1, -2, -4  # malloc.h: M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(mmap_max, 0)
        mallopt(trim_threshold, 2**31 - 1)
        mallopt(top_pad, 2**26)
