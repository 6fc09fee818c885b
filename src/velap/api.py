"""The Python interface: what the command line does, in five lines.

    dataset = velap.make_dataset("SpiralMaze", seed=0)
    checkpoint = velap.train(dataset, seed=0)
    agent = velap.load(checkpoint)
    action = agent.act(frames)          # uint8 [B, N, H, W, 3] -> float32 [B, A]
    print(velap.evaluate("SpiralMaze", checkpoint, episodes=100).success_rate)

The same with objects instead of names:

    store = velap.FrameStore.from_episodes(episodes, action_low=-1, action_high=1)
    checkpoint = velap.train(velap.make_config("my-robot"), store, out="runs/my-robot", loggers=["jsonl"])
    model = velap.LatentModel.from_pretrained(checkpoint)
    print(velap.evaluate(velap.load(checkpoint), env="my_package:Robot-v0", episodes=20).success_rate)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np

from velap.config import Config, override
from velap.config.training import DYNAMICS_HORIZON
from velap.errors import ConfigError
from velap.storage import OWN_RECORDS, run_dir
from velap.tasks import TASKS, get_task, make_config, task_of

if TYPE_CHECKING:
    from velap.data.frames import FrameStore
    from velap.data.images import Fit
    from velap.data.success import Predicate
    from velap.evaluation.evaluate import MakeEnv
    from velap.evaluation.summary import Summary
    from velap.methods.base import Agent
    from velap.training.loggers import Logger
    from velap.training.steps import Progress

Changes = Mapping[str, Mapping[str, Any]]
"""Config fields to replace: `{"train": {"joint": {"steps": 2000}}}`."""


def config_for(task: str, preset: str, changes: Changes | None) -> Config:
    """The preset's config of a task or foreign dataset with `changes` applied."""
    return override(make_config(task, preset), **(changes or {}))


def make_dataset(task: str, seed: int = 0, *, workers: int | None = None, overwrite: bool = False) -> str:
    """Collect the dataset of a task (Table 10), unless it is there already, and return its Minari id.

    Args:
        task: name from `velap.tasks.TASKS`.
        seed: decides every array, whatever the number of workers; a dataset of another seed has to be overwritten.
        workers: processes; None takes one a core.
        overwrite: collect again and replace a dataset of that id.
    """
    from velap.data import minari_io
    from velap.data.collection import collect

    dataset_id = get_task(task).dataset_id
    if minari_io.exists(dataset_id) and not overwrite:
        plan = minari_io.velap_metadata(minari_io.read_metadata(dataset_id)).get("plan", {})
        if (plan.get("task"), plan.get("seed")) == (task, seed):
            return dataset_id
    return collect(get_task(task), seed=seed, workers=workers, overwrite=overwrite).dataset_id


def train(source: str | Path | Config, data: str | Path | FrameStore | None = None, *, preset: str = "default",
          seed: int = 0, out: Path | str | None = None, method: str = "velap", image_key: str | None = None,
          device: str = "auto", resume: bool = False, changes: Changes | None = None, fit: Fit | None = None,
          image_size: int = 64, success: str | Predicate | None = None, mapped: bool | None = None,
          state_key: str | None = None, command: str = "velap.train",
          loggers: Sequence[str | Logger] = ("jsonl", "tensorboard"),
          on_progress: Callable[[Progress], None] = lambda progress: None) -> Path:
    """Train on a task's dataset, or on any dataset of images and continuous actions; returns the joint checkpoint.

    All methods share the joint training, which is done first where its checkpoint is missing. What BC, IQL and IRIS learn on
    its latents lies beside it as `<method>.safetensors`, where `load` and `evaluate` find it.

    Args:
        source: a config; or the name of a task, the path of a dataset or its id, which then has the preset's config.
        data: with a config, the frames, or the path or id of their dataset.
        preset: `default` or `paper`; a config has its own.
        seed: decides weights and batches.
        out: run directory; None takes `runs/<task>/<preset>/seed<seed>`.
        method: a name in `velap.registry.METHODS`.
        image_key: key of the image in dict observations; `a,b` puts two cameras side by side.
        fit: how oblong images become square: `crop`, `pad` or `squash`.
        image_size: side that images are resized to [px].
        success: what success is, a rule of `velap.data.success`; None finds one.
        mapped: map the frames from a file beside the dataset; None does so where they would fill the memory.
        device: `auto`, `cpu` or `cuda`.
        resume: go on with the joint run in `out`; a finished one is left as it is. Heads always go on.
        changes: config fields to replace; under `head` those of the method's learner.
        state_key: key of numbers beside the image, such as joint angles; `a,b` of several. They stand behind φ's output.
        command: kept in the checkpoint as its origin.
        loggers: names (`jsonl`, `tensorboard`, `wandb`) or objects with `log` and `close`.
        on_progress: called after every logged step.
    """
    from velap.data.frames import FrameStore
    from velap.data.loading import load_store
    from velap.methods.base import get_method
    from velap.methods.learning import check_trainable, train_head
    from velap.training.loop import MODEL
    from velap.training.loop import train as run

    check_trainable(method)
    changes = dict(changes or {})
    of_head = changes.pop("head", {})
    config, data = _asked_for(_text(source), _text(data), preset, changes)
    kind = get_method(method)
    learner = kind.learner_config(config.preset, of_head) if kind.learns or of_head else None
    if isinstance(data, FrameStore):
        _refuse_with_frames(image_key=image_key, fit=fit, success=success, mapped=mapped, state_key=state_key)
        store = data
    else:
        store = load_store(data, image_key, DYNAMICS_HORIZON, image_size, fit=fit, success=success, mapped=mapped,
                           state_key=state_key)
    directory = Path(out) if out is not None else run_dir(config.task, config.preset, seed)
    checkpoint = directory / MODEL
    if not kind.whole_checkpoint and checkpoint.exists():
        _check_origin(checkpoint, config, seed, changes, store)
    elif not (resume and _is_finished(checkpoint, config, seed, store.content_hash)):
        run(config, store, directory, seed=seed, device=device, resume=resume, command=command, loggers=loggers,
            on_progress=on_progress)
    if learner is not None:
        train_head(method, checkpoint, store, config=learner, device=device, command=command, loggers=loggers,
                   on_progress=on_progress)
    return checkpoint


def _text(source: Any) -> Any:
    """A path as the text that names a dataset; everything else as it is."""
    return str(source) if isinstance(source, Path) else source


def _asked_for(source: str | Config, data: str | FrameStore | None, preset: str,
               changes: Changes) -> tuple[Config, str | FrameStore]:
    """The config with `changes`, and the frames or the id of their dataset; raises ConfigError where one of them is missing
    or named twice."""
    if isinstance(source, Config):
        if data is None:
            raise ConfigError("got a config and no data; expected a FrameStore, or the path or id of a dataset. Call "
                              "velap.train(config, data).")
        return override(source, **changes), data
    if data is not None:
        raise ConfigError(f"got the data {source!r} and other data beside them; expected one of them, or a config first: "
                          "velap.train(velap.make_config(...), data).")
    return config_for(task_of(source), preset, changes), TASKS[source].dataset_id if source in TASKS else source


def _refuse_with_frames(**options: Any) -> None:
    """Raises ConfigError where something is said about reading data that are read already."""
    said = [name for name, value in options.items() if value is not None]
    if said:
        raise ConfigError(f"got a FrameStore and {', '.join(said)}; expected them where the store is made: "
                          "FrameStore.from_episodes or velap.data.loading.load_store.")


def _check_origin(checkpoint: Path, asked_for: Config, seed: int, changes: Changes, store: FrameStore) -> None:
    """Raises ConfigError unless a joint checkpoint comes from this task, preset, seed and these frames, and has the
    fields of `changes`."""
    from velap.data.frames import Reading
    from velap.models.checkpoint import load_checkpoint

    _, config, metadata = load_checkpoint(checkpoint)
    found, asked = (config.task, config.preset, int(metadata["seed"])), (asked_for.task, asked_for.preset, seed)
    if found != asked:
        raise ConfigError(f"{checkpoint} has task, preset and seed {found}; expected {asked}. Name its own with "
                          "--preset and --seed, or another run directory with --out.")
    if metadata["dataset_hash"] != store.content_hash:
        was, now = Reading.from_json(metadata["reading"]) if "reading" in metadata else None, store.reading
        raise ConfigError(f"{checkpoint} learnt from the data {metadata['dataset_hash'][:12]}, read by {was}; the data are "
                          f"{store.content_hash[:12]} now, read by {now}; expected the same: heads learn beside it. Give "
                          "the same dataset, camera and success rule, or another run directory with --out.")
    if override(config, **changes) != config:
        names = [f"{part}.{name}" for part, fields in changes.items() for name in fields]
        raise ConfigError(f"{checkpoint} was trained with other values of some of {', '.join(names)}; expected those "
                          "asked for. Leave them out, or train a joint model with them elsewhere with --out.")


def _is_finished(checkpoint: Path, config: Config, seed: int, dataset_hash: str) -> bool:
    """Whether the checkpoint is there and is what this run would give; a resume then leaves it, and its records, alone."""
    from velap.models.checkpoint import load_checkpoint

    if not checkpoint.exists():
        return False
    _, saved, metadata = load_checkpoint(checkpoint)
    return saved == config and metadata["seed"] == str(seed) and metadata["dataset_hash"] == dataset_hash


def load(checkpoint: Path | str, method: str = "velap", device: str = "auto", head: Path | str | None = None, *,
         changes: Changes | None = None) -> Agent:
    """An agent that acts by a checkpoint: `reset(mask, seeds)` at the start of episodes, then `act(frames)`.

    Args:
        checkpoint: `model.safetensors` of a run.
        method: a name in `velap.registry.METHODS`, such as `velap`, or `td3bc` for π^g alone.
        device: `auto`, `cpu` or `cuda`.
        head: what the method learnt; None looks for `<method>.safetensors` beside the checkpoint where it needs one.
        changes: fields of the checkpoint's config to replace, `{"planner": {"n_iter": 500}}`, or of the method's own
            settings, `{"mppi": {"temperature": 1.0}}`.
    """
    from velap.evaluation.evaluate import Evaluation, load_method
    from velap.methods.base import get_method, make_agent

    by_model = get_method(method).needs_model  # one that needs no model takes the bounds of its actions alone
    loaded = load_method(Evaluation("", method=method if by_model else "velap", checkpoint=Path(checkpoint), device=device,
                                    changes=changes, head=None if head is None else Path(head)))
    assert loaded.model is not None
    low, high = np.array([loaded.model.spaces.action_low, loaded.model.spaces.action_high], np.float32)
    return make_agent(method, loaded.model, loaded.config, gym.spaces.Box(low, high, dtype=np.float32), loaded.head,
                      loaded.settings if by_model else None)


def evaluate(task: str | Agent, checkpoint: Path | str | None = None, *, method: str = "velap", episodes: int = 100,
             first_seed: int = 0, env: str | MakeEnv | None = None, env_kwargs: Mapping[str, Any] | None = None,
             image_key: str | None = None, max_steps: int | None = None, success: str | Predicate | None = None,
             records: Path | str = OWN_RECORDS, fresh: bool = False, batch: int = 10, device: str = "auto",
             head: Path | str | None = None, changes: Changes | None = None, state_key: str | None = None,
             image_size: int = 64) -> Summary:
    """Success rate and more over seeded test episodes; goes on where an earlier call with the same records stopped.

    Args:
        task: task name; with `env`, any label. Or an agent: its episodes are then summarised and not recorded, and of the
            arguments below only those of episodes and environment count.
        checkpoint: `model.safetensors` of a run; `random` needs none.
        method: a name in `velap.registry.METHODS`.
        episodes: number of episodes.
        first_seed: seed of the first one; test seeds are 0 to 99.
        env: any Gymnasium id instead of the task's own environment; with an agent, also a function that makes one.
        env_kwargs: arguments of `gymnasium.make` besides the id.
        image_key: key of the image in dict observations, `a,b` of two cameras; None takes the checkpoint's, where the
            environment has it.
        max_steps: time limit where the environment has none, or a shorter one [steps].
        success: what success is, a rule of `velap.data.success` such as `reward>=0`, or a function (reward, info,
            terminated) → bool of a module; None takes the checkpoint's.
        records: root of the record files.
        fresh: move an existing record file aside first.
        batch: environments at once.
        device: `auto`, `cpu` or `cuda`.
        head: what the method learnt; None looks for `<method>.safetensors` beside the checkpoint where it needs one.
        changes: fields of the checkpoint's config or of the method's own settings to replace, as in `load`.
        state_key: with an agent, key of the numbers beside the image that it takes; a checkpoint keeps its own.
        image_size: with an agent, side of the images that it takes [px].
    """
    from velap.data.building import rule_of
    from velap.evaluation.evaluate import Evaluation, play
    from velap.evaluation.evaluate import evaluate as run
    from velap.evaluation.summary import summarise

    seeds = range(first_seed, first_seed + episodes)
    rule = str(rule_of(success)) if callable(success) else success
    if not isinstance(task, str):
        return summarise(play(task, env, seeds, env_kwargs=env_kwargs, image_key=image_key, max_steps=max_steps,
                              success=rule, batch=batch, state_key=state_key, image_size=image_size))
    if not (env is None or isinstance(env, str)):
        raise ConfigError(f"got the environment {env!r} and records to write; expected a Gymnasium id, which records name. "
                          "Register it with gymnasium.register, or evaluate an agent: "
                          "velap.evaluate(velap.load(checkpoint), env=make_env).")
    if state_key is not None:
        raise ConfigError(f"got the state {state_key!r} and a checkpoint; expected no state: the checkpoint keeps its own. "
                          "Leave state_key out.")
    what = Evaluation(task, method=method, checkpoint=None if checkpoint is None else Path(checkpoint), env=env,
                      env_kwargs=dict(env_kwargs or {}), image_key=image_key, max_steps=max_steps,
                      success=rule, device=device, head=None if head is None else Path(head), changes=changes)
    return summarise(run(what, seeds, Path(records), fresh=fresh, batch=batch))
