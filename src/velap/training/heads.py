"""Training of the heads on frozen latents: one command a method, beside a joint checkpoint.

`<method>.safetensors` is the head, `<method>.metrics.jsonl` its losses, `<method>.state.safetensors` what an interrupted run
goes on from. Heads are derived from the joint checkpoint: one that no longer belongs to it is learnt anew.
"""

from __future__ import annotations

import dataclasses
import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from velap.data.frames import FrameStore
from velap.errors import CheckpointError, ConfigError, DatasetError, TrainingError, UnknownTaskError
from velap.models.heads import AnyHead, head_path, make_head, save_head
from velap.models.velap import load_checkpoint, shared_weights
from velap.runs import MetricsLog, load_tensors, make_generator
from velap.threads import one_thread
from velap.training.bc import PAPER_BC, BCConfig, BCLearner, SuccessBCLearner
from velap.training.frozen import FrozenLearner, LearnerConfig, latent_data
from velap.training.iql import PAPER_IQL, PAPER_SPARSE_IQL, SPARSE_IQL, IQLConfig, IQLLearner
from velap.training.loop import pick_device
from velap.training.state import load_state, save_state
from velap.training.steps import Cadence, Progress, interrupt_flag, run_steps
from velap.training.subgoals import MULTISTEP, PAPER_IRIS, PAPER_MULTISTEP, SubgoalConfig, SubgoalLearner


@dataclass(frozen=True)
class Recipe:
    """How the head of a method is learnt."""

    learner: type[FrozenLearner[Any, Any]]
    default: LearnerConfig
    paper: LearnerConfig


RECIPES: dict[str, Recipe] = {
    "bc": Recipe(BCLearner, BCConfig(), PAPER_BC),
    "bc-success": Recipe(SuccessBCLearner, BCConfig(), PAPER_BC),
    "iql": Recipe(IQLLearner, IQLConfig(), PAPER_IQL),
    "iql-sparse": Recipe(IQLLearner, SPARSE_IQL, PAPER_SPARSE_IQL),
    "iris": Recipe(SubgoalLearner, SubgoalConfig(), PAPER_IRIS),
    "iris-multistep": Recipe(SubgoalLearner, MULTISTEP, PAPER_MULTISTEP),
}
"""One recipe for each entry of `velap.models.heads.HEADS`."""

CADENCE = Cadence(log=100, diagnose=1_000, checkpoint=5_000)
"""ours."""


@dataclass(frozen=True)
class HeadResult:
    """Outcome of one training of a head."""

    path: Path
    steps: int
    """Updates."""
    seconds: float
    """Training time, all sittings [s]."""
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

    @property
    def events_dir(self) -> Path:
        """A run of its own in the joint run's TensorBoard folder."""
        return self.path.parent / "tensorboard" / self.path.stem

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
        save_state(self.state_path, self.learner, self.identity | progress)

    def resume(self) -> int | None:
        """Go on from the state that an interrupted run left; None where there is none, or one of another run (a note says
        so)."""
        if not self.state_path.exists():
            return None
        try:
            metadata = load_state(self.state_path, self.learner, self.identity)
        except CheckpointError as error:
            warnings.warn(f"the head is learnt from the start: {error}", UserWarning, stacklevel=3)
            return None
        self.step, self.seconds = int(metadata["step"]), float(metadata["seconds"])
        return self.step


JOINT_METHODS = ("velap", "td3bc", "mppi", "mbop")
"""Methods that act by the joint checkpoint and learn nothing more."""


def check_trainable(method: str) -> None:
    """Raises UnknownTaskError unless there is something to train for that method."""
    known = (*JOINT_METHODS, *RECIPES)
    if method not in known:
        raise UnknownTaskError(f"cannot train the method {method!r}; expected one of {', '.join(known)}. `random` has "
                               "nothing to learn.")


def recipe_of(method: str) -> Recipe:
    """The recipe of that method; raises UnknownTaskError for a method without a learner of its own."""
    if method not in RECIPES:
        raise UnknownTaskError(f"the method {method!r} has no learner of its own; expected one of {', '.join(RECIPES)}. The "
                               "others act by the joint checkpoint alone: `velap train TASK`.")
    return RECIPES[method]


def learner_config(method: str, preset: str, changes: Mapping[str, Any] | None = None) -> LearnerConfig:
    """Config of a method's learner in a preset, with the fields of `changes` replaced."""
    recipe = recipe_of(method)
    config = recipe.paper if preset == "paper" else recipe.default
    names = [field.name for field in dataclasses.fields(config)]
    unknown = sorted(set(changes or {}) - set(names))
    if unknown:
        raise ConfigError(f"the learner of {method!r} has no field {unknown}; expected some of {names}.")
    return dataclasses.replace(config, **(changes or {}))


def train_head(method: str, checkpoint: Path | str, store: FrameStore, out: Path | None = None, *, seed: int | None = None,
               device: str = "auto", steps: int | None = None, config: LearnerConfig | None = None,
               command: str = "velap.train", on_progress: Callable[[Progress], None] = lambda progress: None) -> HeadResult:
    """Learn the head of a method on the latents of a joint checkpoint; a finished one is left as it is.

    Ctrl-C saves the state and raises KeyboardInterrupt; the same call goes on from there, to the same bits on a CPU.

    Args:
        method: one of `velap.models.heads.HEADS`.
        checkpoint: `model.safetensors` of the joint training.
        store: the dataset that the checkpoint was trained on.
        out: the head's file; None takes `<method>.safetensors` beside the checkpoint.
        seed: decides weights and batches; None takes the checkpoint's.
        device: `auto`, `cpu` or `cuda`.
        steps: updates in place of the preset's.
        config: the learner's config in place of the preset's.
        command: kept in the head as its origin.
        on_progress: called after every logged step.
    """
    recipe_of(method)
    checkpoint, place = Path(checkpoint), pick_device(device)
    model, joint, metadata = load_checkpoint(checkpoint, place)
    config = config or learner_config(method, joint.preset, {} if steps is None else {"steps": steps})
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
        head = make_head(method, joint.model, model.action_dim).to(place).train()
    head.settings = config.to_json()
    data = latent_data(model, joint, metadata, store, checkpoint.parent)
    learner = recipe_of(method).learner(head, data, config, make_generator(seed, stream=3, device=place))
    run = HeadRun(learner, path, identity)
    _run(run, on_progress)
    return _finish(run, head, metadata, {"command": command, "dataset_id": store.dataset_id})


def read_result(path: Path) -> HeadResult:
    """The outcome that a head's file tells of."""
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


def _run(run: HeadRun, on_progress: Callable[[Progress], None]) -> None:
    """From the start or the saved state to the end; raises KeyboardInterrupt after Ctrl-C, the state being saved."""
    log = MetricsLog(run.path.with_suffix(".metrics.jsonl"), run.resume())
    with interrupt_flag() as interrupted, one_thread(run.learner.data.latents.device, small=True):
        run_steps(run, log, on_progress, interrupted)
    if run.step < run.total:
        run.save()
        raise KeyboardInterrupt


def _finish(run: HeadRun, head: AnyHead, joint_metadata: dict[str, str], origin: dict[str, str]) -> HeadResult:
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
