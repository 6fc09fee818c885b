"""`--video` in one's own environment, which has frames only in a render mode (Farama-Foundation/Gymnasium#560, #99)."""

from case import robots, run, verdict

robots()
code, text = run("evaluate", "x", "--env", "robot_envs:Robot-v0", "--method", "random", "--episodes", 1, "--records", "rec",
                 "--video")
verdict(code == 0 and "Traceback" not in text, "a film; else one paragraph before the episodes run")
