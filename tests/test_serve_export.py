"""`velap export`: programs that do as the model does, without velap; one that does not is never kept."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import tiny_training  # noqa: F401 - registers the tiny encoder
from velap import api, cli
from velap.config import Config, override
from velap.errors import ConfigError, VelapError
from velap.models.checkpoint import load_checkpoint, make_model, save_checkpoint
from velap.models.velap import COMMAND_MEMORY, Spaces
from velap.serve.export import export

ROOT = Path(__file__).resolve().parents[1]
SIDE, STACK = 16, 3
LOW, HIGH = (-1.0, 0.0, 2.0), (1.0, 4.0, 2.5)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights of every policy there is, three frames a state, a memory of past commands."""
    model = {"encoder": "tiny", "frame_stack": STACK, "latent_dim": 5, "bank_size": 8, "command_dims": 3}
    config = override(Config(task="toy", preset="default"), model=model, train={"clone": {"steps": 1}})
    torch.manual_seed(0)
    network = make_model(config, Spaces(SIDE, SIDE, LOW, HIGH))
    path = tmp_path_factory.mktemp("run") / "model.safetensors"
    save_checkpoint(path, network, config, {"seed": "3"})
    return path


@pytest.fixture(scope="module")
def exported(checkpoint: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("export") / "programs"
    export(checkpoint, out)
    return out


def test_programs_are_the_model(checkpoint: Path, exported: Path) -> None:
    model, _, _ = load_checkpoint(checkpoint)
    programs = {name: torch.export.load(exported / f"{name}.pt2").module()
                for name in ("encode", "act_global", "act_local", "success_policy")}
    assert {path.name for path in exported.iterdir()} == {f"{name}.pt2" for name in programs} | {"export.json"}
    for batch in (1, 7):
        frames = torch.randint(0, 256, (batch, STACK, SIDE, SIDE, 3), dtype=torch.uint8)
        commands = 2 * torch.rand(batch, 3) - 1
        with torch.no_grad():
            latent = model.encode(frames, commands)
            torch.testing.assert_close(programs["encode"](frames, commands), latent, atol=1e-4, rtol=0)
            goal = latent.flip(0)
            torch.testing.assert_close(programs["act_local"](latent, goal), model.act_local(latent, goal))
            for name, policy in (("act_global", model.act_global), ("success_policy", model.success_policy)):
                assert policy is not None
                torch.testing.assert_close(programs[name](latent), policy(latent))


def test_the_description_says_what_a_robot_needs(checkpoint: Path, exported: Path) -> None:
    about = json.loads((exported / "export.json").read_text())
    assert (about["task"], about["frame_stack"], about["image_shape"]) == ("toy", STACK, [SIDE, SIDE, 3])
    assert (about["action_low"], about["action_high"], about["command_memory"]) == (list(LOW), list(HIGH), COMMAND_MEMORY)
    assert about["weights_sha256"] == load_checkpoint(checkpoint)[2]["weights_sha256"]
    assert all(program["max_difference"] <= 1e-4 for program in about["programs"].values())
    assert len(about["programs"]["act_local"]["inputs"]) == 2


def example() -> Any:
    spec = importlib.util.spec_from_file_location("run_exported", ROOT / "examples" / "run_exported.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_loader_acts_as_the_agent_does(checkpoint: Path, exported: Path) -> None:
    policy, agent = example().ExportedPolicy(exported), api.load(checkpoint, "td3bc", device="cpu")
    for episode in range(2):
        frames = np.random.default_rng(episode).integers(0, 256, (6, SIDE, SIDE, 3), np.uint8)
        agent.reset(np.ones(1, bool))
        policy.reset()
        for step, frame in enumerate(frames):
            stack = np.stack([frames[max(step - back, 0)] for back in (2, 1, 0)])
            np.testing.assert_allclose(policy.act(frame), agent.act(stack[None])[0], atol=1e-4)
    with pytest.raises(ValueError, match="expected uint8"):
        policy.act(frames[0] / 255)


def test_the_loader_does_without_velap(exported: Path) -> None:
    code = ("import runpy, sys; sys.argv = sys.argv[1:]; runpy.run_path(sys.argv[0], run_name='__main__'); "
            "assert not [name for name in sys.modules if name.startswith('velap')]")
    command = [sys.executable, "-c", code, str(ROOT / "examples" / "run_exported.py"), str(exported)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr


def test_a_program_that_differs_is_refused_and_nothing_is_left(checkpoint: Path, tmp_path: Path,
                                                               monkeypatch: pytest.MonkeyPatch) -> None:
    load = torch.export.load

    class Spoilt:
        """A program read back with one weight changed."""

        def __init__(self, path: Path) -> None:
            self._program = load(path)

        def module(self) -> torch.nn.Module:
            module = self._program.module()
            with torch.no_grad():
                weight = next(parameter for parameter in module.parameters() if parameter.dim() == 2)
                weight[0, 0] += 1.0
            return module

    monkeypatch.setattr(torch.export, "load", Spoilt)
    with pytest.raises(VelapError, match=r"exported encode differs from the model by 0.*expected at most 0.0001"):
        export(checkpoint, tmp_path / "programs")
    assert list(tmp_path.iterdir()) == []


def test_folders_of_others_are_left_alone(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "kept.txt").write_text("mine")
    with pytest.raises(ConfigError, match="not an empty folder"):
        export(checkpoint, tmp_path)
    assert cli.main(["export", str(checkpoint), "--out", str(tmp_path / "kept.txt")]) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["kept.txt"]
    assert "Name another with --out" in capsys.readouterr().err


def test_the_command_exports_a_released_checkpoint(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    released = ROOT / "checkpoints" / "ButtonWall.safetensors"
    assert cli.main(["export", str(released), "--out", str(tmp_path / "out" / "programs")]) == 0
    assert "from the model" in capsys.readouterr().out
    assert (tmp_path / "out" / "programs" / "encode.pt2").stat().st_size < 2 * 2**20, "the encoder's weights alone"
