"""What a collecting process does: it runs trajectories and leaves them as shards; `velap.data.collection` hands them out.

The processes are loky's: scripts need no main guard, and one that dies is noticed.
"""

from __future__ import annotations

import hashlib
import io
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from loky import ProcessPoolExecutor

from velap.data.behaviours import position_of, run_trajectory
from velap.envs.protocol import Mapped
from velap.errors import DatasetError, VelapError
from velap.storage import replace_file
from velap.tasks import Recipe

TEST_STARTS = 100
"""Test starts shown on the card: those of the test seeds 0-99."""
PARENT_SECONDS = 1.0
"""How often a worker looks whether its parent is alive [s]."""

Progress = Callable[[int, int], None]
"""Called with (finished trajectories, all trajectories)."""


@dataclass(frozen=True)
class Job:
    """What every worker of one collection knows."""

    env_id: str
    recipe: Recipe
    shares: tuple[tuple[str, float], ...]
    """Behaviours and their shares."""
    seed: int
    shards: Path


@dataclass(frozen=True)
class Shard:
    """Trajectories `first` to `first + count - 1` of a context."""

    name: str
    context: int
    first: int
    count: int


@cache
def make_env(env_id: str) -> gym.Env:
    """This process's environment of a Gymnasium id; ids without a module are velap's own."""
    return gym.make(env_id if ":" in env_id else f"velap.envs:{env_id}", disable_env_checker=True)


@cache
def describe(job: Job) -> dict[str, Any]:
    """Spaces, and a fingerprint of physics and pixels that tells whether shards of another run belong to this one."""
    env, digest = make_env(job.env_id), hashlib.sha256()
    spec = env.spec
    if spec is not None and callable(spec.entry_point):  # registered by its class, which JSON cannot hold
        spec = None
    first = run_trajectory(env, job.recipe, dict(job.shares), job.seed, 0, 0)
    for value in first.values():
        digest.update(np.ascontiguousarray(value).tobytes())
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    return {
        "fingerprint": digest.hexdigest(),
        "frame_shape": list(first["frames"].shape[1:]),
        "action_low": space.low.tolist(),
        "action_high": space.high.tolist(),
        "env_spec": spec.to_json() if spec is not None else None,
        "extent": list(env.unwrapped.extent) if isinstance(env.unwrapped, Mapped) else [],
    }


def collect_shard(job: Job, shard: Shard, fingerprint: str) -> int:
    """Run the shard's trajectories and write them, whole or not at all; gives their number.

    Raises DatasetError where this process does not see the pixels of `fingerprint`.
    """
    if describe(job)["fingerprint"] != fingerprint:
        raise DatasetError(f"two processes got different frames from {job.env_id} for one seed; expected equal ones. The "
                           "environment or the renderer is not deterministic: use another renderer (MUJOCO_GL=osmesa, say) "
                           "or --workers 1.")
    env, numbers = make_env(job.env_id), range(shard.first, shard.first + shard.count)
    runs = [run_trajectory(env, job.recipe, dict(job.shares), job.seed, shard.context, number) for number in numbers]
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {key: np.concatenate([run[key] for run in runs]) for key in runs[0]}
    np.savez_compressed(buffer, **arrays)
    replace_file(job.shards / shard.name, buffer.getvalue())
    return shard.count


def test_starts(job: Job) -> list[list[float]]:
    """Positions of the agent at the test starts [m], empty where the environment does not tell."""
    env, starts = make_env(job.env_id), []
    for seed in range(TEST_STARTS):
        env.reset(seed=seed, options={"split": "test"})
        starts.append([round(float(value), 6) for value in position_of(env)])
    return starts if starts[0] else []


def _named(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a worker; errors of the environment become a DatasetError that names them."""
    try:
        return function(*arguments)
    except (VelapError, OSError):
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise DatasetError(f"a collecting process failed: {reason}. Expected it to finish its trajectories. Mend the "
                           "environment; the finished trajectories are kept for the same command.") from error


def _follow(parent: int) -> None:
    """Prepare a worker: the parent handles Ctrl-C, and a worker ends when its parent is gone, however that ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_SECONDS)
        os._exit(1)

    if os.name == "posix":
        threading.Thread(target=watch, daemon=True).start()


class Workers:
    """Processes that collect one job."""

    def __init__(self, executor: ProcessPoolExecutor, job: Job) -> None:
        self._executor, self._job = executor, job

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """The result of `function(job, *arguments)` in one of the processes."""
        return self._executor.submit(_named, function, self._job, *arguments).result()

    def collect(self, shards: list[Shard], fingerprint: str) -> Iterator[int]:
        """The trajectories of each shard as it is finished, in any order; the first error ends all."""
        futures = [self._executor.submit(_named, collect_shard, self._job, shard, fingerprint) for shard in shards]
        for future in as_completed(futures):
            yield future.result()


@contextmanager
def workers(count: int, job: Job) -> Iterator[Workers]:
    """`count` processes; they are gone when the block is left, however it is left."""
    one_thread = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
    executor = ProcessPoolExecutor(count, env=one_thread, initializer=_follow,
                                   initargs=(os.getpid(),))
    try:
        yield Workers(executor, job)
    except BrokenExecutor as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"a collecting process ended by itself: {reason} Expected it to finish its trajectories. The "
                           "finished ones are kept: run the same command again, with --workers 1 if memory was "
                           "short.") from error
    finally:
        executor.shutdown(wait=True, kill_workers=True)
