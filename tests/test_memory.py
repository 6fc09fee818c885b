"""Memory: reading a dataset holds its frames once; sampling from mapped frames takes none for the frames.

Each measurement is a process of its own, on synthetic frames in a sparse file. F frames.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="memory is read from /proc")
FRAME_BYTES = 64 * 64 * 3

COMMON = """
import json, sys, time
import numpy as np, torch
from pathlib import Path
torch.set_num_threads(1)

def memory():
    fields = dict(line.split(":") for line in open("/proc/self/status"))
    return {name: int(fields[name].split()[0]) * 1024 for name in ("RssAnon", "VmHWM")}
"""
SAMPLE = COMMON + """
from velap.config.training import TrainConfig
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler

rows, steps, mapped = int(sys.argv[1]), 9, sys.argv[2] == "mapped"
path, episodes = Path(sys.argv[3]), rows // 10
if mapped:
    with path.open("wb") as file:
        file.truncate(rows * 64 * 64 * 3)
    frames = np.memmap(path, np.uint8, "c", shape=(rows, 64, 64, 3))
else:
    frames = np.ones((rows, 64, 64, 3), np.uint8)
last = np.arange(rows) % (steps + 1) == steps
won = np.roll(last, -1) & (np.arange(rows) // (steps + 1) % 4 == 0)
flags = {"rewards": won.astype(np.float32), "terminated": won, "truncated": np.roll(last, -1) & ~won}
store = FrameStore(frames=frames, actions=np.zeros((rows, 2), np.float32), **flags,
                   episode_start=np.arange(episodes) * (steps + 1), episode_length=np.full(episodes, steps),
                   action_low=-np.ones(2, np.float32), action_high=np.ones(2, np.float32), dataset_id="synthetic",
                   content_hash="0")
sampler = WindowSampler(store, TrainConfig(), 3, torch.device("cpu"), np.zeros(0, np.int64))
generator = torch.Generator().manual_seed(0)
pool = torch.randint(len(sampler.transitions), (4_000,), generator=generator)
speeds = []
for _ in range(3):
    began = time.process_time()
    for chosen in pool.split(64):
        sampler.stacks(sampler.transitions[chosen]).float().sum()
    speeds.append(3 * len(pool) / (time.process_time() - began))
print(json.dumps({**memory(), "frames/s": max(speeds)}))
"""
READ = COMMON + """
from velap.data.loading import load_store
import torch
before = memory()["VmHWM"]
store = load_store("velap/Large-v0", mapped=sys.argv[1] == "mapped")
print(json.dumps({"taken": memory()["VmHWM"] - before, "anonymous": memory()["RssAnon"], "frames": store.frames.nbytes}))
"""


def run(code: str, *arguments: object, **environment: str) -> dict[str, Any]:
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], capture_output=True, text=True, check=False,
                          env={**os.environ, "OMP_NUM_THREADS": "1", **environment})
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def test_memory_does_not_grow_with_mapped_frames(tmp_path: Path) -> None:
    small, large = (run(SAMPLE, rows, "mapped", tmp_path / "frames.bin") for rows in (20_000, 200_000))
    assert large["RssAnon"] - small["RssAnon"] < 180_000 * 150, "bytes a frame, of the 12,288 that a frame has"
    assert small["RssAnon"] < 600e6


def test_mapped_frames_are_gathered_as_fast_as_those_in_memory(tmp_path: Path) -> None:
    """Processor time, once the pages are in the cache; within 10 % on a quiet machine, which this one need not be."""
    mapped, held = (run(SAMPLE, 10_000, kind, tmp_path / "frames.bin")["frames/s"] for kind in ("mapped", "held"))
    assert mapped > 0.4 * held


@pytest.fixture(scope="module")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A Minari dataset of 20,000 frames."""
    import numpy as np

    from velap.data.frames import Episode, FrameStore
    from velap.data.writing import write_dataset

    root = tmp_path_factory.mktemp("datasets")
    images = np.random.default_rng(0).integers(0, 256, (100, 64, 64, 1), dtype=np.uint8).repeat(3, -1)
    won = np.arange(99) == 98
    episodes = (Episode(images, np.zeros((99, 2), np.float32), won * float(number % 2), won & (number % 2 == 1))
                for number in range(200))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        write_dataset(FrameStore.from_episodes(episodes, dataset_id="velap/Large-v0", action_low=-1, action_high=1))
    return root


def test_reading_holds_the_frames_once(large: Path) -> None:
    held = run(READ, "held", MINARI_DATASETS_PATH=str(large))
    assert held["frames"] == 20_000 * FRAME_BYTES
    assert held["taken"] < 1.2 * held["frames"]
    mapped = run(READ, "mapped", MINARI_DATASETS_PATH=str(large))
    assert mapped["anonymous"] < 300e6 + 0.2 * mapped["frames"]
