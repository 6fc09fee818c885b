"""SIGTERM, as clusters send before they take a machine (NVIDIA-NeMo/Automodel#405, Lightning-AI/pytorch-lightning#1455)."""

import signal
import time
from pathlib import Path

from case import TINY, dataset, start, verdict

dataset("my/one-v0")
one = start("train", "--dataset", "my/one-v0", "--out", "run", "--set", *TINY, "train.joint.steps=2000",
            "train.checkpoint_every=500", "train.log_every=5")
metrics = Path("run/metrics.jsonl")
while one.poll() is None and not (metrics.exists() and metrics.stat().st_size > 1000):
    time.sleep(0.2)
one.send_signal(signal.SIGTERM)
text = one.communicate()[0]
print("exit", one.returncode, "| state kept:", Path("run/state.safetensors").exists(), "|", text[-120:])
verdict(Path("run/state.safetensors").exists(), "the state is saved as after Ctrl-C")
