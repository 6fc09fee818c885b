"""`python -m velap`: the command line."""

from __future__ import annotations

import sys

from velap.cli import main

sys.exit(main())
