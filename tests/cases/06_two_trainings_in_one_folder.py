"""Two processes train into the same run folder (deepinv/deepinv#550, meta-pytorch/torchtune#481)."""

import json
from pathlib import Path

from case import TINY, dataset, start, verdict

dataset("my/one-v0")
more = ["train.joint.steps=60", "train.checkpoint_every=10", "train.log_every=5"]
both = [start("train", "--dataset", "my/one-v0", "--out", "run", "--seed", seed, "--set", *TINY, *more) for seed in (0, 1)]
for seed, one in enumerate(both):
    text = one.communicate()[0]
    print("seed", seed, "exit", one.returncode, "|", text.strip().splitlines()[-1][:220])
steps = [json.loads(line)["step"] for line in Path("run/metrics.jsonl").read_text().splitlines()]
print("metrics.jsonl:", steps)
verdict(steps == sorted(set(steps)), "the second one is refused at once; one run's metrics alone")
