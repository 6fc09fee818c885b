"""How many cores there are, and how many threads PyTorch uses on them: small work is faster on one thread."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch

TRANSITIONS_A_THREAD = 512
"""Transitions of a batch up to which heads learn on one thread of a CPU. ours."""


def usable_cores() -> int:
    """Cores that this process may use; where the system does not tell (macOS, Windows), all of the machine."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


@contextmanager
def one_thread(device: torch.device, small: bool) -> Iterator[None]:
    """Within, a CPU works with one thread where the work is `small`; the setting comes back afterwards."""
    before = torch.get_num_threads()
    if not small or device.type != "cpu" or before == 1 or torch.compiler.is_compiling():
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
