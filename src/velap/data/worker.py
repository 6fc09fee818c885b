"""A collecting process: reads jobs as JSON lines, answers each with a JSON line, leaves finished trajectories as shards.

It is a plain child process, not one of `multiprocessing`: scripts need no main guard, and when the parent dies, however it
dies, the pipe closes and the worker ends.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import signal
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

import gymnasium as gym
import numpy as np

from velap.data.behaviours import position_of, run_trajectory
from velap.errors import VelapError
from velap.storage import replace_file
from velap.tasks import Recipe

TEST_STARTS = 100
"""Test starts shown on the card: those of the test seeds 0-99."""


@dataclass(frozen=True)
class Job:
    """What every worker of one collection knows."""

    env_id: str
    recipe: Recipe
    shares: dict[str, float]
    seed: int
    shards: Path


def make_env(env_id: str) -> gym.Env:
    """The environment of a Gymnasium id; ids without a module are velap's own."""
    return gym.make(env_id if ":" in env_id else f"velap.envs:{env_id}", disable_env_checker=True)


def describe(env: gym.Env, job: Job) -> dict[str, Any]:
    """Spaces, and a fingerprint of physics and pixels that tells whether shards of another run belong to this one."""
    digest = hashlib.sha256()
    first = run_trajectory(env, job.recipe, job.shares, job.seed, 0, 0)
    for value in first.values():
        digest.update(np.ascontiguousarray(value).tobytes())
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    return {
        "fingerprint": digest.hexdigest(),
        "frame_shape": list(first["frames"].shape[1:]),
        "action_low": space.low.tolist(),
        "action_high": space.high.tolist(),
        "env_spec": env.spec.to_json() if env.spec is not None else None,
        "extent": list(getattr(env.unwrapped, "extent", ())),
    }


def collect_shard(env: gym.Env, job: Job, name: str, context: int, first: int, count: int) -> dict[str, Any]:
    """Run `count` trajectories and write them as `name`, whole or not at all."""
    runs = [run_trajectory(env, job.recipe, job.shares, job.seed, context, first + number) for number in range(count)]
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {key: np.concatenate([run[key] for run in runs]) for key in runs[0]}
    np.savez_compressed(buffer, **arrays)
    replace_file(job.shards / name, buffer.getvalue())
    return {"shard": name, "trajectories": count}


def test_starts(env: gym.Env) -> dict[str, Any]:
    """Positions of the agent at the test starts [m]."""
    starts = []
    for seed in range(TEST_STARTS):
        env.reset(seed=seed, options={"split": "test"})
        starts.append([round(float(value), 6) for value in position_of(env)])
    return {"test_starts": starts if starts[0] else []}


def _answer(env: gym.Env, job: Job, request: dict[str, Any]) -> dict[str, Any]:
    kind = request.pop("kind")
    if kind == "describe":
        return describe(env, job)
    if kind == "shard":
        return collect_shard(env, job, **request)
    return test_starts(env)


def serve(job: Job, requests: TextIO, answers: TextIO) -> None:
    """Answer requests until the pipe closes. Errors meant for the user travel as answers, others end the process."""
    env: gym.Env | None = None
    for line in requests:
        try:
            env = env or make_env(job.env_id)
            answer = _answer(env, job, json.loads(line))
        except VelapError as error:
            answer = {"error": type(error).__name__, "text": str(error)}
        except OSError as error:
            answer = {"error": "OSError", "errno": error.errno, "text": error.strerror or str(error)}
        print(json.dumps(answer), file=answers, flush=True)


def main() -> None:
    """Entry point of the child process: the job stands in the first argument."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent stops its workers
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever a library prints goes to the log, not between the answers
    raw = json.loads(sys.argv[1])
    job = Job(raw["env_id"], Recipe(**raw["recipe"]), raw["shares"], raw["seed"], Path(raw["shards"]))
    try:
        serve(job, sys.stdin, answers)
    except BrokenPipeError:
        os._exit(1)
    except Exception:
        traceback.print_exc()
        os._exit(1)
