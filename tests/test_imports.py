"""Import order and start-up: the layers hold, and the command line loads nothing heavy before it has to."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def test_layers_hold() -> None:
    code = "from importlinter.cli import lint_imports_command; lint_imports_command()"
    result = subprocess.run([sys.executable, "-c", code, "--no-cache"], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout
    assert "4 kept, 0 broken" in result.stdout


@pytest.mark.parametrize("module", ["velap", "velap.cli", "velap.api", "velap.tasks"])
def test_light_modules_load_no_heavy_package(module: str) -> None:
    heavy = "torch mujoco matplotlib sklearn scipy minari h5py"
    code = f"import sys, {module}; print([name for name in {heavy.split()!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_public_names() -> None:
    import velap

    assert callable(velap.make_dataset)
    assert callable(velap.train)
    assert callable(velap.load)
    assert callable(velap.evaluate)
    with pytest.raises(AttributeError, match="'velap' has no attribute 'tarin'"):
        velap.tarin  # noqa: B018
