"""A joint training: its phases one after the other, diagnostics, atomic checkpoints, exact resume.

A run directory holds `config.json`, `metrics.jsonl`, TensorBoard events, `state.safetensors` (everything that a resume
needs) and, at the end, `model.safetensors`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from velap.config import Config
from velap.config.serialise import CADENCES, phase_to_dict
from velap.config.training import (
    DYNAMICS_HORIZON,
    ClonePhase,
    EncoderPhase,
    EnsemblePhase,
    JointPhase,
    LatentPhase,
    ValuePhase,
)
from velap.data.frames import FrameStore
from velap.data.sampling import WindowSampler
from velap.errors import CheckpointError, ConfigError, DatasetError
from velap.models.checkpoint import MODEL as MODEL
from velap.models.checkpoint import make_model, save_checkpoint
from velap.models.velap import Spaces
from velap.runs import make_generator, only_writer, write_atomic
from velap.training.clone import CloneLearner, measure_arrivals
from velap.training.diagnostics import diagnose, measure_gap, measure_latents
from velap.training.encoder import EncoderLearner
from velap.training.ensemble import EnsembleLearner
from velap.training.joint import JointLearner
from velap.training.latent import LatentLearner, ValueLearner
from velap.training.loggers import DEFAULT, Logger, make_loggers
from velap.training.phase import Frozen, PhaseLearner, Run, start_heads_afresh
from velap.training.state import SavedState, save_state
from velap.training.steps import Cadence, Progress, interrupt_flag, run_steps

STATE = "state.safetensors"
HOLDOUT_EPISODES = 16
"""Unrewarded episodes kept out of training for the diagnostics. ours."""
DIAGNOSE_EVERY = 1_000
"""Updates between diagnostics [steps]. ours."""
ON_FRAMES: dict[type, type[PhaseLearner[Any]]] = {EncoderPhase: EncoderLearner, JointPhase: JointLearner}
"""Learners of the phases that train the encoder."""
ON_LATENTS: dict[type, type[PhaseLearner[Any]]] = {
    LatentPhase: LatentLearner, ValuePhase: ValueLearner, EnsemblePhase: EnsembleLearner, ClonePhase: CloneLearner,
}
"""Learners of the phases on a frozen encoder."""


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


def success_share(store: FrameStore) -> float:
    """Share of a store's episodes that hold a reward."""
    return float((np.bincount(store.episode_of, weights=store.rewards) > 0).mean())


def standardisation(states: np.ndarray | None) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Mean and one by the deviation of states float32 [F, S], 0 for entries that never vary; both empty without states."""
    if states is None:
        return (), ()
    mean, deviation = states.mean(0, dtype=np.float64), states.std(0, dtype=np.float64)
    varies = deviation > 1e-6 * np.maximum(1, np.abs(mean))
    scale = np.divide(1, deviation, out=np.zeros_like(deviation), where=varies)
    return tuple(map(float, mean)), tuple(map(float, scale))


class Trainer:
    """One run: steps through the phases, saves and resumes."""

    def __init__(self, config: Config, store: FrameStore, run_dir: Path, seed: int, device: torch.device) -> None:
        self.config, self.store, self.run_dir, self.seed, self.device = config, store, Path(run_dir), seed, device
        self.phases = config.train.phases
        self.holdout = holdout_episodes(store, HOLDOUT_EPISODES, seed)
        self.sampler = WindowSampler(store, config.train, config.model.frame_stack, device, self.holdout)
        self._check_data()
        height, width = store.frames.shape[1:3]
        spaces = Spaces(height, width, tuple(map(float, store.action_low)), tuple(map(float, store.action_high)),
                        *standardisation(store.states))
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.model = make_model(config, spaces).to(device).train()
        features = self.model.encoder.fit(self.sampler.frames, self.sampler.last, seed)
        self.run = Run(self.model, config.train, self.sampler, features, seed)
        self.frozen: Frozen | None = None
        """Latents and optimisers once a phase works on a frozen encoder."""
        self.learner: PhaseLearner[Any] | None = None
        """Of the phase that is under way; None between two."""
        self.finished, self.done, self.step, self.seconds = 0, 0, 0, 0.0
        self.stage = self.phases[0].stage(0)

    def _check_data(self) -> None:
        """Raises DatasetError where the data lack what some phase needs."""
        longest = int(self.store.episode_length.max())
        if longest < DYNAMICS_HORIZON:
            raise DatasetError(f"the longest episode has {longest} steps; the dynamics loss needs at least "
                               f"{DYNAMICS_HORIZON}. Collect longer episodes.")
        for phase in self.phases:
            (ON_FRAMES | ON_LATENTS)[type(phase)].check(phase, self.sampler)

    @property
    def total(self) -> int:
        """Updates of all phases [steps]."""
        return self.config.train.steps

    @property
    def phase(self) -> str:
        """The stage that the last update belonged to."""
        return self.stage

    @property
    def cadence(self) -> Cadence:
        """As the config says."""
        return Cadence(self.config.train.log_every, DIAGNOSE_EVERY, self.config.train.checkpoint_every)

    @property
    def state_path(self) -> Path:
        """`state.safetensors` of the run."""
        return self.run_dir / STATE

    def update(self) -> dict[str, Tensor]:
        """One update of the current phase."""
        phase = self.phases[self.finished]
        if self.learner is None:
            self.learner = self._make_learner(afresh=True)
            self.learner.begin()
        info = self.learner.update(self.done)
        self.stage = phase.stage(self.done)
        self.done, self.step = self.done + 1, self.step + 1
        if self.done == phase.updates:
            self.finished, self.done, self.learner = self.finished + 1, 0, None
        return info

    def _make_learner(self, afresh: bool) -> PhaseLearner[Any]:
        """The learner of the current phase. Where the encoder is frozen only now and no joint phase has taught the heads,
        they begin with new weights if `afresh`."""
        phase = self.phases[self.finished]
        if type(phase) in ON_FRAMES:
            return ON_FRAMES[type(phase)](phase, self.run)
        if self.frozen is None:
            if afresh and not any(isinstance(before, JointPhase) for before in self.phases):
                start_heads_afresh(self.run)
            self.frozen = Frozen(self.run)
        return ON_LATENTS[type(phase)](phase, self.run, self.frozen)  # type: ignore[call-arg]

    def report(self) -> dict[str, float]:
        """Diagnostics on held-out episodes."""
        episodes = self._held_out()
        latents = None if self.frozen is None else self.frozen.latents
        return diagnose(self.model, self.sampler, episodes, latents) if episodes else {}

    def _held_out(self) -> list[tuple[int, int]]:
        """First and last row of every held-out episode."""
        starts, lengths = self.store.episode_start[self.holdout], self.store.episode_length[self.holdout]
        return [(int(start), int(start + length)) for start, length in zip(starts, lengths, strict=True)]

    def _modules(self) -> dict[str, nn.Module]:
        """Networks of the run by name, those of the current phase included."""
        actor_critic = self.run.actor_critic
        own = {} if self.learner is None else self.learner.modules
        return {"model": self.model, "local_target": actor_critic.local_target, "global_target": actor_critic.global_target,
                **{f"phase/{name}": module for name, module in own.items()}}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        """Optimisers by name; those on frozen latents outlive their phase."""
        frozen = {} if self.frozen is None else self.frozen.optimizers
        own = {} if self.learner is None else self.learner.optimizers
        return {**{f"frozen/{name}": each for name, each in frozen.items()},
                **{f"phase/{name}": each for name, each in own.items() if each not in frozen.values()}}

    def _identity(self) -> dict[str, str]:
        """What must agree for a resume, besides the phases so far. Planner and controller have no effect on training."""
        known = self.config.to_dict()
        shared = {name: value for name, value in known["train"].items() if name not in ("phases", *CADENCES)}
        config = {"task": self.config.task, "model": known["model"], "train": shared}
        return {"config": json.dumps(config, sort_keys=True), "seed": str(self.seed), "dataset": self.store.content_hash}

    def save(self) -> None:
        """Everything a resume needs, in one atomic file."""
        begun = self.phases[: self.finished + (self.done > 0)]
        metadata = {
            **self._identity(), "phases": json.dumps([phase_to_dict(phase) for phase in begun]), "stage": self.stage,
            "finished": str(self.finished), "done": str(self.done), "step": str(self.step), "seconds": repr(self.seconds),
            "updates": str(self.run.updates), "frozen": str(int(self.frozen is not None)),
        }
        save_state(self.state_path, self._modules(), self._optimizers(), self.run.generator, metadata)

    def resume(self) -> None:
        """Continue from `state.safetensors`; raises CheckpointError when it belongs to another run.

        The phases that have begun must be the first of those asked for. A finished run can so be given more phases, to the
        bits of one that had them from the start.
        """
        state = SavedState(self.state_path)
        state.require(self._identity())
        begun, asked = json.loads(state.metadata["phases"]), [phase_to_dict(phase) for phase in self.phases]
        if begun != asked[: len(begun)]:
            raise CheckpointError(f"{self.state_path} has begun the phases {begun}; expected them to be the first of those "
                                  f"asked for, {asked}. Resume with the same settings, or start a new run elsewhere with "
                                  "--out.")
        number = {name: int(state.metadata[name]) for name in ("finished", "done", "step", "updates", "frozen")}
        state.modules({"model": self.model})
        if number["frozen"]:
            self.frozen = Frozen(self.run)
        self.finished, self.done, self.step = number["finished"], number["done"], number["step"]
        self.learner = self._make_learner(afresh=False) if self.done > 0 else None
        state.modules(self._modules())
        state.optimizers(self._optimizers())
        state.generator(self.run.generator)
        self.run.updates = number["updates"]
        self.seconds, self.stage = float(state.metadata["seconds"]), state.metadata["stage"]

    def finish(self, command: str) -> TrainResult:
        """Measure the latents, keep the bank, write the released form of the model."""
        diagnostics = self.report()
        self.model.eval()
        measure_latents(self.model, self.sampler, make_generator(self.seed, stream=2))
        self.model.success_share.fill_(success_share(self.store))
        if self.model.success_policy is not None:
            measure_arrivals(self.model, self.sampler, make_generator(self.seed, stream=3))
        measure_gap(self.model, self.sampler, self._held_out(), None if self.frozen is None else self.frozen.latents)
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


def train(
    config: Config,
    store: FrameStore,
    run_dir: Path,
    *,
    seed: int = 0,
    device: str = "auto",
    resume: bool = False,
    command: str = "velap.train",
    loggers: Sequence[str | Logger] = DEFAULT,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> TrainResult:
    """Train to the end. Ctrl-C and the signals of `velap.signals` save the state and raise KeyboardInterrupt; `resume` goes
    on from there, to the same bits on CPU. Their handlers are restored on return; outside the main thread they are not
    touched.

    `loggers` are names (`jsonl`, `tensorboard`, `wandb`) or objects with `log` and `close`.

    Raises CheckpointError when `run_dir` holds another run, or an unfinished one and `resume` is off; StorageError when
    another process trains there.
    """
    run_dir = Path(run_dir)
    with only_writer(run_dir, "a training"):
        return _train(Trainer(config, store, run_dir, seed, pick_device(device)), resume, command, loggers, on_progress)


def _train(trainer: Trainer, resume: bool, command: str, loggers: Sequence[str | Logger],
           on_progress: Callable[[Progress], None]) -> TrainResult:
    """From the start or the saved state to the end."""
    run_dir = trainer.run_dir
    resumed = None
    if (run_dir / STATE).exists():
        if not resume:
            raise CheckpointError(f"{run_dir} already holds a run. Add --resume to go on with it, or give another --out.")
        trainer.resume()
        resumed = trainer.step
    write_atomic(run_dir / "config.json", trainer.config.to_json().encode())
    with interrupt_flag() as interrupted:
        run_steps(trainer, make_loggers(loggers, run_dir, "", resumed), on_progress, interrupted)
    trainer.save()
    if trainer.step < trainer.total:
        raise KeyboardInterrupt
    return trainer.finish(command)


def pick_device(device: str) -> torch.device:
    """`auto` takes CUDA where it is found, else the CPU; raises ConfigError for a device that is not here."""
    if device == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        found = torch.device(device)
    except RuntimeError as error:
        raise ConfigError(f"unknown device {device!r}; expected auto, cpu or cuda.") from error
    if found.type not in ("cpu", "cuda"):
        raise ConfigError(f"device {device!r} is not supported; expected auto, cpu or cuda.")
    if found.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError(f"device {device!r} was asked for and PyTorch finds no CUDA here. Use --device auto or cpu.")
    return found
