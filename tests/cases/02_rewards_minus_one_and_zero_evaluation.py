"""An environment that gives -1 a step and ends with 0 at the goal: episodes are recorded as not solved (openai/gym#1727)."""

from case import robots, run, verdict

robots()
code, text = run("evaluate", "x", "--env", "robot_envs:MinusOne-v0", "--method", "random", "--episodes", 3, "--records",
                 "rec")
verdict("0 solved" not in text, "3 of 3 solved, or a message that rewards that are never positive do not tell success")
