"""A joint training run: phases, diagnostics, atomic checkpoints, exact resume.

A run directory holds `config.json`, `metrics.jsonl`, TensorBoard events, `state.safetensors` (everything a resume
needs) and, at the end, `model.safetensors`.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from velap.config import Config, older_fields
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler
from velap.errors import CheckpointError, ConfigError, DatasetError
from velap.models.encoders.moments import MomentEncoder
from velap.models.velap import OWN_WEIGHTS, LatentModel, Spaces, load_checkpoint, save_checkpoint
from velap.runs import MetricsLog, make_generator, write_atomic
from velap.training.diagnostics import diagnose, measure_latents
from velap.training.joint import JointLearner
from velap.training.slow import fit_palette
from velap.training.state import SCHEDULE, load_state, save_state
from velap.training.steps import Cadence, Progress, cosine, interrupt_flag, run_steps

STATE, MODEL = "state.safetensors", "model.safetensors"
OWN_PHASES = ("held", "held_distil", "clone")
"""Phases that teach VELAP's own policies, the last ones."""
OWN_STREAMS = {"held": 8, "clone": 6}
"""Random numbers of those phases, so that they can be learnt again beside the same model."""


@dataclass(frozen=True)
class TrainResult:
    """Outcome of one run."""

    checkpoint: Path
    sha256: str
    seconds: float
    """Training time, all sittings [s]."""
    diagnostics: dict[str, float]


def holdout_episodes(store: FrameStore, count: int, seed: int, *, rewarded: bool = False) -> np.ndarray:
    """Episodes int64 [*] kept for diagnostics: `count` unrewarded ones, at most a tenth of the data (with `rewarded`: that
    many successful ones, at most a tenth of those)."""
    starts, lengths = store.episode_start, store.episode_length
    pool = [e for e in range(len(starts)) if bool(store.rewards[starts[e] : starts[e] + lengths[e]].any()) == rewarded]
    n = min(count, (len(pool) if rewarded else len(starts)) // 10, len(pool))
    return np.random.default_rng([seed, 7]).permutation(np.array(pool, dtype=np.int64))[:n]


class Trainer:
    """One run: builds the learner, steps through the phases, saves and resumes."""

    def __init__(self, config: Config, store: FrameStore, run_dir: Path, seed: int, device: torch.device) -> None:
        self.config, self.store, self.run_dir, self.seed, self.device = config, store, Path(run_dir), seed, device
        train = config.train
        self.holdout = holdout_episodes(store, train.holdout_episodes, seed)
        self.sampler = WindowSampler(store, train, config.model.frame_stack, device, self.holdout)
        self._check_lengths()
        height, width = store.frames.shape[1:3]
        spaces = Spaces(height, width, tuple(map(float, store.action_low)), tuple(map(float, store.action_high)))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = LatentModel(config.model, spaces, train.discount, train.precision).to(device).train()
        if isinstance(self.model.encoder, MomentEncoder):
            fit_palette(self.model.encoder, self.sampler, seed)
        self.generator = make_generator(seed, stream=1, device=device)
        self.learner = JointLearner(self.model, train, self.sampler, self.generator)
        self.step, self.seconds = 0, 0.0
        self.adopted: dict[str, Tensor] = {}
        """Weights taken from a finished checkpoint, by name."""

    @property
    def total(self) -> int:
        """Updates of all phases [steps]."""
        return self.config.train.steps

    @property
    def phase(self) -> str:
        """Name of the phase that the last update belonged to: one of `TrainConfig.phases`."""
        return self._phase_of(max(self.step - 1, 0))[0]

    def _phase_of(self, update: int) -> tuple[str, int, int]:
        """Name of the phase of an update, the update's number within it, and the phase's updates [steps]."""
        within = update
        for name, steps in self.config.train.phases:
            if within < steps:
                return name, within, steps
            within -= steps
        raise ValueError(f"update {update} is beyond the last of {self.total}")

    @property
    def cadence(self) -> Cadence:
        """As the config says."""
        train = self.config.train
        return Cadence(train.log_every, train.diagnose_every, train.checkpoint_every)

    @property
    def state_path(self) -> Path:
        """`state.safetensors` of the run."""
        return self.run_dir / STATE

    @property
    def events_dir(self) -> Path:
        """TensorBoard folder of the run."""
        return self.run_dir / "tensorboard"

    def _check_lengths(self) -> None:
        longest, k = int(self.store.episode_length.max()), self.config.train.dynamics_horizon
        if longest < k:
            raise DatasetError(
                f"the longest episode has {longest} steps; the dynamics loss needs at least dynamics_horizon = {k}. "
                "Collect longer episodes or lower `dynamics_horizon`."
            )

    def update(self) -> dict[str, Tensor]:
        """One update of the current phase."""
        train, learner = self.config.train, self.learner
        phase, done, steps = self._phase_of(self.step)
        falling = cosine(done / steps)
        if phase == "encoder":
            learner.set_learning_rate(train.encoder_learning_rate * falling)
            info = learner.encoder_step()
        elif phase == "joint":
            learner.set_learning_rate(train.learning_rate)
            info = learner.joint_step()
        else:
            self._freeze()
            if phase in OWN_STREAMS and done == 0:
                own = make_generator(self.seed, stream=OWN_STREAMS[phase], device=self.device)
                self.generator.set_state(own.get_state())
            info = learner.frozen_step(phase, done, steps)
        self.step += 1
        return info

    def _freeze(self) -> None:
        """The phases after the joint one work on cached latents."""
        if self.learner.cache is not None:
            return
        if self.config.train.heads_afresh:
            self.learner.start_heads_afresh()
        self.learner.begin_latent_phase()

    def report(self) -> dict[str, float]:
        """Diagnostics on held-out episodes."""
        episodes = [
            (int(self.store.episode_start[e]), int(self.store.episode_start[e] + self.store.episode_length[e]))
            for e in self.holdout
        ]
        return diagnose(self.model, self.sampler, episodes, self.learner.cache) if episodes else {}

    def save(self) -> None:
        """Everything a resume needs, in one atomic file."""
        metadata = self._identity() | {"step": str(self.step), "seconds": repr(self.seconds)}
        save_state(self.state_path, self.learner, metadata)

    def resume(self) -> None:
        """Continue from `state.safetensors`; raises CheckpointError when it belongs to another run."""
        identity = self._identity()
        metadata = load_state(self.state_path, self.learner, identity)
        self._check_schedule(json.loads(metadata[SCHEDULE]), json.loads(identity[SCHEDULE]), int(metadata["step"]))
        self.step, self.seconds = int(metadata["step"]), float(metadata["seconds"])

    def adopt(self, path: Path) -> None:
        """Take all but VELAP's own policies from a finished checkpoint and begin where those are learnt.

        Raises CheckpointError where its config, seed or data are others, or where nothing is left to learn.
        """
        model, config, metadata = load_checkpoint(path, self.device)
        found = (config.shared_json(), metadata.get("seed"), metadata.get("dataset_hash"))
        asked = (self.config.shared_json(), str(self.seed), self.store.content_hash)
        wrong = [name for name, a, b in zip(("config", "seed", "dataset"), found, asked, strict=True) if a != b]
        own = self.total - sum(steps for name, steps in self.config.train.phases if name in OWN_PHASES)
        if wrong or own == self.total:
            reason = f"has another {' and another '.join(wrong)}" if wrong else "leaves nothing to learn with this config"
            raise CheckpointError(f"{path} {reason}; expected a finished checkpoint of the same task, preset, seed and "
                                  "data, and a config with `held_steps` or `clone_steps`. Train without --base.")
        self.adopted = {name: value for name, value in model.state_dict().items() if not name.startswith(OWN_WEIGHTS)}
        self.model.load_state_dict(self.adopted, strict=False)
        self.learner.begin_latent_phase()
        self.step, self.seconds = own, float(metadata.get("train_seconds", 0))

    def _check_schedule(self, made: dict[str, object], asked: dict[str, object], step: int) -> None:
        """Raises CheckpointError where a phase after the joint one that has begun by `step` was made with other fields.

        Phases that are still to come may change: a finished run can be given more of them, to the bits of one that had them
        from the start.
        """
        order = [name for name, _ in self.config.train.phases]
        begun = order.index(self._phase_of(min(max(step - 1, 0), self.total - 1))[0])
        if self.learner.cache is None:
            return
        differing = sorted(name for name in made.keys() | asked.keys() if made.get(name) != asked.get(name))
        wrong = [name for name in differing if order.index(phase_of_field(name)) <= begun]
        if wrong or step > self.total:
            raise CheckpointError(f"{self.state_path} was made with another schedule: {', '.join(wrong or ['its length'])} "
                                  f"differ, and after {step} updates their phases have begun; expected the same. Resume "
                                  "with the same settings, or start a new run elsewhere with --out.")

    def _identity(self) -> dict[str, str]:
        """What must agree for a resume: everything that has had an effect on training so far.

        Planner and controller never have. How long the joint phase lasts and what later phases do count once they have
        begun (`schedule`).
        """
        train = older_fields("train", asdict(self.config.train))
        later = ("latent_", "held_", "clone_")
        schedule = {name: train.pop(name) for name in sorted(train) if name == "joint_steps" or name.startswith(later)}
        learned = {"task": self.config.task, "model": older_fields("model", asdict(self.config.model)), "train": train}
        return {
            "config": json.dumps(learned, sort_keys=True),
            SCHEDULE: json.dumps(schedule),
            "seed": str(self.seed),
            "dataset": self.store.content_hash,
        }

    def finish(self, command: str) -> TrainResult:
        """Measure the latents, keep the bank, write the released form of the model."""
        diagnostics = self.report()
        self.model.eval()
        measure_latents(self.model, self.sampler, make_generator(self.seed, stream=2))
        self.model.load_state_dict(self.adopted, strict=False)  # their latents were measured before they were rounded
        provenance = {
            "command": command,
            "seed": str(self.seed),
            "dataset_id": self.store.dataset_id,
            "dataset_hash": self.store.content_hash,
            "reading": self.store.reading.to_json(),
            "train_seconds": f"{self.seconds:.0f}",
            "diagnostics": json.dumps(diagnostics),
            "steps": str(self.step),
        }
        path = self.run_dir / MODEL
        digest = save_checkpoint(path, self.model, self.config, provenance)
        return TrainResult(path, digest, self.seconds, diagnostics)


def phase_of_field(name: str) -> str:
    """The phase that a field of the schedule belongs to; what several share belongs to the first of them."""
    parts = {"joint": ("joint_",), "values": ("latent_value_",), "held": ("held_",), "clone": ("clone_",)}
    return next((phase for phase, prefixes in parts.items() if name.startswith(prefixes)), "latent")


def train(
    config: Config,
    store: FrameStore,
    run_dir: Path,
    *,
    seed: int = 0,
    device: str = "auto",
    resume: bool = False,
    base: Path | None = None,
    command: str = "velap.train",
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> TrainResult:
    """Train to the end. Ctrl-C saves the state and raises KeyboardInterrupt; `resume` goes on from there, to the same
    bits on CPU. With `base`, a finished checkpoint, only VELAP's own policies are learnt, beside everything that it holds.

    Raises CheckpointError when `run_dir` holds another run, or an unfinished one and `resume` is off.
    """
    run_dir = Path(run_dir)
    keep_freed_memory()
    trainer = Trainer(config, store, run_dir, seed, pick_device(device))
    resumed = None
    if base is not None:
        trainer.adopt(base)
    if (run_dir / STATE).exists():
        if not resume:
            raise CheckpointError(f"{run_dir} already holds a run. Add --resume to go on with it, or give another --out.")
        trainer.resume()
        resumed = trainer.step
    write_atomic(run_dir / "config.json", config.to_json().encode())
    log = MetricsLog(run_dir / "metrics.jsonl", resumed)
    with interrupt_flag() as interrupted:
        run_steps(trainer, log, on_progress, interrupted)
    trainer.save()
    if trainer.step < trainer.total:
        raise KeyboardInterrupt
    return trainer.finish(command)


def keep_freed_memory() -> None:
    """Let glibc keep freed blocks: activations of some 16 MB are otherwise mapped and zeroed anew by the kernel at every
    update.

    Measured: 127 → 91 ms for the encoder's forward and backward pass of 252 frames on one core. No effect elsewhere.
    """
    trim_threshold, top_pad, mmap_max = -1, -2, -4  # malloc.h: M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX
    with contextlib.suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(mmap_max, 0)
        mallopt(trim_threshold, 2**31 - 1)
        mallopt(top_pad, 2**26)


def pick_device(device: str) -> torch.device:
    """`auto` takes CUDA where it is found, else the CPU; raises ConfigError for a device that is not here."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {device!r}; expected auto, cpu or cuda.") from error
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device {device!r} was asked for and PyTorch finds no CUDA here. Use --device auto or cpu.")
    return found
