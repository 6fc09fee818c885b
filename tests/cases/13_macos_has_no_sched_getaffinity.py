"""macOS: os.sched_getaffinity is Linux only (vllm-project/vllm#19120, scverse/scirpy#517)."""

import subprocess
import sys

from case import HERE, run, verdict

(HERE / "mac.py").write_text("""import os, sys
if hasattr(os, "sched_getaffinity"): del os.sched_getaffinity
from velap.cli import main
sys.exit(main(sys.argv[1:]))
""")
code, text = run("collect", "NoSuchTask", command=[sys.executable, "mac.py"])
try:
    code, text = run("collect", "SpiralMaze", command=[sys.executable, "mac.py"], timeout=20)
except subprocess.TimeoutExpired:
    text = ""
verdict("AttributeError" not in text, "the number of cores where there is no affinity")
