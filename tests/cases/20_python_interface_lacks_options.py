"""velap.evaluate has image_key and max_steps; velap.train(out='...') takes a str (huggingface/lerobot#905)."""

import inspect
from pathlib import Path

from case import dataset, robots, verdict

import velap

robots()
dataset("my/one-v0")
changes = {"train": {"joint": {"steps": 4, "windows": 4}, "latent": {"steps": 2}}}
problems = [name for name in ("image_key", "max_steps") if name not in inspect.signature(velap.evaluate).parameters]
try:
    velap.train("my/one-v0", out="run", changes=changes)
except TypeError as error:
    problems.append(f"out='run': {error}")
checkpoint = velap.train("my/one-v0", out=Path("run2"), changes=changes)
try:
    velap.evaluate("x", checkpoint, env="robot_envs:TwoCameras-v0", image_key="camera", episodes=1, records="rec")
except Exception as error:
    problems.append(f"two cameras: {error}")
print(*problems, sep="\n")
verdict(not problems, "what the command line can, Python can; paths may be str as in load and evaluate")
