"""Faults that users meet: each is to end in one paragraph with the way out, an exit code above 0 and nothing half-written.

A case copies an intact dataset and run, spoils something, gives one `velap` command and judges what comes back.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import h5py
import numpy as np
import torch

DATASET = "velap/SpiralMaze-v0"
TRAIN = ("train", "--dataset", DATASET, "--out", "new")
RESUME = ("train", "SpiralMaze", "--out", "run", "--resume")
EVALUATE = ("evaluate", "SpiralMaze", "--episodes", "1", "--checkpoint", "run/model.safetensors")

Answer = tuple[int, str]
"""Exit code and stderr of a command."""


class RunCommand(Protocol):
    """Runs `velap arguments`."""

    def __call__(self, arguments: Sequence[str], place: Path, datasets: str = "datasets",
                 limit: int | None = None) -> Answer:
        """In the folder `place`, with Minari's root `datasets` in it; no file may grow beyond `limit` [bytes]."""
        ...



@dataclass(frozen=True)
class Case:
    """One fault."""

    fault: str
    arguments: tuple[str, ...]
    says: str
    """Text that the message has to hold."""
    spoil: Callable[[Path], object] = lambda place: None
    """Brings the fault about in a folder that holds copies of `datasets` and `run`."""


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """What came of one case."""

    fault: str
    command: str
    message: str
    code: int
    problems: tuple[str, ...]


def data_of(place: Path) -> Path:
    """The dataset's files in a case's folder."""
    return place / "datasets" / DATASET / "data"


def cut(path: Path) -> None:
    """Truncate a file to its first half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path, share: float = 0.5) -> None:
    """Flip one bit, `share` of the way into a file."""
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 0x10
    path.write_bytes(content)


def as_stranger(place: Path, edit: Callable[[Any], object] = lambda file: None,
                change: Callable[[dict[str, Any]], object] = lambda metadata: None) -> None:
    """Edit the episodes (an `h5py.File`) and the metadata, and drop velap's checksums: now it is someone else's dataset."""
    with h5py.File(data_of(place) / "main_data.hdf5", "r+") as file:
        edit(file)
    path = data_of(place) / "metadata.json"
    metadata = json.loads(path.read_bytes())
    del metadata["velap"]
    change(metadata)
    path.write_text(json.dumps(metadata))


def damaged_stranger(damage: Callable[[Path], object]) -> Callable[[Path], object]:
    """Damage of a dataset without checksums of ours."""

    def spoil(place: Path) -> None:
        as_stranger(place)
        damage(data_of(place) / "main_data.hdf5")

    return spoil


def put(name: str, index: int, value: float) -> Callable[[Any], object]:
    """An edit that sets one entry of an array of the third episode."""

    def edit(file: Any) -> None:
        file[f"episode_2/{name}"][index] = value

    return edit


def replace(name: str, make: Callable[[np.ndarray], np.ndarray]) -> Callable[[Any], object]:
    """An edit that puts `make(array)` in the place of an array, in every episode."""

    def edit(file: Any) -> None:
        for group in file.values():
            array = group[name][...]
            del group[name]
            group[name] = make(array)

    return edit


def shorten(file: Any) -> None:
    """An edit that leaves two steps of every episode, the last one of the first episode rewarded."""
    for group in file.values():
        for name, count in (("observations", 3), ("actions", 2), ("rewards", 2), ("terminations", 2), ("truncations", 2)):
            group[name].resize(count, axis=0)
        group["truncations"][-1] = True
        group.attrs["total_steps"] = 2
    file["episode_0/rewards"][-1] = 1


def rewrite(path: Path, change: Callable[[dict[str, Any], dict[str, str]], object]) -> None:
    """Write a checkpoint again, with a right checksum, after `change(tensors, metadata)`."""
    from velap.runs import load_tensors, save_tensors

    tensors, metadata = load_tensors(path)
    change(tensors, metadata)
    save_tensors(path, tensors, metadata)


def _transpose_a_weight(tensors: dict[str, Any], metadata: dict[str, str]) -> None:
    name = next(name for name, tensor in sorted(tensors.items()) if tensor.dim() == 2 and tensor.shape[0] != tensor.shape[1])
    tensors[name] = tensors[name].T.contiguous()


def _unknown_field(tensors: dict[str, Any], metadata: dict[str, str]) -> None:
    config = json.loads(metadata["config"])
    config["train"]["momentum"] = 0.9
    metadata["config"] = json.dumps(config)


def _no_reward(file: Any) -> None:
    for group in file.values():
        group["rewards"][...] = 0


def _model(place: Path) -> Path:
    return place / "run" / "model.safetensors"


def _state(place: Path) -> Path:
    return place / "run" / "state.safetensors"


def _unfinished(spoil: Callable[[Path], object]) -> Callable[[Path], object]:
    def both(place: Path) -> None:
        _model(place).unlink()
        spoil(_state(place))

    return both


CASES: tuple[Case, ...] = (
    Case("dataset missing", ("train", "--dataset", "robot/pile-v0"), "no Minari dataset 'robot/pile-v0'"),
    Case("dataset truncated", TRAIN, "is damaged", lambda place: cut(data_of(place) / "main_data.hdf5")),
    Case("dataset bit-flipped", TRAIN, "is damaged", lambda place: flip(data_of(place) / "main_data.hdf5")),
    Case("dataset's metadata truncated", TRAIN, "is damaged", lambda place: cut(data_of(place) / "metadata.json")),
    Case("stranger's dataset truncated", TRAIN, "is damaged", damaged_stranger(cut)),
    Case("stranger's dataset bit-flipped", TRAIN, "is damaged", damaged_stranger(flip)),
    Case("one image too few", TRAIN, "one more than",
         lambda place: as_stranger(place, replace("observations", lambda images: images[:-1]))),
    Case("actions of another shape", TRAIN, "the actions have shape",
         lambda place: as_stranger(place, replace("actions", lambda actions: actions[:, :1]))),
    Case("an action is NaN", TRAIN, "expected finite numbers", lambda place: as_stranger(place, put("actions", 1, np.nan))),
    Case("an action is infinite", TRAIN, "expected finite numbers",
         lambda place: as_stranger(place, put("actions", 1, np.inf))),
    Case("a reward is NaN", TRAIN, "expected finite numbers", lambda place: as_stranger(place, put("rewards", 1, np.nan))),
    Case("float images that do not fill their bounds", TRAIN, "expected values up to 255",
         lambda place: as_stranger(place, replace("observations", lambda images: images.astype(np.float32) / 255),
                                   lambda m: m.update(observation_space=m["observation_space"].replace("uint", "float")
                                                      .replace("float8", "float32")))),
    Case("no reward", TRAIN, "every reward of velap/SpiralMaze-v0 is 0", lambda place: as_stranger(place, _no_reward)),
    Case("episodes shorter than k", TRAIN, "longest episode",
         lambda place: as_stranger(place, shorten, lambda m: m.update(total_steps=2 * m["total_episodes"]))),
    Case("checkpoint missing", EVALUATE, "no checkpoint at", lambda place: _model(place).unlink()),
    Case("checkpoint truncated", EVALUATE, "damaged or truncated", lambda place: cut(_model(place))),
    Case("checkpoint bit-flipped", EVALUATE, "does not match the SHA-256", lambda place: flip(_model(place))),
    Case("checkpoint's header bit-flipped", EVALUATE, "run/model.safetensors", lambda place: flip(_model(place), 1e-4)),
    Case("checkpoint is no safetensors file", EVALUATE, "not a readable safetensors file",
         lambda place: _model(place).write_bytes(b"weights")),
    Case("checkpoint is a training state", EVALUATE, "not its training state",
         lambda place: shutil.copy(_state(place), _model(place))),
    Case("checkpoint with weights of another shape", EVALUATE, "does not fit its own config",
         lambda place: rewrite(_model(place), _transpose_a_weight)),
    Case("checkpoint with an unknown config field", EVALUATE, "unknown fields ['momentum']",
         lambda place: rewrite(_model(place), _unknown_field)),
    Case("checkpoint of someone else", EVALUATE, "carries no checksum", lambda place: _foreign(_model(place))),
    Case("training state truncated", RESUME, "damaged or truncated", _unfinished(cut)),
    Case("training state bit-flipped", RESUME, "does not match the SHA-256", _unfinished(flip)),
    Case("training state of another seed", (*RESUME, "--seed", "7"), "another seed", _unfinished(lambda path: None)),
    Case("run directory in use", ("train", "SpiralMaze", "--out", "run"), "--resume"),
    Case("dataset exists already", ("collect", "SpiralMaze"), "--overwrite"),
    Case("unknown task", ("train", "Nowhere"), "expected one of SpiralMaze"),
    Case("unknown task to collect", ("collect", "Nowhere"), "expected one of SpiralMaze"),
    Case("unknown task to evaluate", ("evaluate", "Nowhere", "--method", "random"), "expected one of SpiralMaze"),
    Case("unknown method", (*EVALUATE, "--method", "ppo"), "ppo"),
    Case("unknown preset", ("train", "SpiralMaze", "--preset", "best"), "best"),
    Case("unknown option", ("train", "SpiralMaze", "--sede", "1"), "--sede"),
    Case("unknown command", ("fly",), "fly"),
    Case("unknown config field", (*TRAIN, "--set", "train.nothing=3"), "no field 'nothing'"),
    Case("config field out of range", (*TRAIN, "--set", "train.joint.window=0"), "expected 1 or more"),
    Case("config field of another type", (*TRAIN, "--set", "train.joint.window=x"), "expected int"),
    Case("unknown environment", ("evaluate", "x", "--method", "random", "--env", "NoSuch-v0"), "Gymnasium cannot make"),
)


def _foreign(path: Path) -> None:
    from safetensors.torch import save_file

    save_file({"weight": torch.zeros(3)}, str(path))


def listing(folder: Path) -> dict[str, str]:
    """Every path below `folder` with the SHA-256 of its content."""
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else "folder"
            for path in sorted(folder.rglob("*"))}


def message_of(stderr: str) -> str:
    """Stderr in one line, without notes and without the frame that usage errors are drawn in."""
    lines = [line for line in stderr.splitlines() if not line.startswith("note: ")]
    return " ".join(re.sub(r"[─│╭╮╰╯]+|-{4,}", " ", " ".join(lines)).split())


def check(case: Case, base: Path, place: Path, run: RunCommand) -> CaseResult:
    """Copy `base` (with `datasets` and `run`) to `place`, spoil it, run the command and judge."""
    shutil.copytree(base, place)
    case.spoil(place)
    before = listing(place)
    code, stderr = run(case.arguments, place)
    after = listing(place)
    shutil.rmtree(place)
    return CaseResult(
        fault=case.fault,
        command=shown(case.arguments),
        message=message_of(stderr).replace(str(place), "FOLDER"),
        code=code,
        problems=(*judge(code, stderr, case.says), *changes(before, after)))


def shown(arguments: Sequence[str]) -> str:
    """The command as it is typed."""
    return " ".join(["velap", *arguments])


def judge(code: int, stderr: str, says: str) -> list[str]:
    """What is wrong with the answer of a command that had to fail."""
    problems = []
    if not 0 < code < 126:
        problems.append(f"exit code {code}")
    if "Traceback" in stderr:
        problems.append("a traceback")
    lines = [line for line in stderr.splitlines() if line.strip() and not line.startswith("note: ")]
    usage = "For full helptext, run velap" in stderr
    if not usage and not (len(lines) == 1 and lines[0].startswith("velap: ")):
        problems.append(f"{len(lines)} lines instead of one paragraph")
    if says not in message_of(stderr):
        problems.append(f"the message lacks “{says}”")
    return problems


def changes(before: dict[str, str], after: dict[str, str]) -> list[str]:
    """Paths that a command that had to fail made, changed or deleted."""
    return [f"{path} was {'made' if path not in before else 'deleted' if path not in after else 'changed'}"
            for path in sorted(before.keys() | after.keys()) if before.get(path) != after.get(path)]
