"""Wrong input that ends in a traceback instead of a paragraph."""

from case import CHECKOUT, run, verdict

import velap

records = ["--records", CHECKOUT / "results/records-five-recipes"]
random = ["evaluate", "SpiralMaze", "--method", "random", "--episodes", 1]
tries = {"long id": ["train", "--dataset", "a" * 260 + "-v0"],
         "negative seed": [*random, "--first-seed", -1, "--records", "rec"],
         "table into a new file": ["table", *records, "--write", "new.md"]}
bad = [name for name, args in tries.items() if "Traceback" in run(*args)[1]]
if "Traceback" in run(*random, "--records", "rec2", env={"VELAP_LINE_EVERY": "abc"})[1]:
    bad.append("VELAP_LINE_EVERY=abc")
try:
    velap.load(CHECKOUT / "checkpoints/SpiralMaze.safetensors", device="mps")
except Exception as error:
    if not type(error).__module__.startswith("velap"):
        bad.append(f"load(device='mps'): {type(error).__name__}: {error}")
print(bad)
verdict(not bad, "one paragraph each")
