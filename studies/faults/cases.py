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
from safetensors.torch import save_file

from velap.runs import load_tensors, save_tensors

DATASET = "velap/SpiralMaze-v0"
MODEL, STATE = "run/model.safetensors", "run/state.safetensors"
EPISODES, METADATA = (f"datasets/{DATASET}/data/{name}" for name in ("main_data.hdf5", "metadata.json"))
TRAIN = ("train", "--dataset", DATASET, "--out", "new")
RESUME = ("train", "SpiralMaze", "--out", "run", "--resume")
EVALUATE = ("evaluate", "SpiralMaze", "--episodes", "1", "--checkpoint", MODEL)

Answer = tuple[int, str]
"""Exit code and stderr of a command."""
Damage = Callable[[Path], object]
"""Changes a file, or a folder that holds copies of `datasets` and `run`."""


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
    spoil: Damage = lambda place: None
    """Brings the fault about in the case's folder."""


@dataclass(frozen=True, kw_only=True)
class CaseResult:
    """What came of one case."""

    fault: str
    command: str
    message: str
    code: int
    problems: tuple[str, ...]


def cut(path: Path) -> None:
    """Truncate a file to its first half."""
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path: Path, share: float = 0.5) -> None:
    """Flip one bit, `share` of the way into a file."""
    content = bytearray(path.read_bytes())
    content[int(share * len(content))] ^= 0x10
    path.write_bytes(content)


def at(name: str, damage: Damage) -> Damage:
    """Damage of the file `name` of the folder."""
    return lambda place: damage(place / name)


def strangers(edit: Callable[[h5py.File, dict[str, Any]], object] = lambda file, metadata: None,
              damage: Damage = lambda path: None) -> Damage:
    """Edit episodes and metadata, drop velap's checksums, as in someone else's dataset, and damage the episodes' file."""

    def spoil(place: Path) -> None:
        metadata = json.loads((place / METADATA).read_bytes())
        del metadata["velap"]
        with h5py.File(place / EPISODES, "r+") as file:
            edit(file, metadata)
        (place / METADATA).write_text(json.dumps(metadata))
        damage(place / EPISODES)

    return spoil


def in_third_episode(name: str, value: float) -> Damage:
    """A stranger's dataset with `value` in one step of the third episode's array `name`."""
    return strangers(lambda file, metadata: file[f"episode_2/{name}"].__setitem__(1, value))


def in_every_episode(name: str, make: Callable[[np.ndarray], np.ndarray], **changes: tuple[str, str]) -> Damage:
    """A stranger's dataset with `make(array)` in place of every array `name`; `changes` replace text of the metadata."""

    def edit(file: h5py.File, metadata: dict[str, Any]) -> None:
        for group in file.values():
            array = group[name][...]
            del group[name]
            group[name] = make(array)
        for field, (old, new) in changes.items():
            metadata[field] = metadata[field].replace(old, new)

    return strangers(edit)


def _two_steps_each(file: h5py.File, metadata: dict[str, Any]) -> None:
    """Leave two steps of every episode, the last one of the first episode rewarded."""
    for group in file.values():
        for name, count in (("observations", 3), ("actions", 2), ("rewards", 2), ("terminations", 2), ("truncations", 2)):
            group[name].resize(count, axis=0)
        group["truncations"][-1] = True
        group.attrs["total_steps"] = 2
    file["episode_0/rewards"][-1] = 1
    metadata["total_steps"] = 2 * metadata["total_episodes"]


def checkpoint(change: Callable[[dict[str, Any], dict[str, str]], object]) -> Damage:
    """Write the checkpoint again, with a right checksum, after `change(tensors, metadata)`."""
    def rewrite(path: Path) -> None:
        tensors, metadata = load_tensors(path)
        change(tensors, metadata)
        save_tensors(path, tensors, metadata)

    return at(MODEL, rewrite)


def _transpose_a_weight(tensors: dict[str, Any], metadata: dict[str, str]) -> None:
    name = next(name for name, tensor in sorted(tensors.items()) if tensor.dim() == 2 and tensor.shape[0] != tensor.shape[1])
    tensors[name] = tensors[name].T.contiguous()


def _unknown_field(tensors: dict[str, Any], metadata: dict[str, str]) -> None:
    config = json.loads(metadata["config"])
    config["train"]["momentum"] = 0.9
    metadata["config"] = json.dumps(config)


def unfinished(damage: Damage = lambda path: None) -> Damage:
    """Damage of the state of a training that did not reach its end."""

    def spoil(place: Path) -> None:
        (place / MODEL).unlink()
        damage(place / STATE)

    return spoil


CASES: tuple[Case, ...] = (
    Case("dataset missing", ("train", "--dataset", "robot/pile-v0"), "no Minari dataset 'robot/pile-v0'"),
    Case("dataset truncated", TRAIN, "is damaged", at(EPISODES, cut)),
    Case("dataset bit-flipped", TRAIN, "is damaged", at(EPISODES, flip)),
    Case("dataset's metadata truncated", TRAIN, "is damaged", at(METADATA, cut)),
    Case("stranger's dataset truncated", TRAIN, "is damaged", strangers(damage=cut)),
    Case("stranger's dataset bit-flipped", TRAIN, "is damaged", strangers(damage=flip)),
    Case("one image too few", TRAIN, "one more than", in_every_episode("observations", lambda images: images[:-1])),
    Case("actions of another shape", TRAIN, "the actions have shape",
         in_every_episode("actions", lambda actions: actions[:, :1])),
    Case("an action is NaN", TRAIN, "expected finite numbers", in_third_episode("actions", np.nan)),
    Case("an action is infinite", TRAIN, "expected finite numbers", in_third_episode("actions", np.inf)),
    Case("a reward is NaN", TRAIN, "expected finite numbers", in_third_episode("rewards", np.nan)),
    Case("float images that do not fill their bounds", TRAIN, "expected values up to 255",
         in_every_episode("observations", lambda images: images.astype(np.float32) / 255,
                          observation_space=("uint8", "float32"))),
    Case("no reward", TRAIN, "every reward of velap/SpiralMaze-v0 is 0", in_every_episode("rewards", np.zeros_like)),
    Case("episodes shorter than k", TRAIN, "longest episode", strangers(_two_steps_each)),
    Case("checkpoint missing", EVALUATE, "no checkpoint at", at(MODEL, Path.unlink)),
    Case("checkpoint truncated", EVALUATE, "damaged or truncated", at(MODEL, cut)),
    Case("checkpoint bit-flipped", EVALUATE, "does not match the SHA-256", at(MODEL, flip)),
    Case("checkpoint's header bit-flipped", EVALUATE, MODEL, at(MODEL, lambda path: flip(path, 1e-4))),
    Case("checkpoint is no safetensors file", EVALUATE, "not a readable safetensors file",
         at(MODEL, lambda path: path.write_bytes(b"weights"))),
    Case("checkpoint is a training state", EVALUATE, "not its training state",
         lambda place: shutil.copy(place / STATE, place / MODEL)),
    Case("checkpoint with weights of another shape", EVALUATE, "does not fit its own config",
         checkpoint(_transpose_a_weight)),
    Case("checkpoint with an unknown config field", EVALUATE, "unknown fields ['momentum']", checkpoint(_unknown_field)),
    Case("checkpoint of someone else", EVALUATE, "carries no checksum",
         at(MODEL, lambda path: save_file({"weight": torch.zeros(3)}, str(path)))),
    Case("training state truncated", RESUME, "damaged or truncated", unfinished(cut)),
    Case("training state bit-flipped", RESUME, "does not match the SHA-256", unfinished(flip)),
    Case("training state of another seed", (*RESUME, "--seed", "7"), "another seed", unfinished()),
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
        command=" ".join(["velap", *case.arguments]),
        message=message_of(stderr).replace(str(place), "FOLDER"),
        code=code,
        problems=(*judge(code, stderr, case.says), *changes(before, after)))


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
