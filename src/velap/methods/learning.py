"""Training of the heads on frozen latents: one command a method, beside a joint checkpoint.

`<method>.safetensors` is the head, `<method>.metrics.jsonl` its losses, `<method>.state.safetensors` what an interrupted run
goes on from. Heads depend on the joint checkpoint: a head of another checkpoint is learnt anew.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from velap.data.frames import FrameStore
from velap.errors import CheckpointError, DatasetError, TrainingError, UnknownTaskError
from velap.methods.base import get_method
from velap.methods.heads import Head, head_path, make_head, save_head
from velap.models.checkpoint import load_checkpoint, shared_weights
from velap.runs import load_tensors, make_generator, only_writer
from velap.threads import one_thread
from velap.training.frozen import FrozenLearner, LearnerConfig, latent_data
from velap.training.loggers import DEFAULT, Logger, make_loggers
from velap.training.loop import pick_device
from velap.training.state import SavedState, save_state
from velap.training.steps import Cadence, Progress, interrupt_flag, run_steps

CADENCE = Cadence(log=100, diagnose=1_000, checkpoint=5_000)
"""ours."""


@dataclass(frozen=True)
class HeadResult:
    """Outcome of one training of a head."""

    path: Path
    steps: int
    """Updates."""
    seconds: float
    """Training time, summed over interruptions [s]."""
    diagnostics: dict[str, float]
    """Held-out losses at the end."""


class HeadRun:
    """One training of a head, driven by `run_steps`."""

    def __init__(self, learner: FrozenLearner[Any, Any], path: Path, identity: dict[str, str]) -> None:
        self.learner, self.path, self.identity = learner, path, identity
        self.step, self.seconds = 0, 0.0

    @property
    def total(self) -> int:
        """Updates of the whole run [steps]."""
        return self.learner.total

    @property
    def phase(self) -> str:
        """The method."""
        return self.identity["method"]

    @property
    def cadence(self) -> Cadence:
        """The same for all heads."""
        return CADENCE

    @property
    def state_path(self) -> Path:
        """Beside the head."""
        return self.path.with_suffix(".state.safetensors")

    def update(self) -> dict[str, Tensor]:
        """One update of the learner."""
        info = self.learner.update()
        self.step += 1
        return info

    def report(self) -> dict[str, float]:
        """Held-out losses."""
        return self.learner.report()

    def save(self) -> None:
        """Everything a resume needs."""
        progress = {"step": str(self.step), "seconds": repr(self.seconds)}
        learner = self.learner
        save_state(self.state_path, self._modules(), learner.optimizers, learner.generator, self.identity | progress)

    def _modules(self) -> dict[str, nn.Module]:
        return {"head": self.learner.model, **self.learner.companions}

    def resume(self) -> int | None:
        """Go on from the state that an interrupted run left; None where there is none, or one of another run (a note says
        so)."""
        if not self.state_path.exists():
            return None
        try:
            state = SavedState(self.state_path)
            state.require(self.identity)
        except CheckpointError as error:
            warnings.warn(f"the head is learnt from the start: {error}", UserWarning, stacklevel=3)
            return None
        state.modules(self._modules())
        state.optimizers(self.learner.optimizers)
        state.generator(self.learner.generator)
        self.step, self.seconds = int(state.metadata["step"]), float(state.metadata["seconds"])
        self.learner.updates = self.step
        return self.step


def check_trainable(method: str) -> None:
    """Raises UnknownTaskError unless there is something to train for that method."""
    if not get_method(method).needs_model:
        raise UnknownTaskError(f"cannot train the method {method!r}: it has nothing to learn; expected one that acts by a "
                               "trained model.")


def train_head(method: str, checkpoint: Path | str, store: FrameStore, out: Path | None = None, *, seed: int | None = None,
               device: str = "auto", steps: int | None = None, config: LearnerConfig | None = None,
               command: str = "velap.train", loggers: Sequence[str | Logger] = DEFAULT,
               on_progress: Callable[[Progress], None] = lambda progress: None) -> HeadResult:
    """Learn the head of a method on the latents of a joint checkpoint; a finished one is left as it is.

    Ctrl-C and the signals of `velap.signals` save the state and raise KeyboardInterrupt; the same call goes on from
    there, to the same bits on a CPU.

    Args:
        method: a registered method with a head.
        checkpoint: `model.safetensors` of the joint training.
        store: the dataset that the checkpoint was trained on.
        out: the head's file; None takes `<method>.safetensors` beside the checkpoint.
        seed: decides weights and batches; None takes the checkpoint's.
        device: `auto`, `cpu` or `cuda`.
        steps: updates in place of the preset's.
        config: the learner's config in place of the preset's.
        command: kept in the head as its origin.
        loggers: as in `velap.training.loop.train`.
        on_progress: called after every logged step.
    """
    kind = get_method(method)
    if kind.learner is None:
        raise kind.nothing_to_learn()
    checkpoint, place = Path(checkpoint), pick_device(device)
    model, joint, metadata = load_checkpoint(checkpoint, place)
    config = config or kind.learner_config(joint.preset, {} if steps is None else {"steps": steps})
    trained_on = metadata.get("dataset_hash", store.content_hash)
    if trained_on != store.content_hash:
        raise DatasetError(f"{checkpoint} was trained on a dataset with hash {trained_on[:12]}, {store.dataset_id} has "
                           f"{store.content_hash[:12]}; a head learns from the data of its joint checkpoint. Give that "
                           "dataset, or train the joint model again.")
    seed = int(metadata.get("seed", 0)) if seed is None else seed
    path = Path(out) if out is not None else head_path(checkpoint, method)
    identity = {"method": method, "head_config": config.to_json(), "joint": shared_weights(metadata), "seed": str(seed),
                "dataset_hash": store.content_hash}
    finished = _finished(path, identity)
    if finished is not None:
        return finished
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        head = make_head(method, joint.model, model.action_dim, model.spaces.state_dim).to(place).train()
    head.settings = config.to_json()
    data = latent_data(model, joint, metadata, store, checkpoint.parent)
    learner = kind.learner(head, data, config, make_generator(seed, stream=3, device=place))
    run = HeadRun(learner, path, identity)
    with only_writer(path.parent, path.stem):
        _run(run, loggers, on_progress)
        return _finish(run, head, metadata, {"command": command, "dataset_id": store.dataset_id})


def read_result(path: Path) -> HeadResult:
    """The result of the training of a head's file."""
    return _result(path, load_tensors(path)[1])


def _result(path: Path, metadata: Mapping[str, str]) -> HeadResult:
    return HeadResult(path, int(metadata["steps"]), float(metadata["train_seconds"]), json.loads(metadata["diagnostics"]))


def _finished(path: Path, identity: dict[str, str]) -> HeadResult | None:
    """The result in `path` if it is what this run would give; a note where another one is about to be replaced."""
    if not path.exists():
        return None
    try:
        _, metadata = load_tensors(path)
    except CheckpointError as error:
        warnings.warn(f"the head is learnt anew: {error}", UserWarning, stacklevel=3)
        return None
    other = [key for key, value in identity.items() if metadata.get(key) != value]
    if other:
        warnings.warn(f"{path} was learnt with another {', '.join(other)} and is replaced", UserWarning, stacklevel=3)
        return None
    return _result(path, metadata)


def _run(run: HeadRun, loggers: Sequence[str | Logger], on_progress: Callable[[Progress], None]) -> None:
    """From the start or the saved state to the end; raises KeyboardInterrupt once an interrupted state is saved."""
    made = make_loggers(loggers, run.path.parent, run.path.stem, run.resume())
    with interrupt_flag() as interrupted, one_thread(run.learner.data.latents.device, small=True):
        run_steps(run, made, on_progress, interrupted)
    if run.step < run.total:
        run.save()
        raise KeyboardInterrupt


def _finish(run: HeadRun, head: Head, joint_metadata: dict[str, str], origin: dict[str, str]) -> HeadResult:
    """Write the head and drop the state."""
    broken = sorted(name for name, value in head.state_dict().items() if not bool(torch.isfinite(value).all()))
    if broken:
        raise TrainingError(f"{', '.join(broken)} of the head {run.phase} became NaN or infinite; nothing was written. "
                            "Check the data for bad actions, or lower the learning rate.")
    diagnostics = run.report()
    provenance = {**origin, **run.identity, "train_seconds": f"{run.seconds:.1f}", "steps": str(run.step),
                  "diagnostics": json.dumps(diagnostics)}
    save_head(run.path, head, joint_metadata, provenance)
    run.state_path.unlink(missing_ok=True)
    return read_result(run.path)
