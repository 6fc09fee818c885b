"""The benchmarks of `velap bench`, one function each: both sides run in turns, so that slow moments hit both.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium as gym
import numpy as np
import torch

from velap.cli.memory import keep_freed_memory
from velap.config import JointPhase, override
from velap.data.frames import FrameStore
from velap.data.loading import load_store
from velap.data.writing import write_dataset
from velap.errors import VelapError
from velap.methods.mppi import MPPIConfig, shoot
from velap.models.checkpoint import load_checkpoint, released_checkpoint
from velap.runs import make_generator
from velap.search.est import plan
from velap.tasks import get_task, make_config
from velap.threads import usable_cores
from velap.training.joint import JointLearner
from velap.training.loop import Trainer, train

TASK = "SpiralMaze"
DATASET = "bench/synthetic-v0"
GIB = 2**30
PLANS_A_TURN = 8
"""Plans for one environment in a turn: MPPI's threads keep spinning for some milliseconds after its turn."""
MPPI_BATCH = 8
"""Environments that MPPI plans for at once; larger batches are no faster a row."""


@dataclass(frozen=True)
class Measurement:
    """One side by side comparison."""

    value: float
    unit: str
    reference_name: str
    reference_value: float | None
    """In the same unit; None if the reference cannot run here."""

    @property
    def ratio(self) -> float | None:
        """Value over reference."""
        return self.value / self.reference_value if self.reference_value else None


def in_turns(sides: Sequence[Callable[[], object]], repeats: int, device: torch.device) -> list[float]:
    """Median time of each side [s], after one round to warm up; the sides take turns."""
    times: list[list[float]] = [[] for _ in sides]
    for round_ in range(repeats + 1):
        for side, kept in zip(sides, times, strict=True):
            began = time.perf_counter()
            side()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if round_:
                kept.append(time.perf_counter() - began)
    return [statistics.median(kept) for kept in times]


def synthetic_store(trajectories: int | None = None) -> FrameStore:
    """A dataset in the shape of the task's recipe: full-length trajectories, every fortieth rewarded at its end."""
    recipe = get_task(TASK).recipe
    episodes, steps = trajectories or recipe.trajectories, recipe.max_steps
    rng = np.random.default_rng(0)
    frames = np.zeros((episodes * (steps + 1), 64, 64, 3), np.uint8)
    frames[:, 16:48, 16:48] = rng.integers(0, 256, (len(frames), 32, 32, 3), np.uint8)
    last = np.arange(len(frames)) % (steps + 1) == steps
    end = np.roll(last, -1)
    rewarded = end & (np.arange(len(frames)) // (steps + 1) % 40 == 0)
    actions = rng.uniform(-1, 1, (len(frames), 2)).astype(np.float32)
    actions[last] = 0
    return FrameStore.from_arrays(frames=frames, actions=actions, rewards=rewarded.astype(np.float32), terminated=rewarded,
                                  truncated=end & ~rewarded, episode_length=np.full(episodes, steps),
                                  action_low=np.full(2, -1.0), action_high=np.full(2, 1.0), dataset_id=DATASET)


def train_minutes(device: torch.device) -> Measurement:
    """A whole training of WindowClose, the sum over its phases of updates over measured rate; on CUDA against the same
    updates without graphs, on a CPU against nothing."""
    keep_freed_memory()
    settings, minutes = make_config("WindowClose"), list[float]()
    sides = (True, False) if device.type == "cuda" else (False,)
    for graphs in sides:
        with TemporaryDirectory() as folder:
            trainer = Trainer(settings, synthetic_store(), Path(folder), 0, device)
            trainer.run.graphs = graphs
            minutes.append(training_minutes(trainer))
    updates = ", ".join(f"{phase.updates} {phase.label}" for phase in settings.train.phases)
    name = "without CUDA graphs" if len(sides) > 1 else "none"
    return Measurement(minutes[0], "min", f"{name}; updates: {updates}", minutes[1] if len(sides) > 1 else None)


def training_minutes(trainer: Trainer, warm: int = 16, count: int = 200, most: float = 6.0) -> float:
    """Minutes of all updates of a run, by each phase's rate: that of `count` updates after `warm` ones, or of as many as
    `most` [s] are enough for."""
    minutes = 0.0
    for phase in trainer.phases:
        warmed = min(warm, phase.updates - 1)
        for _ in range(warmed):
            trainer.update()
        began, done = _now(trainer.device), 0
        while done < min(count, phase.updates - warmed - 1) and (done == 0 or time.perf_counter() - began < most):
            trainer.update()
            done += 1
        minutes += phase.updates * (_now(trainer.device) - began) / done / 60
        trainer.done = phase.updates - 1  # the last one, after which the next phase begins
        trainer.update()
    return minutes


def _now(device: torch.device) -> float:
    """Time after all work of the device has finished [s]."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def train_frames_per_s(device: torch.device, frame_stack: int | None = None) -> Measurement:
    """SpiralMaze's joint updates against the encoder's forward and backward pass alone, on prepared frames.

    `frame_stack` is that of the task unless given [frames].
    """
    keep_freed_memory()
    with TemporaryDirectory() as folder:
        settings = make_config(TASK)
        frame_stack = frame_stack or settings.model.frame_stack
        settings = override(settings, model={"frame_stack": frame_stack})
        trainer = Trainer(settings, synthetic_store(), Path(folder), 0, device)
        phase, encoder = trainer.phases[0], trainer.model.encoder
        assert isinstance(phase, JointPhase), f"{TASK} begins with its joint phase"
        batch = trainer.sampler.sample(JointLearner(phase, trainer.run).draw, trainer.run.generator, phase.rewarded_share)
        stacks = trainer.sampler.stacks(batch.rows)
        updates = 4 * trainer.config.train.policy_every

        def update() -> None:
            for _ in range(updates):
                trainer.update()

        def encode() -> None:
            for _ in range(updates):
                encoder.zero_grad(set_to_none=True)
                latents = encoder(stacks)
                latents.backward(torch.ones_like(latents))

        trained, encoded = in_turns([update, encode], 12, device)
    frames = updates * len(stacks)
    return Measurement(frames / trained, "frames/s", f"encoder alone, forward and backward, batch of {len(stacks)} frames, "
                       f"stacks of {frame_stack}, bfloat16", frames / encoded)


def plan_latency(device: torch.device, batch: int, repeats: int, n_sim: int = 5) -> Measurement:
    """Time of a VELAP plan for `batch` environments at once, each, against MPPI's, both by the released checkpoint."""
    model = load_checkpoint(released_checkpoint(TASK), device)[0]
    planner = replace(make_config(TASK, "paper").planner, n_sim=n_sim)
    fns, bank = model.search_fns(), model.bank_latents
    roots = bank[torch.randint(len(bank), (batch,), generator=make_generator(0))].float()
    shots, together, seeds = MPPIConfig(), min(batch, MPPI_BATCH), count()
    plans = PLANS_A_TURN if batch == 1 else 1

    def velap_plans() -> None:
        for _ in range(plans):
            plan(fns, roots, planner, make_generator(next(seeds), device=device))

    def mppi_plans() -> None:
        shoot(fns, roots[:together], shots, make_generator(next(seeds), device=device))

    velap_s, mppi_s = in_turns([velap_plans, mppi_plans], repeats, device)
    chunk = f", {together} of the {batch} environments at once" if together < batch else ""
    name = (f"MPPI {shots.samples} × {shots.horizon} × {shots.iterations}{chunk}; VELAP {planner.n_iter} expansions of "
            f"{planner.n_sim} steps; released checkpoint")
    return Measurement(1e3 * velap_s / (plans * batch), "ms/environment", name, 1e3 * mppi_s / together)


META_WORLD = """
import sys, gymnasium
env = gymnasium.make("metaworld:Meta-World/MT1", env_name="window-close-v3", render_mode="rgb_array", width=64, height=64,
                     camera_name="corner", disable_env_checker=True)
env.reset(seed=0)
env.action_space.seed(0)
print(env.render().std(), flush=True)
for line in sys.stdin:
    for _ in range(int(line)):
        env.step(env.action_space.sample())
        env.render()
    print("done", flush=True)
"""
"""Meta-World as delivered, in a process of its own: two OpenGL contexts in one process disturb each other."""


@contextmanager
def meta_world(backend: str) -> Iterator[Callable[[int], object] | None]:
    """A function that runs a number of steps of WindowClose with 64 × 64 pixels; None without Meta-World."""
    environment = {key: value for key, value in os.environ.items() if key != "LP_NUM_THREADS"}
    with subprocess.Popen([sys.executable, "-c", META_WORLD], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                          stderr=subprocess.DEVNULL, text=True, env={**environment, "MUJOCO_GL": backend}) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        pipes = child.stdin, child.stdout

        def run(steps: int) -> str:
            print(steps, file=pipes[0], flush=True)
            return pipes[1].readline()

        try:
            draws = float(child.stdout.readline() or 0) > 0
            yield run if draws else None
        finally:
            child.kill()


def env_steps_per_s(device: torch.device, name: str) -> Measurement:
    """Steps of a task with their 64 × 64 frame, random actions, against those of Meta-World's WindowClose, in turns."""
    from velap.envs.gl import working_backend

    env: gym.Env[Any, Any] = gym.make(f"velap.envs:{get_task(name).env_id}")
    env.action_space.seed(0)
    env.reset(seed=0)
    steps, reference_steps = min(300, get_task(name).max_steps), 12

    def ours() -> None:
        env.reset()
        for _ in range(steps):
            env.step(env.action_space.sample())

    backend, note = working_backend(), "" if name == "WindowClose" else "another task: "
    described = f"{note}Meta-World's window-close-v3, step + render(64 × 64), {backend}"
    with meta_world(backend) as reference:
        if reference is None:
            (seconds,) = in_turns([ours], 5, device)
            return Measurement(steps / seconds, "steps/s", f"{described}; it does not run here", None)
        seconds, theirs = in_turns([ours, lambda: reference(reference_steps)], 5, device)
    env.close()
    return Measurement(steps / seconds, "steps/s", described, reference_steps / theirs)


COLLECTED_CONTEXTS = 20
"""Contexts of WindowClose that `collect_frames_per_s` collects, of 200."""


def collect_frames_per_s(device: torch.device) -> Measurement:
    """`velap collect WindowClose` on all cores, from the start of its processes to the written dataset with its card.

    The bound: 100,000 frames in 10 minutes on 2 cores.
    """
    from velap.data.collection import collect

    task = get_task("WindowClose")
    short = replace(task, recipe=replace(task.recipe, contexts=COLLECTED_CONTEXTS))
    with TemporaryDirectory() as folder, _datasets_in(folder):
        result = collect(short, dataset_id="bench/collected-v0")
    cores = usable_cores()
    return Measurement((result.transitions + result.episodes) / result.seconds, "frames/s",
                       f"the bound: 100,000 frames in 10 minutes; {COLLECTED_CONTEXTS} contexts of WindowClose, "
                       f"{cores} cores",
                       100_000 / 600)


@contextmanager
def _datasets_in(folder: str) -> Iterator[None]:
    """Put Minari's datasets into `folder`."""
    key = "MINARI_DATASETS_PATH"
    before = os.environ.get(key)
    os.environ[key] = folder
    try:
        yield
    finally:
        os.environ.pop(key)
        if before is not None:
            os.environ[key] = before


def train_rss(device: torch.device) -> Measurement:
    """Peak memory of a training process (dataset read, both phases, checkpoints) beyond the bytes of its dataset."""
    with TemporaryDirectory() as folder:
        _child("write_synthetic()", folder)
        run_dir = str(Path(folder) / "run")
        peak, dataset = (int(number) for number in _child(f"print_peak({run_dir!r}, {device.type!r})", folder).split())
    return Measurement((peak - dataset) / GIB, "GiB", f"the bound: 2 GiB beyond the dataset's {dataset / GIB:.2f}", 2.0)


def _child(call: str, datasets: str) -> str:
    """The last line that a function of this module prints in a process of its own."""
    code = f"from studies.speed.benchmarks import *; {call}"
    done = subprocess.run([sys.executable, "-c", code], env={**os.environ, "MINARI_DATASETS_PATH": datasets},
                          capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["it left no message"])[-1]
        raise VelapError(f"`{call}` ended with code {done.returncode} in a process of its own: {reason}. Expected it to "
                         "finish; measure the other benchmarks with --only, or report it.")
    return (done.stdout.splitlines() or [""])[-1]


def write_synthetic() -> None:
    """Body of the process that writes the dataset of `train_rss`."""
    write_dataset(synthetic_store())


def print_peak(run_dir: str, device: str) -> None:
    """Body of the process that `train_rss` measures: trains and prints its peak and the dataset's size [bytes]."""
    short = {"joint": {"steps": 30}, "latent": {"steps": 30}, "checkpoint_every": 20, "log_every": 10}
    store = load_store(DATASET)
    train(override(make_config(TASK), train=short), store, Path(run_dir), device=device)
    print(peak_memory(), store.nbytes)


def peak_memory() -> int:
    """Largest resident memory of this process so far [bytes]; getrusage would include the process that forked it."""
    import resource

    status = Path("/proc/self/status")
    if status.exists():
        return next(1024 * int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
