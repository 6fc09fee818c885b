"""`velap --version` and `python -m velap` (python-gitlab/python-gitlab#713)."""

import sys

from case import run, verdict

version, _ = run("--version")
module, _ = run("--help", command=[sys.executable, "-m", "velap"])
verdict(version == 0 and module == 0, "both work")
