"""`velap train --set a=b SpiralMaze`: the task becomes a setting, as if none was given (brentyi/tyro#443, #46)."""

from case import run, verdict

code, text = run("train", "--set", "train.joint.steps=5", "SpiralMaze")
verdict("the task None" not in text and "SpiralMaze" in text, "its dataset is asked for, or `put the task before --set`")
