"""`velap demo` from an installed wheel in another folder: the checkpoint is found (cf. perezjln/gym-lowcostrobot#28)."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

from case import CHECKOUT, HERE, run, verdict

pip = [sys.executable, "-m", "pip"]
Path("copy").mkdir()
for name in ("pyproject.toml", "README.md", "LICENSE"):
    shutil.copy(CHECKOUT / name, "copy")
for name in ("src", "checkpoints"):
    shutil.copytree(CHECKOUT / name, Path("copy") / name, ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
subprocess.run([*pip, "wheel", "./copy", "--no-deps", "--no-build-isolation", "-q", "-w", "wheel"], check=True)
wheels = [str(path) for path in Path("wheel").glob("*.whl")]
subprocess.run([*pip, "install", "-q", "--no-deps", "--target", "site", *wheels], check=True)
Path("else").mkdir()
os.chdir("else")
code, _ = run("demo", "--episodes", 1, env={"PYTHONPATH": str(HERE / "site")},
              command=[sys.executable, str(HERE / "site/bin/velap")])
verdict(code == 0, "the released checkpoints travel with the wheel (16 MB)")
