"""`--method random` on Box(-inf, inf) actions (DLR-RM/stable-baselines3#1850, #897)."""

from case import robots, run, verdict

robots()
code, text = run("evaluate", "x", "--env", "robot_envs:Unbounded-v0", "--method", "random", "--episodes", 1, "--records",
                 "rec")
verdict("Traceback" not in text, "gym's own sample(), or one paragraph")
