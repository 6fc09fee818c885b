"""A process that takes turns with others at holding a lock: `python lock_turns.py LOCK TURNS SECONDS`.

It says when it is ready, waits for the end of its input, and prints its turns and how many of them it shared with another
holder. It stops early when its time is up.
"""

from __future__ import annotations

import contextlib
import os
import sys
import time
from pathlib import Path

from velap.storage import locked

PAUSES = {"os.remove": 0.005, "fcntl.flock": 0.001}
"""Seconds to wait before a file is removed, locked or unlocked [s]: what may happen in between, happens."""


def take_turns(path: Path, turns: int, seconds: float) -> tuple[int, int]:
    """Hold the lock `turns` times within `seconds` [s]; the turns taken, and those that were shared."""
    inside = path.with_name("inside")
    done, shared, end = 0, 0, time.monotonic() + seconds
    while done < turns and time.monotonic() < end:
        with contextlib.suppress(BlockingIOError), locked(path):
            done += 1
            try:
                os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
                time.sleep(0.01)
                inside.unlink()
            except FileExistsError:
                shared += 1
    return done, shared


if __name__ == "__main__":
    sys.addaudithook(lambda event, _: time.sleep(PAUSES[event]) if event in PAUSES else None)
    print("ready", flush=True)
    sys.stdin.read()
    print(*take_turns(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
