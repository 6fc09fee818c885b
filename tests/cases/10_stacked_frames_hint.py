"""Grey frames stacked by a wrapper, (4, 84, 84), and stacked colour frames (Farama-Foundation/Minari#307)."""

import gymnasium as gym
import numpy as np
from case import dataset, run, verdict

dataset("my/grey-v0", gym.spaces.Box(0, 255, (4, 84, 84), np.uint8), jpeg_encoding=False)
dataset("my/rgb-v0", gym.spaces.Box(0, 255, (4, 64, 64, 3), np.uint8), jpeg_encoding=False)
_, grey = run("train", "--dataset", "my/grey-v0")
_, rgb = run("train", "--dataset", "my/rgb-v0")
verdict("newest frame" in grey and "newest frame" in rgb, "`store the newest frame alone`, or the newest frame is taken")
