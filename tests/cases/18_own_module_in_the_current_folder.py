"""`--env my_package:Robot-v0` with my_package.py in the current folder.

openai/gym#1186, DLR-RM/stable-baselines3#259
"""

from case import CHECKOUT, robots, run, verdict

robots()
code, text = run("evaluate", "x", "--env", "robot_envs:Robot-v0", "--method", "random", "--episodes", 1, "--records", "rec",
                 env={"PYTHONPATH": str(CHECKOUT / "src")})
verdict(code == 0 or "PYTHONPATH" in text, "the current folder is searched as by `python -m`, or PYTHONPATH=. is said")
