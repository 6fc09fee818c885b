"""Child processes that collect, seen from the parent."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from velap import errors
from velap.errors import DatasetError, VelapError

_CODE = "from velap.data.worker import main; main()"

Progress = Callable[[int, int], None]
"""Called with (finished trajectories, all trajectories)."""


class Worker:
    """One child process that answers requests, see `velap.data.worker`."""

    def __init__(self, job: dict[str, Any], log: Path) -> None:
        """`job` as `worker.Job` takes it; whatever the child prints goes to `log`."""
        environment = {
            **os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1",
            "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry),
        }
        self.log = log
        with log.open("wb") as stream:
            self.process = subprocess.Popen([sys.executable, "-c", _CODE, json.dumps(job)], stdin=subprocess.PIPE,
                                            stdout=subprocess.PIPE, stderr=stream, env=environment, bufsize=0)

    def ask(self, **request: Any) -> None:
        """Send a request; `answer` reads what comes back."""
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(request).encode() + b"\n")
        except BrokenPipeError as error:
            raise self._death() from error

    def answer(self) -> dict[str, Any]:
        """Wait for the answer; the worker's errors are raised here."""
        assert self.process.stdout is not None
        line = bytearray()
        while not line.endswith(b"\n"):
            part = self.process.stdout.read(65536)
            if not part:
                raise self._death()
            line += part
        answer = json.loads(line)
        if "error" not in answer:
            return answer
        kind = getattr(errors, answer["error"], None)
        if isinstance(kind, type) and issubclass(kind, VelapError):
            raise kind(answer["text"])
        raise OSError(answer["errno"], answer["text"])

    def _death(self) -> VelapError:
        code = self.process.wait()
        lines = [line for line in self.log.read_text(errors="replace").splitlines() if line.strip()]
        return DatasetError(f"a collecting process ended with code {code}: {lines[-1] if lines else 'it left no message'}. "
                            "Expected "
                            "it to finish its trajectories. The finished ones are kept: run the same command again, with "
                            "--workers 1 if memory was short.")

    def stop(self) -> None:
        """End the process now."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()


@contextmanager
def workers(count: int, job: dict[str, Any], directory: Path) -> Iterator[list[Worker]]:
    """`count` workers with their logs in `directory`; they are gone when the block is left, however it is left."""
    running: list[Worker] = []
    try:
        for number in range(count):
            running.append(Worker(job, directory / f"worker-{number}.log"))
        yield running
    finally:
        for worker in running:
            worker.stop()


def run_all(running: Sequence[Worker], requests: Sequence[dict[str, Any]], done: int, total: int,
            progress: Progress) -> None:
    """Hand out shard requests, one to each worker at a time, until all are answered; `done` of `total` are there."""
    queue = deque(requests)
    progress(done, total)
    with selectors.DefaultSelector() as selector:
        for worker in running[: len(queue)]:
            assert worker.process.stdout is not None
            worker.ask(**queue.popleft())
            selector.register(worker.process.stdout, selectors.EVENT_READ, worker)
        while selector.get_map():
            for key, _ in selector.select():
                done += key.data.answer()["trajectories"]
                progress(done, total)
                if queue:
                    key.data.ask(**queue.popleft())
                else:
                    selector.unregister(key.fileobj)
