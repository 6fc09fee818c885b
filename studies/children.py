"""Child processes that run one command of velap each, and end when their parent does.

Imported by the child before anything heavy: the standard library only.
"""

from __future__ import annotations

import contextlib
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

CODE = ("import sys; from studies.children import follow_parent; follow_parent(); from velap.cli import main; "
        "sys.exit(main())")
"""What a child runs: the command line, by whatever name velap was imported here."""
GRACE_SECONDS = 60.0
"""A child that is told to stop has this long to save its state [s]. ours: one training update and one checkpoint."""
TAIL_BYTES = 4096
PROGRESS = re.compile(r": (\d+) of (\d+)(?:  (.*))?$")


def follow_parent() -> None:
    """Called in the child: Ctrl-C as soon as the parent is gone, the hard way if that is not enough.

    The parent holds the other end of standard input, so that the kernel tells of its death however it died.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's `&` leaves it ignored

    def watch(pipe: int) -> None:
        while os.read(pipe, 1):
            pass
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(GRACE_SECONDS)
        os._exit(1)

    pipe = os.dup(0)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    threading.Thread(target=watch, args=(pipe,), daemon=True).start()


class Child:
    """One running command."""

    def __init__(self, command: Sequence[str], log: Path, threads: int, code: str = CODE,
                 keep_open: Sequence[int] = ()) -> None:
        """Start `velap command` with so many threads; what it prints goes to `log`, it holds the descriptors `keep_open`."""
        self.log = log
        self._threads, self._processor_seconds = threads, 0.0
        log.parent.mkdir(parents=True, exist_ok=True)
        count = str(threads)
        environment = {**os.environ, "OMP_NUM_THREADS": count, "OPENBLAS_NUM_THREADS": count, "MKL_NUM_THREADS": count,
                       "COLUMNS": "200", "PYTHONUNBUFFERED": "1", "VELAP_LINE_EVERY": "3",
                       "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        self._began = time.monotonic()
        with log.open("wb") as stream:
            # A session of its own: Ctrl-C on the terminal reaches the parent alone, which then stops its children.
            self._process = subprocess.Popen([sys.executable, "-c", code, *command], stdin=subprocess.PIPE, stdout=stream,
                                             stderr=subprocess.STDOUT, env=environment, pass_fds=tuple(keep_open),
                                             start_new_session=True)

    @property
    def seconds(self) -> float:
        """Time since the start [s]."""
        return time.monotonic() - self._began

    @property
    def work_seconds(self) -> float:
        """What it took once it has ended: processor time with one thread, so that neither a pause nor a neighbour of the
        machine counts; with several, which spin while they wait for each other, the time since the start [s]."""
        return self._processor_seconds if self._threads == 1 else self.seconds

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def poll(self) -> int | None:
        """The exit code, None while it runs."""
        with self._reaping():
            return self._process.poll()

    @contextlib.contextmanager
    def _reaping(self) -> Iterator[None]:
        """Counts the processor time of the process if it is waited for inside: the kernel then adds it to its parent's."""
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        yield
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        self._processor_seconds += after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    def stop(self) -> None:
        """Tell it to save and end; `end` waits for that."""
        with contextlib.suppress(ProcessLookupError):
            self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for its end, and force it after the grace time."""
        with self._reaping():
            try:
                self._process.wait(GRACE_SECONDS)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()

    def progress(self) -> tuple[int, int, str] | None:
        """(done, total, text) of the last progress line that it printed."""
        for line in reversed(self._tail()):
            found = PROGRESS.search(line)
            if found:
                return int(found[1]), int(found[2]), found[3] or ""
        return None

    def last_words(self) -> str:
        """The last line that it printed: the error of one that failed."""
        lines = self._tail()
        return lines[-1].removeprefix("velap: ") if lines else "it printed nothing"

    def _tail(self) -> list[str]:
        with self.log.open("rb") as stream:
            stream.seek(0, os.SEEK_END)
            stream.seek(max(stream.tell() - TAIL_BYTES, 0))
            text = stream.read().decode(errors="replace")
        return [line.strip() for line in text.splitlines() if line.strip()]
