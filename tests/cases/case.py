"""What the cases share: a folder of their own, the command line in another process, a small dataset and small robots."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

warnings.filterwarnings("ignore")
CHECKOUT = Path(__file__).resolve().parents[2]
HERE = Path(tempfile.mkdtemp(prefix="velap-case-"))
"""Where the case works; gone at its end."""
(HERE / "data").mkdir()
os.chdir(HERE)
os.environ.update(OMP_NUM_THREADS="1", MINARI_DATASETS_PATH=str(HERE / "data"),
                  PYTHONPATH=os.pathsep.join([str(HERE), str(CHECKOUT / "src"), os.environ.get("PYTHONPATH", "")]))
sys.path[:0] = [str(HERE), str(CHECKOUT / "src")]
VELAP = [sys.executable, "-P", "-m", "velap"]
"""The command as an installed `velap` starts it: Python puts no folder of the user's into `sys.path`."""
TINY = ["train.joint.steps=6", "train.latent.steps=4", "train.joint.windows=4", "train.checkpoint_every=3",
        "train.log_every=3"]
"""A training of ten updates."""


def run(*args: Any, env: dict[str, str] | None = None, command: list[str] | None = None, timeout: float = 150,
        ) -> tuple[int, str]:
    """Run the command line; its exit code and all that it printed."""
    done = subprocess.run([*(command or VELAP), *map(str, args)], capture_output=True, text=True, timeout=timeout,
                          env={**os.environ, **(env or {})})
    text = done.stdout + done.stderr
    print("$ velap", *args, f"-> exit {done.returncode}")
    print("   ", "\n    ".join(text.strip().splitlines()[-4:]))
    return done.returncode, text


def start(*args: Any) -> subprocess.Popen[str]:
    """The command line in another process, under way."""
    return subprocess.Popen([*VELAP, *map(str, args)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def verdict(ok: bool, expected: str) -> NoReturn:
    """End the case: exit code 0 where it is mended."""
    print("PASS" if ok else f"FAIL, expected: {expected}")
    shutil.rmtree(HERE, ignore_errors=True)
    sys.exit(not ok)


def dataset(name: str, observation_space: Any = None, observe: Callable[[int], Any] | None = None, action_space: Any = None,
            reward: Callable[[Any, int, bool], Any] | None = None, infos: Callable[[int, bool], Any] | None = None,
            episodes: int = 12, steps: int = 12, **more: Any) -> None:
    """A Minari dataset of noise; every third episode ends in a success."""
    import gymnasium as gym
    import minari
    import numpy as np
    from minari.data_collector.episode_buffer import EpisodeBuffer

    rng = np.random.default_rng(0)
    space = observation_space or gym.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    observe = observe or (lambda n: rng.integers(0, 256, (n, *space.shape)).astype(space.dtype))
    action_space = action_space or gym.spaces.Box(-1, 1, (2,), np.float32)
    buffers = []
    for episode in range(episodes):
        won = episode % 3 == 0
        rewards, ends = np.zeros(steps, np.float32), np.zeros(steps, bool)
        rewards[-1], ends[-1] = won, True
        if reward is not None:
            rewards = np.asarray(reward(rng, steps, won), np.float32)
        actions = rng.uniform(-1, 1, (steps, *action_space.shape)).astype(np.float32)
        buffers.append(EpisodeBuffer(id=episode, observations=observe(steps + 1), actions=actions, rewards=rewards,
                                     terminations=ends & won, truncations=ends & (not won),
                                     infos=infos(steps, won) if infos else None))
    minari.create_dataset_from_buffers(name, buffers, observation_space=space, action_space=action_space, **more)


def robots() -> None:
    """Put `robot_envs.py` with small environments beside the user."""
    shutil.copy(Path(__file__).with_name("robot_envs.py"), HERE)
