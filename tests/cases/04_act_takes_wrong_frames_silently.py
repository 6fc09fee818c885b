"""agent.act with float frames, other sizes or without the batch axis.

huggingface/lerobot#1065, #61; DLR-RM/stable-baselines3#1497
"""

import gymnasium as gym
import numpy as np
from case import CHECKOUT, verdict

import velap
import velap.envs  # noqa: F401 - registers the tasks

bad = []
for task in ("SpiralMaze", "ButtonWall"):
    agent = velap.load(CHECKOUT / "checkpoints" / f"{task}.safetensors", "td3bc")
    frame, _ = gym.make(f"velap/{task}-v0").reset(seed=0)
    good = np.repeat(frame[None, None], agent.frame_stack, 1)
    right = agent.act(good)
    tries = {"float32 in [0, 1]": (good / 255).astype(np.float32), "float64 in 0-255": good.astype(float),
             "no batch axis": good[0], "128 x 128": good.repeat(2, 2).repeat(2, 3), "negative stride": good[:, :, ::-1]}
    for name, frames in tries.items():
        try:
            got = agent.act(frames)
            same = got.shape == right.shape and np.allclose(got, right, atol=1e-3)
            print(f"{task}, {name}: {'same action' if same else f'silently {got.tolist()} instead of {right.tolist()}'}")
            if not same and name != "negative stride":
                bad.append(name)
        except Exception as error:
            print(f"{task}, {name}: {type(error).__name__}: {str(error).splitlines()[0][:110]}")
            if not type(error).__module__.startswith("velap"):
                bad.append(name)
verdict(not bad, "what came and what is expected (or the conversion), never another action or PyTorch's words")
