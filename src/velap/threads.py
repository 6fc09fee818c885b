"""How many threads PyTorch uses on a CPU: small work is faster on one, the others only spin beside it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

TRANSITIONS_A_THREAD = 512
"""Transitions of a batch up to which heads learn on one thread of a CPU. ours."""


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
