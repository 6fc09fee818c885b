"""Every case of tests/cases, each a program of its own as its user would meet it: exit code 0."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

CASES = sorted(Path(__file__).with_name("cases").glob("[0-9]*.py"))


def test_all_cases_are_found() -> None:
    assert len(CASES) == 21


@pytest.mark.timeout(600)
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.stem)
def test_the_case_is_mended(case: Path) -> None:
    done = subprocess.run([sys.executable, str(case)], capture_output=True, text=True, timeout=580)
    assert done.returncode == 0, done.stdout + done.stderr
