"""Records know --image-key and --max-steps (cf. huggingface/transformers#1187, huggingface/lerobot#1622)."""

from pathlib import Path

from case import TINY, dataset, robots, run, verdict

robots()
dataset("my/one-v0")
run("train", "--dataset", "my/one-v0", "--out", "run", "--set", *TINY)
base = ["evaluate", "robot", "--env", "robot_envs:TwoCameras-v0", "--checkpoint", "run/model.safetensors",
        "--records", "rec", "--episodes", 2]
first, _ = run(*base, "--image-key", "camera")
wrong = [run(*base, *more)[0] for more in (["--image-key", "wrist"], ["--image-key", "no_such_camera"],
                                           ["--image-key", "camera", "--max-steps", 5])]
print("exit codes:", wrong, "- records:", sum(1 for file in Path("rec").rglob("*.jsonl") for _ in file.open()))
verdict(first == 0 and 0 not in wrong, "`holds records of another run`, and an error for a key that is not there")
