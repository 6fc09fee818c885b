"""All that the golden tests need of velap's modules, and nothing else: when modules move, this file alone follows.

The numbers in tests/golden stay as they are. T steps, A action dimension, F frames.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from velap import api
from velap.config import Config, ModelConfig, override
from velap.data.frames import FrameStore
from velap.data.sampling import WholeWindows
from velap.errors import CheckpointError
from velap.evaluation.evaluate import make_env
from velap.evaluation.records import read_records, record_path
from velap.evaluation.rollout import FrameReader
from velap.methods.base import get_method, learning_methods, make_agent
from velap.methods.heads import load_head, make_head
from velap.methods.iris import SubgoalHead
from velap.methods.learning import train_head
from velap.models.checkpoint import load_checkpoint, shared_weights
from velap.models.encoders.moments import KEPT_LIMIT, KEPT_SCALE, MomentEncoder, slow_features
from velap.models.velap import LatentModel
from velap.native.kernels import library
from velap.registry import ENCODERS, METHODS
from velap.runs import content_sha256, load_tensors, make_generator
from velap.tasks import TASKS, make_config
from velap.training.frozen import latent_data
from velap.training.loop import MODEL, STATE, Trainer, train
from velap.training.phase import start_heads_afresh

REPOSITORY = Path(__file__).resolve().parents[1]
HEADED = tuple(learning_methods())
"""Methods that act by a head of their own."""
ALL_METHODS = tuple(METHODS)
"""Methods that were there at the commit of the golden files."""
HEAD_SEEDS = {"bc": 7, "bc-success": 8, "iql": 9, "iql-sparse": 10, "iris": 11, "iris-multistep": 12}
"""Seeds of the random weights of the heads in the traces, and of their learners."""
HORIZONS = {"iris": 10, "iris-multistep": 5}
"""Steps to a subgoal in those heads."""
SHOOTING = {"arithmetic": "float32", "samples": 200}
"""How MPPI and MBOP plan in the traces, besides their defaults: fewer trajectories take less time."""
UPDATES = 20
"""Recorded updates of a phase."""
DECIMALS = 6
"""Decimals of the actions in the traces."""


def released(task: str) -> Path:
    """The released checkpoint of a task."""
    return REPOSITORY / "checkpoints" / f"{task}.safetensors"


# Traces.


@contextlib.contextmanager
def pytorch_networks() -> Iterator[None]:
    """Within, networks run in PyTorch on one thread, as the traces do."""
    threads = torch.get_num_threads()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VELAP_NATIVE", "0")
        library.cache_clear()
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)
            library.cache_clear()


def trace(task: str, method: str, seed: int, steps: int, taken: np.ndarray | None = None) -> np.ndarray:
    """Actions [T, A] of the first `steps` steps of an episode, alone in its batch, rounded.

    The environment is stepped by the actions `taken` where they are given, else by the method's own rounded ones: a
    difference in the last digits does then not grow through the environment. Encoder and shooting compute in single
    precision: half precision rounds by processor and batch, which moves elites.
    """
    model, config, _ = load_checkpoint(released(task))
    if hasattr(model.encoder, "dtype"):
        model.encoder.dtype = torch.float32
    settings = get_method(method).settings_of("default", SHOOTING if method in ("mppi", "mbop") else None)
    env = make_env(TASKS[task].env_id)
    try:
        head = _random_head(method, config, model.action_dim)
        agent = make_agent(method, model, config, env.action_space, head, settings)
        read = FrameReader(env, model.spaces.height)
        observation, _ = env.reset(seed=seed, options={"split": "test"})
        agent.reset(np.ones(1, bool), np.array([seed]))
        frames = [read(observation)] * agent.frame_stack
        actions = []
        for step in range(steps if taken is None else len(taken)):
            action = np.round(agent.act(np.stack(frames[-agent.frame_stack :])[None])[0].astype(np.float64), DECIMALS)
            actions.append(action)
            sent = action if taken is None else taken[step]
            observation, _, terminated, truncated, info = env.step(sent.astype(np.float32))
            frames.append(read(observation))
            if terminated or truncated or info.get("success"):
                break
        return np.stack(actions)
    finally:
        env.close()


def _random_head(method: str, config: Config, action_dim: int) -> Any:
    if method not in HEADED:
        return None
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(HEAD_SEEDS[method])
        head = make_head(method, config.model, action_dim)
    if isinstance(head, SubgoalHead):
        head.steps_ahead.fill_(HORIZONS[method])
    return head.requires_grad_(False)


# Losses.

TINY: dict[str, Any] = {"frame_stack": 2, "latent_dim": 4, "bank_size": 10}
BRIEF: dict[str, Any] = {"joint": {"steps": 2, "windows": 6, "window": 5}, "latent": {"steps": 0}}
OWN: dict[str, Any] = {"clones": True}
BEST: dict[str, Any] = {"critic_loss": "cross_entropy", "critic_floor": 0.02}
SMALL_SIZES: dict[str, Any] = {
    "velap.config.training.DISTIL_STEPS": UPDATES,
    "velap.methods.heads.POLICY": (16,),
    "velap.methods.iql.CRITIC": (16,),
    "velap.methods.iris.GENERATIVE": (16,),
    "velap.methods.iris.NOISE_DIM": 2,
    "velap.methods.iris.POLICY": (16,),
    "velap.models.encoders.conv.DENSE": (8,),
    "velap.models.encoders.conv.FILTERS": (4, 4),
    "velap.models.encoders.conv.KERNELS": (4, 4),
    "velap.models.encoders.conv.native_precision": lambda device: torch.float32,
    "velap.models.encoders.conv.STRIDES": (2, 2),
    "velap.models.encoders.moments.COLOURS": 4,
    "velap.models.encoders.moments.DENSE": (8,),
    "velap.models.velap.COMMAND_MEMORY": 0.8,
    "velap.models.velap.CRITIC": (16,),
    "velap.models.velap.DYNAMICS": (16,),
    "velap.models.velap.GENERATIVE": (16,),
    "velap.models.velap.NOISE_DIM": 2,
    "velap.models.velap.POLICY": (16,),
    "velap.training.encoder.SIDE": 16,
    "velap.training.ensemble.CRITIC": (16,),
    "velap.training.ensemble.POLICY": (16,),
    "velap.training.joint.WholeWindows": lambda windows, length, *_: WholeWindows(windows, length, 12, 10, 3),
}
"""Constants of today that were fields when the losses were recorded, with the values of the tiny networks there."""


class BothEncoder(MomentEncoder):
    """Two slow features and all moments behind the learnt part, as an encoder then could have."""

    def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
        super().__init__(config, size)
        self.register_buffer("slow_mean", torch.zeros(24))
        self.register_buffer("slow_directions", torch.zeros(24, 2))

    @classmethod
    def width(cls, config: ModelConfig) -> int:
        """D."""
        return config.latent_dim + 2 + 24

    def fit(self, frames: Tensor, last: Tensor, seed: int) -> Tensor:
        """Palette and slow features."""
        features = super().fit(frames, last, seed)
        mean, directions = slow_features(features, last, 2)
        self.slow_mean.copy_(mean)
        self.slow_directions.copy_(KEPT_SCALE * directions)
        return features

    def kept(self, newest: Tensor) -> Tensor:
        """Slow features and moments."""
        slow = ((newest - self.slow_mean) @ self.slow_directions).clamp(-KEPT_LIMIT, KEPT_LIMIT)
        return torch.cat([slow, super().kept(newest)], -1)


if "golden-both" not in ENCODERS:
    ENCODERS.add("golden-both", BothEncoder)


@contextlib.contextmanager
def small_sizes(**changes: Any) -> Iterator[None]:
    """Within, networks have the sizes of the recorded ones; `changes` by the last word of a name of `SMALL_SIZES`."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in SMALL_SIZES.items():
            patch.setattr(name, changes.get(name.rpartition(".")[2], value))
        yield


ENSEMBLE: dict[str, Any] = {"steps": 2, "members": 3}
PAIRS: dict[str, Any] = {"steps": UPDATES, "pairs": 8}

PHASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    "encoder-pairs": ("encoder", {}, {"encoder": PAIRS}),
    "encoder-moments": ("encoder", {"encoder": "moments", "latent_dim": 6}, {"encoder": PAIRS}),
    "joint-infonce": ("joint", {}, {"joint": {"steps": UPDATES}}),
    "joint-mse": ("joint", {}, {"joint": {"steps": UPDATES, "dynamics_loss": "mse"}}),
    "joint-paper": ("joint", {"norm": "batch", "dynamics_residual": False, "critic_bounded": False, "n_global": 1},
                    {"joint": {"steps": UPDATES, "window": 1, "rewarded_share": 0.0}, "target_rate": 0.005,
                     "policy_every": 1}),
    "joint-many-scenes": ("joint", {}, {
        "joint": {"steps": UPDATES, "reconstruction_side": 8}, "group_windows": 3, "group_reach": 2, **BEST}),
    "joint-commands": ("joint", {"command_dims": 2}, {"joint": {"steps": UPDATES}}),
    "latent": ("latent", {}, {"latent": {"steps": UPDATES, "horizon": 3}, **BEST}),
    "latent-kept-moments": ("latent", {"encoder": "golden-both", "latent_dim": 6}, {
        "encoder": {**PAIRS, "steps": 2}, "latent": {"steps": UPDATES, "horizon": 3}}),
    "latent-rewarded": ("latent", {}, {"latent": {"steps": UPDATES, "horizon": 3, "rewarded_share": 0.3}}),
    "latent-heads-afresh": ("latent", {"command_dims": 3}, {"latent": {"steps": UPDATES, "horizon": 3}}),
    "values": ("values", {}, {"values": {"steps": UPDATES, "rewarded_share": 0.2}, **BEST}),
    "members": ("ensemble", {}, {"ensemble": {**ENSEMBLE, "steps": UPDATES, "noise": 0.1}}),
    "members-cross-entropy": ("ensemble", {}, {"ensemble": {**ENSEMBLE, "steps": UPDATES}, **BEST}),
    "distil": ("ensemble distil", {}, {"ensemble": ENSEMBLE}),
    "clone": ("clone", OWN, {"clone": {"steps": UPDATES}}),
    "clone-candidates": ("clone", OWN, {"clone": {"steps": UPDATES, "candidates": 2}}),
    "clone-after-everything": ("clone", OWN, {
        "encoder": {**PAIRS, "steps": 2}, "latent": {"steps": 2, "horizon": 3}, "values": {"steps": 2}, "ensemble": ENSEMBLE,
        "clone": {"steps": UPDATES}}),
}
"""Cases of the joint training: the stage whose updates are recorded, and the fields of the model and of the training that
differ from `TINY` and `BRIEF`; with `OWN`, the model has the policy of successes, whatever the phases."""
NAMES = {"ensemble/loss": "members/loss", "ensemble/q": "members/q", "ensemble/policy": "members/policy",
         "ensemble/imitation": "members/imitation", "ensemble/distil": "distil/policy", "ensemble/distil_q": "distil/q"}
"""Losses that have another name in the golden files."""


def tiny_store(side: int = 16, actions: int = 3, episodes: int = 12, length: int = 8) -> FrameStore:
    """Episodes of a bright square that the actions move over noise; every third one ends in a success."""
    rng = np.random.default_rng(5)
    rows = episodes * (length + 1)
    frames = rng.integers(0, 60, (rows, side, side, 3), dtype=np.uint8)
    given = rng.uniform(-1, 1, (rows, actions)).astype(np.float32)
    given[length :: length + 1] = 0
    size = side // 4
    for episode in range(episodes):
        place = rng.uniform(size, side - 2 * size, 2)
        for row in range(episode * (length + 1), (episode + 1) * (length + 1)):
            y, x = place.astype(int)
            frames[row, y : y + size, x : x + size] = (220, 180, 40 + 10 * (episode % 3))
            place = np.clip(place + given[row, :2] * size / 2, 0, side - size)
    rewards, terminated, truncated = np.zeros(rows, np.float32), np.zeros(rows, bool), np.zeros(rows, bool)
    ends = np.arange(length - 1, rows, length + 1)
    rewards[ends[::3]] = 1
    terminated[ends[::3]] = True
    truncated[ends] = ~terminated[ends]
    return FrameStore(
        frames=frames, actions=given, rewards=rewards, terminated=terminated, truncated=truncated,
        episode_start=np.arange(episodes) * (length + 1), episode_length=np.full(episodes, length),
        action_low=np.full(actions, -1, np.float32), action_high=np.full(actions, 1, np.float32),
        dataset_id="test/golden-v0", content_hash="golden")


def phase_losses(case: str, folder: Path) -> list[dict[str, float]]:
    """What each of the `UPDATES` updates of a case of `PHASES` says."""
    stage, model, training = PHASES[case]
    own, model = (OWN, {}) if model is OWN else ({}, model)
    short = 2 if case == "clone-after-everything" else UPDATES
    with small_sizes(DISTIL_STEPS=short), pytest.MonkeyPatch.context() as patch:
        config = override(Config("test", "default"), model={**TINY, **model}, train=BRIEF)
        config = override(config, train=training)
        if own:
            train = config.train
            patch.setattr("velap.training.loop.make_model",
                          lambda config, spaces: LatentModel(config.model, spaces, train.discount, **own))
        run = Trainer(config, tiny_store(), folder, 0, torch.device("cpu"))
        afresh = case == "latent-heads-afresh"  # the encoder alone learnt jointly, without commands
        if afresh:
            run.model.command_weight.zero_()
        seen = []
        while run.step < run.total:
            if afresh and run.step == 2:
                start_heads_afresh(run.run)
            info = run.update()
            if run.phase == stage:
                seen.append(_plain(info))
    assert len(seen) == UPDATES, f"{case} had {len(seen)} updates of {stage}"
    return seen


def head_losses(method: str, folder: Path) -> list[dict[str, float]]:
    """What each of the first `UPDATES` updates of a method's learner says, and last its held-out losses."""
    with small_sizes():
        config = override(Config("test", "default"), model=TINY, train=BRIEF)
        run = Trainer(config, tiny_store(), folder, 0, torch.device("cpu"))
        run.model.eval()
        folder.mkdir(parents=True, exist_ok=True)
        data = latent_data(run.model, config, {"seed": "0"}, tiny_store(), folder)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(HEAD_SEEDS[method])
            head = make_head(method, config.model, run.model.action_dim).train()
        settings = get_method(method).learner_config("default", {"batch": 16, "steps": 200})
        learner = get_method(method).learner(head, data, settings, make_generator(HEAD_SEEDS[method], stream=3))
        return [_plain(learner.update()) for _ in range(UPDATES)] + [learner.report()]


def _plain(info: dict[str, Tensor]) -> dict[str, float]:
    return {NAMES.get(name, name): float(value) for name, value in info.items()}


# Released checkpoints.


def checkpoint_facts(task: str) -> dict[str, Any]:
    """What a released checkpoint is, as it is loaded: hashes, the whole config, provenance that decides records."""
    model, config, metadata = load_checkpoint(released(task))
    return {
        "weights_sha256": metadata["weights_sha256"],
        "shared_sha256": shared_weights(metadata),
        "tensors_sha256": tensors_digest(released(task)),
        "parameters": sum(value.numel() for value in model.state_dict().values()),
        "format": metadata["format"],
        "seed": int(metadata["seed"]),
        "steps": int(metadata["steps"]),
        "dataset_id": metadata["dataset_id"],
        "dataset_hash": metadata["dataset_hash"],
        "spaces": json.loads(metadata["spaces"]),
        "encoder": config.model.encoder,
        "frame_stack": config.model.frame_stack,
        "phases": {phase.label: phase.steps for phase in config.train.phases},
    }


def hashes_of_content(task: str) -> tuple[str, str]:
    """`weights_sha256` computed anew from the file's tensors and config, and what its metadata says."""
    tensors, metadata = load_tensors(released(task))
    return content_sha256(tensors, {"config": Config.from_json(metadata["config"]).hash()}), metadata["weights_sha256"]


def tensors_that_went(task: str) -> int:
    """Numbers in the tensors of a released checkpoint that today's model has no more, less those that it has besides."""
    there, own = load_tensors(released(task))[0], load_checkpoint(released(task))[0].state_dict()
    return (sum(value.numel() for name, value in there.items() if name not in own)
            - sum(value.numel() for name, value in own.items() if name not in there))


def tensors_digest(path: Path) -> str:
    """SHA-256 over the values of all tensors of a file, whatever their names and order."""
    tensors, _ = load_tensors(path)
    single = sorted(hashlib.sha256(f"{tuple(value.shape)}".encode() + value.double().numpy().tobytes()).hexdigest()
                    for value in tensors.values())
    return hashlib.sha256("".join(single).encode()).hexdigest()


def record_identities(task: str, method: str) -> set[tuple[str, str]]:
    """(config hash, checkpoint hash) in the committed records of a method."""
    path = record_path(REPOSITORY / "results/records-five-recipes", task, method, "default", 0)
    return {(record.config_hash, record.checkpoint) for record in read_records(path)}


# Files of the old layout.

OLD_TASK = "SpiralMaze"
OLD_STOP = 14
"""Updates of the unfinished run: every phase has one before, some have one after."""


def old_config() -> Config:
    """A tiny run of the task `OLD_TASK` with most phases."""
    training = {"joint": {"steps": 4, "windows": 6, "window": 5, "c1": 0.01}, "latent": {"steps": 2, "horizon": 3},
                "values": {"steps": 2}, "ensemble": ENSEMBLE, "clone": {"steps": 4},
                "checkpoint_every": 8, "log_every": 2}
    return override(make_config(OLD_TASK), model=TINY, train=training, planner={"n_iter": 8, "candidates": 4, "n_sim": 2})


@contextlib.contextmanager
def old_sizes() -> Iterator[None]:
    """Within, networks have the sizes of that run, and its config is read although it names them."""
    with small_sizes(STRIDES=(4, 2), DISTIL_STEPS=2), pytest.MonkeyPatch.context() as patch:
        patch.setattr("velap.config.migrate._refuse_unless", lambda *_: None)
        yield


def old_store() -> FrameStore:
    """The data of that run."""
    return tiny_store(side=64, actions=2)


def refusal_of_old(folder: Path) -> str:
    """What a resume of an unfinished copy of it says where the run is refused."""
    with pytest.raises(CheckpointError) as refused:
        finish_old(folder)
    return str(refused.value)


def train_old(folder: Path, stop: int | None = None, resume: bool = False) -> Path:
    """Train that run, to `stop` updates as Ctrl-C would or to its end; returns its folder."""

    def interrupt(progress: Any) -> None:
        if stop is not None and progress.step >= stop:
            signal.raise_signal(signal.SIGINT)

    with old_sizes(), contextlib.nullcontext() if stop is None else pytest.raises(KeyboardInterrupt):
        train(old_config(), old_store(), folder, device="cpu", resume=resume, command="velap train SpiralMaze",
              on_progress=interrupt)
    return folder


def finish_old(folder: Path) -> Path:
    """Go on with an unfinished copy of it; returns the finished checkpoint."""
    return train_old(folder, resume=True) / MODEL


def old_state(folder: Path) -> Path:
    """The state file of a run directory."""
    return folder / STATE


def read_tensors(path: Path) -> dict[str, np.ndarray]:
    """The tensors of any of velap's files by name, checksum verified."""
    return {name: value.numpy() for name, value in load_tensors(path)[0].items()}


def train_old_head(checkpoint: Path, method: str) -> Path:
    """Learn a head beside a checkpoint of that run."""
    settings = get_method(method).learner_config("default", {"batch": 16, "steps": 20})
    with old_sizes():
        return train_head(method, checkpoint, old_store(), device="cpu", config=settings, command="velap train").path


def evaluate_old(checkpoint: Path, records: Path, method: str, episodes: int = 2) -> Path:
    """Validation episodes of a checkpoint of that run; returns the record file."""
    with old_sizes():
        api.evaluate(OLD_TASK, checkpoint, method=method, episodes=episodes, first_seed=1000, records=records, device="cpu")
    return record_path(records, OLD_TASK, method, "default", 0)


def load_old(checkpoint: Path, method: str) -> tuple[LatentModel, Config]:
    """The model and the config of a finished old checkpoint; a method with a head has that one beside it."""
    with old_sizes():
        model, config, metadata = load_checkpoint(checkpoint)
        if method in HEADED:
            load_head(checkpoint.with_name(f"{method}.safetensors"), metadata)
        return model, config


def read_old_records(path: Path) -> list[dict[str, Any]]:
    """Fields of the records of a file."""
    return [dataclasses.asdict(record) for record in read_records(path)]


