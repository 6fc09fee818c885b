"""An environment that has pixels only with an argument, as gym_pusht's obs_type='pixels'.

DLR-RM/rl-baselines3-zoo#404, araffin/rl-baselines-zoo#58
"""

from case import robots, run, verdict

robots()
base = ["evaluate", "x", "--env", "robot_envs:Pixels-v0", "--method", "random", "--episodes", 1, "--records", "rec"]
code, text = run(*base)
given, _ = run(*base, "--env-kwargs", "obs_type=pixels")
verdict(given == 0 and "render the frames into the dataset" not in text, "--env-kwargs, and a message about the environment")
