"""`velap collect`, `velap train` and `velap run`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from tyro.conf import Positional

from velap.cli.options import (
    OUT,
    Device,
    ImageKey,
    Method,
    Preset,
    Records,
    Settings,
    StateKey,
    Task,
    command,
    joined,
    note,
    say,
)
from velap.cli.settings import parse_settings
from velap.errors import ConfigError
from velap.storage import OWN_RECORDS


def collect(task: Task, seed: int = 0, workers: int | None = None, dataset_id: str | None = None,
            overwrite: bool = False) -> None:
    """Collect the dataset of a task (Table 10) as a Minari dataset.

    Args:
        seed: Decides every array, whatever the number of workers.
        workers: Processes. Default: one per core.
        dataset_id: Minari id to write. Default: the task's own.
        overwrite: Replace a dataset of that id.
    """
    from velap.data.collection import collect as run
    from velap.evaluation.console import ProgressBar
    from velap.tasks import get_task

    recipe = get_task(task).recipe
    with ProgressBar(OUT, f"collecting {task}", recipe.contexts * recipe.trajectories) as view:
        result = run(task, seed, workers, dataset_id, overwrite, progress=lambda done, _: view.show(done), command=command())
    for text in result.notes:
        note(text)
    say(result.card)
    say(f"dataset {result.dataset_id} in {result.path}, {result.seconds:.0f} s\ncontent hash {result.content_hash}")


def train(task: Positional[str | None] = None, dataset: str | None = None, image_key: ImageKey = (),
          preset: Preset = "default", seed: int = 0, out: Path | None = None, device: Device = "auto", resume: bool = False,
          settings: Settings = (), method: Method = "velap", success: str | None = None,
          fit: Literal["crop", "pad", "squash"] | None = None, image_size: int = 64, mapped: bool = False,
          state_key: StateKey = (),
          loggers: tuple[Literal["jsonl", "tensorboard", "wandb"], ...] = ("jsonl", "tensorboard")) -> None:
    """Train on a task's dataset or on any dataset of images and continuous actions.

    All methods share the joint training; it is done first where its checkpoint is missing. BC, IQL and IRIS then learn on
    its latents (`--set head.steps=5000` changes how) and go on by themselves after an interruption.

    Args:
        task: Task name; leave it out with --dataset.
        dataset: Minari dataset id, or path of a dataset in another format (LeRobot, robomimic, OGBench).
        seed: Decides weights and batches.
        out: Run directory. Default: runs/TASK/PRESET/seedSEED.
        resume: Go on with the unfinished run in the run directory.
        success: What counts as success, such as `reward>=0`, `info:success`, `terminated` or `labels:answers.csv`. Default:
            found in the data.
        fit: How images that are not square become square.
        image_size: Side that images are resized to [px].
        mapped: Map the frames from a file beside the dataset instead of reading them into memory.
        loggers: Where losses go; `--loggers` alone writes none.
    """
    if (task is None) == (dataset is None):
        raise ConfigError(f"got the task {task!r} and the dataset {dataset!r}; expected one of them: `velap train TASK` or "
                          "`velap train --dataset ID`.")
    if task is not None:
        from velap.tasks import get_task

        get_task(task)
    train_with_progress(str(task or dataset), preset=preset, seed=seed, out=out, image_key=joined(image_key), device=device,
                        resume=resume, settings=settings, method=method, loggers=loggers,
                        reading={"success": success, "fit": fit, "image_size": image_size, "mapped": mapped or None,
                                 "state_key": joined(state_key)})


def train_with_progress(source: str, *, preset: str, seed: int, out: Path | None, device: str, resume: bool,
                        settings: Sequence[Sequence[str]], image_key: str | None = None, method: str = "velap",
                        loggers: Sequence[str] = ("jsonl", "tensorboard"), reading: Mapping[str, Any] | None = None) -> Path:
    """Train and show how far it is; returns the joint checkpoint."""
    from velap import api
    from velap.cli.memory import keep_freed_memory
    from velap.evaluation.console import TrainingBar
    from velap.methods.base import get_method
    from velap.methods.heads import head_path
    from velap.methods.learning import read_result
    from velap.training.loop import MODEL

    keep_freed_memory()
    kind = get_method(method)
    changes = parse_settings(settings, {"head": kind.learner_config(preset)} if kind.learns else {})
    directory = out or api.run_dir(api.task_of(source), preset, seed)
    if kind.learns and not (directory / MODEL).exists():
        note(f"no joint checkpoint in {directory}; it is trained first")
    with TrainingBar(OUT) as view:
        checkpoint = api.train(source, preset=preset, seed=seed, out=out, method=method, image_key=image_key, device=device,
                               resume=resume, changes=changes, command=command(), loggers=loggers, on_progress=view,
                               **(reading or {}))
    say(f"checkpoint {checkpoint}")
    if kind.learns:
        result = read_result(head_path(checkpoint, method))
        losses = ", ".join(f"{name} {value:.3g}" for name, value in result.diagnostics.items())
        say(f"head {result.path}: {result.steps} updates in {result.seconds:.0f} s; {losses}")
    return checkpoint


def run(task: Task, preset: Preset = "default", seed: int = 0, episodes: int = 100, out: Path | None = None,
        records: Records = OWN_RECORDS, fresh: bool = False, workers: int | None = None, device: Device = "auto",
        settings: Settings = ()) -> None:
    """Collect (if the dataset is missing), train and evaluate in one go; repeat the command to go on where it stopped.

    Args:
        seed: Decides weights and batches.
        episodes: Test episodes, seeds from 0.
        out: Run directory. Default: runs/TASK/PRESET/seedSEED.
        fresh: Move an existing record file aside first.
        workers: Processes that collect. Default: one per core.
    """
    from velap.api import config_for
    from velap.cli.evaluate import evaluate_with_progress
    from velap.data import minari_io
    from velap.evaluation.evaluate import Evaluation
    from velap.evaluation.records import check_config, record_path
    from velap.tasks import get_task

    dataset_id = get_task(task).dataset_id
    if not fresh:
        config = config_for(task, preset, parse_settings(settings))
        check_config(record_path(records, task, "velap", preset, seed), config.hash())
    if not minari_io.exists(dataset_id):
        collect(task, workers=workers)
    checkpoint = train_with_progress(task, preset=preset, seed=seed, out=out, device=device, resume=True, settings=settings)
    evaluate_with_progress(Evaluation(task, checkpoint=checkpoint, device=device), range(episodes), records, fresh=fresh)
