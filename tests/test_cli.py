"""The command line: exit codes, one-paragraph errors, resuming, foreign environments, the README's quickstart end to end."""

from __future__ import annotations

import dataclasses
import inspect
import os
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch

import velap
from velap import cli
from velap.cli.settings import parse_settings
from velap.config import describe, override
from velap.data.frames import Reading
from velap.errors import ConfigError, RecordError
from velap.evaluation.records import read_records
from velap.methods.base import get_method
from velap.models.checkpoint import load_checkpoint, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.tasks import TASKS, make_config
from velap.training.loggers import DEFAULT

ROOT = Path(__file__).resolve().parents[1]
OLD_RECORDS = ROOT / "results/records-five-recipes"
RANDOM = ["evaluate", "SpiralMaze", "--method", "random", "--max-steps", "4"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Results, runs and datasets of these tests go into a temporary folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "datasets"))


def untrained(path: Path, task: str = "SpiralMaze", side: int = 64, bound: float = 1.0) -> Path:
    """A checkpoint with random weights and a planner that is quick."""
    config = override(make_config(task), planner={"n_iter": 4, "candidates": 2}, model={"bank_size": 16, "frame_stack": 1})
    torch.manual_seed(0)
    model = LatentModel(config.model, Spaces(side, side, (-bound,) * 2, (bound,) * 2), config.train.discount)
    save_checkpoint(path, model, config, {"seed": "3"})
    return path


@pytest.mark.parametrize(("arguments", "text"), [
    (["train", "Nowhere"], "unknown task 'Nowhere'; expected one of SpiralMaze"),
    (["collect", "Nowhere"], "unknown task 'Nowhere'"),
    (["run", "Nowhere"], "unknown task 'Nowhere'"),
    (["demo", "Nowhere"], "unknown task 'Nowhere'"),
    (["evaluate", "Nowhere"], "unknown task 'Nowhere'"),
    (["evaluate", "SpiralMaze"], "name one with --checkpoint"),
    (["evaluate", "SpiralMaze", "--checkpoint", "gone.safetensors"], "no checkpoint at gone.safetensors"),
    (["evaluate", "x", "--method", "random", "--env", "NoSuch-v0"], "Gymnasium cannot make 'NoSuch-v0'"),
    (["evaluate", "x", "--method", "random", "--env", "no_module:NoSuch-v0"], "no_module"),
    (["evaluate", "x", "--method", "random", "--env", "CartPole-v1"], "Discrete(2)"),
    (["evaluate", "SpiralMaze", "--method", "random", "--episodes", "0"], "got 0 episodes"),
    (["train"], "`velap train TASK`"),
    (["train", "SpiralMaze", "--dataset", "robot/pile-v0"], "expected one of them"),
    (["train", "--dataset", "robot/pile-v0"], "no Minari dataset 'robot/pile-v0'"),
    (["train", "SpiralMaze", "--set", "n_iter=3"], "expected PART.FIELD=VALUE"),
    (["train", "SpiralMaze", "--set", "train.nothing=3"], "no field 'nothing'"),
    (["train", "SpiralMaze", "--set", "train.joint.window=x"], "`train.joint.window` is 'x'; expected int"),
    (["evaluate", "SpiralMaze", "--method", "ppo"], "unknown method 'ppo'; expected one of bc, "),
    (["table"], "no records below"),
    (["table", "--records", "x", "--write", "README.md"], "no records below"),
])
def test_errors_are_one_paragraph_and_exit_2(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(arguments) == 2
    message = capsys.readouterr().err
    assert text in message
    assert message.startswith("velap: ")
    assert message.count("\n") == 1, "one paragraph"
    assert "Traceback" not in message
    assert list(Path().rglob("*.jsonl")) == []


@pytest.mark.parametrize("arguments", [
    ["train", "SpiralMaze", "--sede", "1"], ["train", "SpiralMaze", "--preset", "best"],
    ["evaluate", "SpiralMaze", "--episodes", "many"], ["evaluate"],
])
def test_wrong_options_exit_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as exit_:
        cli.main(arguments)
    assert exit_.value.code == 2
    assert capsys.readouterr().err.strip()


def test_ctrl_c_exits_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "info", interrupted)
    assert cli.main(["info"]) == 130
    assert "goes on from here" in capsys.readouterr().err


def test_settings_take_the_type_of_their_field() -> None:
    settings = ["planner.n_iter=500", "train.joint.c1=1", "planner.anchor=snap", "planner.discard_low_exponent=null"]
    changes = parse_settings([settings])
    assert changes == {"planner": {"n_iter": 500, "anchor": "snap", "discard_low_exponent": None},
                       "train": {"joint": {"c1": 1}}}
    assert override(make_config("SpiralMaze"), **changes).train.phases[0].c1 == 1.0
    assert override(make_config("SpiralMaze"), **parse_settings([["planner.anchor=none"]])).planner.anchor == "none"
    own = {"velap": get_method("velap").settings}
    assert parse_settings([["velap.planner=mine"]], own) == {"velap": {"planner": "mine"}}
    with pytest.raises(ConfigError, match=r"velap\.planner` is 3; expected str"):
        parse_settings([["velap.planner=3"]], own)
    for wrong in ("planner.n_iter", "planner=3", "train.joint.steps.more=3", "planner.deep.n_iter=3", "plans.n_iter=3"):
        with pytest.raises(ConfigError, match=r"expected PART\.FIELD=VALUE"):
            parse_settings([[wrong]])


def test_the_config_command_prints_every_field(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["config", "SpiralMaze"]) == 0
    said = capsys.readouterr().out
    for name, *_ in describe(make_config("SpiralMaze")):
        assert name in said
    assert "planner.discard_low_exponent = 20.0  (float or null)" in said and "train.clone.steps = -  (int)" in said


def test_every_set_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """argparse keeps the values of the last one alone unless it is told to append."""
    seen: list[Any] = []

    def taken(settings: cli.Settings = ()) -> None:
        seen.append(parse_settings(settings))

    monkeypatch.setitem(cli.COMMANDS, "info", taken)
    assert cli.main(["info", "--set", "train.c0=1", "train.c3=2", "--set", "planner.n_sim=3"]) == 0
    assert cli.main(["info"]) == 0
    assert seen == [{"train": {"c0": 1, "c3": 2}, "planner": {"n_sim": 3}}, {}]


def test_train_has_every_option_of_python(monkeypatch: pytest.MonkeyPatch) -> None:
    """Options are taken from the command line and reach `velap.train` as they were given."""
    seen: dict[str, Any] = {}

    def trained(source: str, **options: Any) -> Path:
        seen.update(options, source=source)
        return Path("model.safetensors")

    offered = set(inspect.signature(velap.train).parameters)
    monkeypatch.setattr("velap.api.train", trained)
    typed = ["--dataset", "robot/pile-v0", "--image-key", "front", "--image-key", "wrist", "--preset", "paper",
             "--seed", "7", "--out", "elsewhere",
             "--device", "cpu", "--resume", "--set", "train.c0=2", "--method", "td3bc", "--success", "terminated",
             "--fit", "pad", "--image-size", "96", "--mapped", "--state-key", "joints"]
    given = {"source": "robot/pile-v0", "image_key": "front,wrist", "preset": "paper", "seed": 7, "out": Path("elsewhere"),
             "device": "cpu", "resume": True, "changes": {"train": {"c0": 2}}, "method": "td3bc", "success": "terminated",
             "fit": "pad", "image_size": 96, "mapped": True, "state_key": "joints"}
    for loggers in ((), ("jsonl",), ("tensorboard", "wandb")):
        assert cli.main(["train", *typed, "--loggers", *loggers]) == 0
        own = {"command": seen.pop("command"), "on_progress": seen.pop("on_progress")}
        assert seen == {**given, "loggers": loggers}
        assert offered - {"data"} == set(seen) | set(own), "an option of Python that the command line lacks"
    assert cli.main(["train", "SpiralMaze"]) == 0
    assert seen["loggers"] == DEFAULT


def test_an_evaluation_goes_on_where_it_stopped(capsys: pytest.CaptureFixture[str]) -> None:
    path = Path("runs/records/SpiralMaze/random-default/train0.jsonl")
    assert cli.main([*RANDOM, "--episodes", "2"]) == 0
    first = path.read_bytes()
    assert cli.main([*RANDOM, "--episodes", "3", "--batch", "1"]) == 0
    assert path.read_bytes().startswith(first)
    records = read_records(path)
    assert [(record.episode_seed, record.steps, record.truncated) for record in records] == [(s, 4, True) for s in range(3)]
    assert "0.0 (0.0 to 56.1)" in capsys.readouterr().out
    path.write_bytes(first[:-5])
    assert cli.main([*RANDOM, "--episodes", "3"]) == 0
    assert {record.episode_seed for record in read_records(path)} == {0, 1, 2}


def test_a_table_is_written_into_a_document(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*RANDOM, "--episodes", "1"]) == 0
    Path("records.md").write_text((ROOT / "docs/records.md").read_text())
    assert cli.main(["table", "--write", "records.md"]) == 0
    row = "| SpiralMaze | random | default | 0 | 1 | 0.0 (0.0 to 79.3) | - / 4.0 | - / - |"
    assert row in " ".join(Path("records.md").read_text().split())
    assert cli.main(["table"]) == 0
    assert "SpiralMaze" in capsys.readouterr().out


def test_records_name_the_checkpoint_and_refuse_another(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", "SpiralMaze", "--episodes", "1", "--max-steps", "3", "--checkpoint"]
    checkpoint = untrained(tmp_path / "a.safetensors")
    assert cli.main([*command, str(checkpoint)]) == 0
    path = Path("runs/records/SpiralMaze/velap-default/train3.jsonl")
    (record,) = read_records(path)
    assert re.fullmatch("[0-9a-f]{64}", record.checkpoint)
    assert re.fullmatch("[0-9a-f]{12}", record.config_hash)
    assert record.code_version.startswith(velap.__version__)
    assert len(record.plan_ms) == 1
    assert cli.main([*command, str(checkpoint), "--set", "planner.n_iter=5"]) == 2
    assert "`config_hash` is" in capsys.readouterr().err
    assert cli.main([*command, str(checkpoint), "--set", "planner.n_iter=5", "--fresh"]) == 0
    assert read_records(path)[0].config_hash != record.config_hash


def test_a_checkpoint_that_does_not_fit_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign = untrained(tmp_path / "foreign.safetensors", task="robot")
    assert cli.main(["evaluate", "SpiralMaze", "--checkpoint", str(foreign)]) == 2
    assert "trained on 'robot', not on 'SpiralMaze'" in capsys.readouterr().err
    wide = untrained(tmp_path / "wide.safetensors", bound=3.0)
    assert cli.main(["evaluate", "SpiralMaze", "--checkpoint", str(wide)]) == 2
    assert "the model acts in [-3.0, -3.0]" in capsys.readouterr().err


@pytest.mark.parametrize("damage", ["cut", "flip"])
def test_a_damaged_checkpoint_is_refused(tmp_path: Path, damage: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = untrained(tmp_path / "model.safetensors")
    content = bytearray(path.read_bytes())
    if damage == "cut":
        del content[-1000:]
    else:
        content[-1000] ^= 1
    path.write_bytes(content)
    assert cli.main(["evaluate", "SpiralMaze", "--checkpoint", str(path)]) == 2
    assert "damaged" in capsys.readouterr().err
    assert list(Path().rglob("*.jsonl")) == []


def test_any_gymnasium_environment_and_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    checkpoint = untrained(tmp_path / "toy.safetensors", task="toys")
    command = ["evaluate", "toys", "--env", "toy_env:Toy-v0", "--checkpoint", str(checkpoint), "--episodes", "1"]
    assert cli.main([*command, "--method", "td3bc", "--max-steps", "3", "--video"]) == 0
    (path,) = Path("runs/records").rglob("*.jsonl")
    assert path.parts[2] == "toy_env_Toy-v0"
    assert read_records(path)[0].env == "toy_env:Toy-v0"
    assert Path("runs/videos/toy_env_Toy-v0/td3bc-default/train3/episode0.mp4").stat().st_size > 1000


MINE = """
import gymnasium as gym, numpy as np

class Mine(gym.Env):
    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, render_mode=None, obs_type="state", win=0.0):
        self.render_mode, self.win = render_mode, win
        picture, state = gym.spaces.Box(0, 255, (64, 64, 3), np.uint8), gym.spaces.Box(-1, 1, (2,))
        self.observation_space = gym.spaces.Dict(front=picture, wrist=picture) if obs_type == "pixels" else state

    def observe(self):
        return {"front": self.picture(), "wrist": 255 - self.picture()}

    def picture(self):
        return np.full((64, 64, 3), 10 * self.t, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self.observe(), {}

    def step(self, action):
        self.t += 1
        return self.observe(), self.win if self.t == 5 else self.win - 1, self.t == 5, False, {}

    def render(self):
        return self.picture() if self.render_mode == "rgb_array" else None

gym.register("Mine-v0", "own_robot:Mine", max_episode_steps=20)
"""
"""A stranger's environment: pixels for an argument only, two cameras, a picture in its render mode only, -1 a step, 0 at the
goal."""


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    (tmp_path / "own_robot.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    return ["evaluate", "mine", "--env", "own_robot:Mine-v0", "--method", "random", "--episodes", "1"]


def test_an_environment_gets_its_arguments(mine: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*mine, "--env-kwargs", "colour=red"]) == 2
    assert "give them with --env-kwargs NAME=VALUE" in capsys.readouterr().err
    assert cli.main([*mine, "--env-kwargs", "obs_type"]) == 2
    assert "--env-kwargs got 'obs_type'; expected NAME=VALUE" in capsys.readouterr().err
    assert cli.main(mine) == 2
    assert "with the argument that gives pixels, such as --env-kwargs" in capsys.readouterr().err
    mine += ["--env-kwargs", "obs_type=pixels", "win=1.0", "--image-key", "front"]
    assert cli.main(mine) == 0
    (path,) = Path("runs/records").rglob("*.jsonl")
    (record,) = read_records(path)
    assert (record.success, record.steps, record.max_steps) == (True, 5, 20)
    assert (record.env_kwargs, record.image_key) == ({"obs_type": "pixels", "win": 1.0}, "front")
    assert (record.batch, record.device, record.schema) == (1, "cpu", 2)
    for changed in (["--image-key", "wrist"], ["--max-steps", "5"], ["--success", "reward>=0.5"]):
        assert cli.main([*mine, *changed]) == 2
        assert "holds records of another run" in capsys.readouterr().err
    assert cli.main([*mine, "--image-key", "side"]) == 2
    assert "side" in capsys.readouterr().err
    assert read_records(path) == [record]


def test_the_camera_is_the_one_that_the_checkpoint_learnt_from(mine: list[str], tmp_path: Path,
                                                               capsys: pytest.CaptureFixture[str]) -> None:
    reading = {"reading": Reading("wrist").to_json(), "seed": "3"}
    model, config, _ = load_checkpoint(untrained(tmp_path / "any.safetensors", task="mine"))
    save_checkpoint(tmp_path / "wrist.safetensors", model, config, reading)
    mine += ["--env-kwargs", "obs_type=pixels", "win=1.0", "--method", "td3bc"]
    assert cli.main([*mine, "--checkpoint", str(tmp_path / "wrist.safetensors")]) == 0
    (path,) = Path("runs/records").rglob("*.jsonl")
    assert [record.image_key for record in read_records(path)] == ["wrist"]
    assert cli.main([*mine, "--checkpoint", str(tmp_path / "any.safetensors"), "--fresh"]) == 2
    assert "several images among its observations: front, wrist" in capsys.readouterr().err


def test_a_camera_of_plain_observations_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    plain = ["evaluate", "toys", "--env", "toy_env:Toy-v0", "--method", "random", "--episodes", "1"]
    assert cli.main([*plain, "--image-key", "wrist"]) == 2
    assert "plain observations and no key 'wrist'" in capsys.readouterr().err


def test_an_environment_that_draws_nothing_is_filmed_as_the_agent_sees_it(mine: list[str]) -> None:
    mine += ["--env-kwargs", "obs_type=pixels", "win=1.0", "render_mode=null", "--image-key", "front", "--video"]
    assert cli.main(mine) == 0
    (video,) = Path("runs/videos").rglob("*.mp4")
    frames = [frame.mean() for frame in imageio.get_reader(video)]
    assert frames[0] < frames[4], "the picture brightens from step to step"


def test_python_can_what_the_command_line_can(mine: list[str], tmp_path: Path) -> None:
    checkpoint = untrained(tmp_path / "mine.safetensors", task="mine")
    options: dict[str, Any] = {"env": "own_robot:Mine-v0", "env_kwargs": {"obs_type": "pixels"}, "image_key": "front",
                               "max_steps": 3, "success": "reward>=0", "episodes": 1, "batch": 1, "records": "both"}
    velap.evaluate("mine", str(checkpoint), changes={"controller": {"n_replan": 2}}, **options)
    (path,) = Path("both").rglob("*.jsonl")
    written = path.read_bytes()
    command = ["evaluate", "mine", "--env", "own_robot:Mine-v0", "--checkpoint", str(checkpoint), "--env-kwargs",
               "obs_type=pixels", "--image-key", "front", "--max-steps", "3", "--success", "reward>=0", "--episodes", "1",
               "--batch", "1", "--records", "both"]
    assert cli.main([*command, "--set", "controller.n_replan=2"]) == 0
    assert path.read_bytes() == written, "the command finds the records of the same run"
    assert cli.main([*command, "--set", "controller.n_replan=3"]) == 2
    with pytest.raises(RecordError, match="config_hash"):
        velap.evaluate("mine", checkpoint, changes={"controller": {"n_replan": 3}}, **options)


def test_agents_are_loaded_with_other_fields(tmp_path: Path) -> None:
    checkpoint = untrained(tmp_path / "any.safetensors")
    frames = np.zeros((1, 1, 64, 64, 3), np.uint8)
    few, many = ({"mppi": {"samples": samples, "elites": 1, "horizon": 5}} for samples in (2, 9))
    assert (velap.load(checkpoint, "mppi", changes=few, device="cpu").act(frames)
            != velap.load(checkpoint, "mppi", changes=many, device="cpu").act(frames)).any()
    with pytest.raises(ConfigError, match="n_iterations"):
        velap.load(checkpoint, changes={"planner": {"n_iterations": 3}}, device="cpu")
    assert velap.load(checkpoint, "random", device="cpu").act(frames).shape == (1, 2), "it takes the bounds of its actions"


def test_where_every_step_costs_success_has_to_be_said(mine: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    mine += ["--env-kwargs", "obs_type=pixels", "--image-key", "front"]
    assert cli.main(mine) == 2
    assert "--success 'reward>=0'" in capsys.readouterr().err
    assert cli.main([*mine, "--success", "reward>=0", "--video"]) == 0
    (path,) = Path("runs/records").rglob("*.jsonl")
    assert [(record.success, record.steps) for record in read_records(path)] == [(True, 5)]
    (video,) = Path("runs/videos").rglob("*.mp4")
    assert video.stat().st_size > 1000, "made in the render mode that draws"


def test_own_records_never_meet_the_shipped_ones(tmp_path: Path) -> None:
    shipped = Path("results/records/SpiralMaze/velap-default/train3.jsonl")
    shipped.parent.mkdir(parents=True)
    shipped.write_bytes((OLD_RECORDS / "SpiralMaze/velap-default/train0.jsonl").read_bytes())
    before = shipped.read_bytes()
    assert cli.main(["evaluate", "SpiralMaze", "--episodes", "1", "--max-steps", "3", "--checkpoint",
                     str(untrained(tmp_path / "a.safetensors"))]) == 0
    assert shipped.read_bytes() == before
    assert len(read_records(Path("runs/records/SpiralMaze/velap-default/train3.jsonl"))) == 1


@pytest.mark.parametrize("command", [["--help"], ["--version"], ["train", "--help"]])
def test_help_and_version_answer_at_once(command: list[str]) -> None:
    """Processor time, so that what else the machine does not count; torch alone takes more than a second."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, "-m", "velap", *command], capture_output=True, text=True,
                          env={**os.environ, "PYTHONPATH": path})
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0 and ("velap" in done.stdout), done.stderr
    assert after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime < 1.0


@pytest.mark.parametrize("command", [["evaluate", "--help"], ["config", "SpiralMaze"]])
@pytest.mark.parametrize("code_page", ["cp1252", "ascii"])
def test_a_log_file_of_any_code_page_takes_the_output(command: list[str], code_page: str) -> None:
    """Windows gives a file its own code page, which lacks π."""
    path = os.pathsep.join(entry for entry in sys.path if entry)
    done = subprocess.run([sys.executable, "-m", "velap", *command], capture_output=True,
                          env={**os.environ, "PYTHONPATH": path, "PYTHONIOENCODING": code_page})
    assert done.returncode == 0, done.stderr.decode()
    assert len(done.stdout) > 1000


def test_version_and_the_list_of_commands(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"velap {velap.__version__}\n"
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    assert {"demo", "collect", "train", "evaluate", "run", "table", "bench", "diagnose", "study", "figure", "info"} <= set(
        cli.COMMANDS)
    for name in cli.COMMANDS:
        assert re.search(rf"^  {name} +[A-Z`]\S* ", text, re.MULTILINE), name
    assert cli.main([]) == 2
    assert cli.main(["fly"]) == 2
    assert "unknown command 'fly'; expected one of demo, collect" in capsys.readouterr().err


@pytest.mark.parametrize("command", [
    ["train", "--set", "train.c1=1", "Nowhere"], ["train", "--set", "train.c1=1", "train.c3=2", "Nowhere", "--seed", "1"],
    ["evaluate", "--env-kwargs", "a=1", "Nowhere", "--method", "random"]])
def test_options_of_several_values_do_not_swallow_the_task(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(command) == 2
    assert "unknown task 'Nowhere'" in capsys.readouterr().err


def test_a_setting_without_a_value_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["train", "--set", "SpiralMaze"]) == 2
    assert "--set got 'SpiralMaze'; expected NAME=VALUE" in capsys.readouterr().err


def test_the_table_of_all_records_has_whole_names_in_a_log_file(monkeypatch: pytest.MonkeyPatch,
                                                                capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    assert cli.main(["table", "--records", str(OLD_RECORDS)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("ButtonWall" in line and "bc-success" in line and "95 % interval" not in line for line in lines)
    assert len({line.count("|") for line in lines}) == 1, "one line a run"


@pytest.mark.parametrize(("command", "text"), [
    (["evaluate", "SpiralMaze", "--method", "random", "--first-seed", "-1", "--episodes", "1"], "first episode seed -1"),
    (["table", "--records", str(OLD_RECORDS), "--write", "new.md"], "new.md has no place for the table"),
    (["table", "--records", str(OLD_RECORDS), "--write", "."], "has no place for the table"),
    (["table"], "no records below runs/records"),
    (["evaluate", "SpiralMaze", "--method", "random", "--episodes", "0"], "got 0 episodes"),
    (["evaluate", "SpiralMaze", "--method", "random", "--episodes", "1", "--max-steps", "0"], "Give one with --max-steps"),
    (["demo", "SpiralMaze", "--checkpoint", "nothing"], "no checkpoint at nothing"),
    (["train", "--dataset", "a" * 260 + "-v0"], "velap: "),
    (["bench", "--only", "nothing", "plan_latency_1"], "unknown benchmark nothing"),
])
def test_wrong_input_is_one_paragraph(command: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(command) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.startswith("velap: ") and error.count("\n") == 1


def test_a_run_does_not_train_where_its_records_would_be_refused(capsys: pytest.CaptureFixture[str]) -> None:
    path = Path("runs/records/SpiralMaze/velap-default/train0.jsonl")
    path.parent.mkdir(parents=True)
    path.write_bytes((OLD_RECORDS / "SpiralMaze/velap-default/train0.jsonl").read_bytes())
    assert cli.main(["run", "SpiralMaze", "--set", "planner.n_iter=7"]) == 2
    assert "holds records of another config" in capsys.readouterr().err
    assert not Path("runs/SpiralMaze").exists() and not Path("datasets").exists()


def test_info_names_tasks_and_versions(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["info"]) == 0
    text = capsys.readouterr().out
    assert "task SpiralMaze: environment velap/SpiralMaze-v0 (draws)" in text
    assert f"torch {torch.__version__}" in text


@pytest.fixture
def small_spiral(monkeypatch: pytest.MonkeyPatch) -> None:
    """SpiralMaze with little data, little training and a planner that is quick."""
    task = TASKS["SpiralMaze"]
    small: dict[str, dict[str, Any]] = {
        "train": {"joint": {"steps": 4, "windows": 4}, "latent": {"steps": 4}, "log_every": 2},
        "planner": {"n_iter": 10, "candidates": 5}, "model": {"bank_size": 32}}
    recipe = dataclasses.replace(task.recipe, trajectories=120)
    monkeypatch.setitem(TASKS, "SpiralMaze", dataclasses.replace(task, recipe=recipe, overrides=small))


@pytest.mark.usefixtures("small_spiral")
def test_the_readme_quickstart_and_the_command_line_agree(capsys: pytest.CaptureFixture[str]) -> None:
    (quickstart,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    frame_stack = make_config("SpiralMaze").model.frame_stack
    names: dict[str, Any] = {"frames": np.zeros((2, frame_stack, 64, 64, 3), np.uint8)}
    exec(quickstart.replace("episodes=100", "episodes=1"), names)
    assert names["actions"].shape == (2, 2)
    assert names["checkpoint"] == Path("runs/SpiralMaze/default/seed0/model.safetensors")
    assert "Summary(task='SpiralMaze', method='velap', preset='default', train_seed=0, episodes=1" in capsys.readouterr().out

    assert velap.make_dataset("SpiralMaze", seed=0) == names["dataset"], "there already"
    records = Path("runs/records/SpiralMaze/velap-default/train0.jsonl")
    before = read_records(records)
    assert cli.main(["run", "SpiralMaze", "--episodes", "1"]) == 0
    assert read_records(records) == before, "the run is finished: nothing is left to do"
    assert cli.main(["train", "SpiralMaze"]) == 2
    assert "--resume" in capsys.readouterr().err


def test_a_device_that_velap_does_not_run_on_is_named(tmp_path: Path) -> None:
    for device in ("mps", "quantum"):
        with pytest.raises(ConfigError, match="expected auto, cpu or cuda"):
            velap.load(untrained(tmp_path / "a.safetensors"), device=device)
