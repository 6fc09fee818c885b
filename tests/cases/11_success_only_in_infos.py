"""Dense reward, success in infos['success'], as in Meta-World and ManiSkill.

Farama-Foundation/Metaworld#331, robocasa/robocasa#165
"""

import numpy as np
from case import TINY, dataset, run, verdict

dataset("my/dense-v0", reward=lambda rng, n, won: rng.normal(size=n),
        infos=lambda n, won: {"success": np.array([False] * n + [won])})
code, text = run("train", "--dataset", "my/dense-v0", "--out", "run", "--set", *TINY)
verdict(code == 0 or "infos" in text, "infos['success'] is read as evaluation reads it, or the message names it")
