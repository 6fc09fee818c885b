"""Memory: reading a dataset holds its frames once; sampling and training from mapped frames take none for the frames.

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
PATH = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])

COMMON = """
import json, sys, time
import numpy as np, torch
from pathlib import Path
torch.set_num_threads(1)

def memory():
    fields = dict(line.split(":") for line in open("/proc/self/status"))
    return {name: int(fields[name].split()[0]) * 1024 for name in ("RssAnon", "VmHWM")}
"""
STORE = COMMON + """
from velap.config.training import TrainConfig
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler

def make_store(rows, side, path):
    "Episodes of nine steps, a quarter of them successful; frames mapped from `path`, or held in memory where it is None."
    steps, episodes, shape = 9, rows // 10, (rows, side, side, 3)
    if path is None:
        frames = np.ones(shape, np.uint8)
    else:
        with path.open("wb") as file:
            file.truncate(int(np.prod(shape)))
        frames = np.memmap(path, np.uint8, "c", shape=shape)
    last = np.arange(rows) % (steps + 1) == steps
    won = np.roll(last, -1) & (np.arange(rows) // (steps + 1) % 4 == 0)
    flags = {"rewards": won.astype(np.float32), "terminated": won, "truncated": np.roll(last, -1) & ~won}
    actions = np.random.default_rng(0).uniform(-1, 1, (rows, 2)).astype(np.float32)
    return FrameStore(frames=frames, actions=actions, **flags, episode_start=np.arange(episodes) * (steps + 1),
                      episode_length=np.full(episodes, steps), action_low=-np.ones(2, np.float32),
                      action_high=np.ones(2, np.float32), dataset_id="synthetic", content_hash="0")
"""
SAMPLE = STORE + """
store = make_store(int(sys.argv[1]), 64, Path(sys.argv[3]) if sys.argv[2] == "mapped" else None)
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
TRAIN = STORE + """
import threading
from velap.cli.memory import keep_freed_memory
from velap.config import Config, training
from velap.training.loop import Trainer
from tiny_training import SMALL, TinyEncoder

keep_freed_memory()  # as the command line does
training.DISTIL_STEPS, TinyEncoder.chunk = 2, 256
highest = 0

def watch():
    global highest
    while True:
        highest = max(highest, memory()["RssAnon"])
        time.sleep(0.02)

store = make_store(int(sys.argv[1]), 32, Path(sys.argv[2]) / "frames.bin")
settings = Config("test", "default", model=SMALL, train=TrainConfig(phases=tuple(
    kind(2, **more) for kind, more in ((training.EncoderPhase, {"pairs": 8}), (training.JointPhase, {"windows": 3}),
    (training.LatentPhase, {"horizon": 3}), (training.ValuePhase, {}), (training.EnsemblePhase, {"members": 2}),
    (training.ClonePhase, {}))), log_every=2, checkpoint_every=2))
assert {type(phase) for phase in settings.train.phases} == set(training.PHASES.values())
threading.Thread(target=watch, daemon=True).start()
run = Trainer(settings, store, Path(sys.argv[2]) / "run", 0, torch.device("cpu"))
while run.step < run.total:
    run.update()
run.run_dir.mkdir(exist_ok=True)
run.save()
run.finish("test")
print(json.dumps({**memory(), "highest": highest}))
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


@pytest.mark.timeout(600)
def test_memory_of_a_training_does_not_grow_with_mapped_frames(tmp_path: Path) -> None:
    """Through a phase of every kind, diagnostics, saving and the end."""
    small, large = (run(TRAIN, rows, tmp_path, PYTHONPATH=PATH) for rows in (10_000, 60_000))
    assert large["highest"] - small["highest"] < 50_000 * 2_000, "bytes a frame, of the 3,072 that a frame has"


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
