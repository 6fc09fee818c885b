"""Rewards of OGBench, AntMaze and Fetch: -1 a step, 0 at the goal (seohongpark/ogbench#26, openai/gym#1727)."""

import numpy as np
from case import TINY, dataset, run, verdict

dataset("my/ogb-v0", reward=lambda rng, n, won: np.r_[-np.ones(n - 1), 0.0 if won else -1.0])
code, _ = run("train", "--dataset", "my/ogb-v0", "--out", "run", "--set", *TINY)
verdict(code == 0, "the higher of two values is success: reward 0 is read as 1, -1 as 0")
