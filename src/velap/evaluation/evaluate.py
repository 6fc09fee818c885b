"""Evaluation: checkpoint and method -> seeded episodes -> records -> summary."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch

import velap.envs  # noqa: F401 - registers the tasks
from velap._version import __version__
from velap.config import Config
from velap.data.frames import Reading
from velap.data.images import IMAGE_SIZE, known_key
from velap.data.success import Success
from velap.errors import ConfigError, UnknownTaskError
from velap.evaluation.records import Record, RecordFile, RunKey, select
from velap.evaluation.rollout import Episode, FrameReader, Observer, Rollout, make_envs
from velap.methods.base import Agent, get_method, learning_methods, make_agent
from velap.methods.heads import Head, head_path, load_head
from velap.models.checkpoint import WEIGHTS_SHA256, load_checkpoint, released_checkpoint, shared_weights
from velap.models.velap import LatentModel
from velap.tasks import TASKS, get_task, make_config

MakeEnv = Callable[..., gym.Env[Any, Any]]
"""A function of the keyword arguments `env_kwargs` that makes an environment."""
BATCH = 10
"""Environments that run at once. ours: plans are batched over them, more only cost memory."""


AS_THE_TASKS = Reading()
"""Reading of checkpoints that do not keep one: square images, rewards 0 and 1."""


@dataclass(frozen=True)
class Evaluation:
    """Method, checkpoint and environment of an evaluation."""

    task: str
    """Task name; with `env`, any label."""
    _: KW_ONLY
    method: str = "velap"
    checkpoint: Path | None = None
    """`model.safetensors` of a run; `random` needs none."""
    preset: str = "default"
    """Preset of a method without a checkpoint; a checkpoint has its own."""
    env: str | None = None
    """Any Gymnasium id, `module:Env-v0` included, instead of the task's own."""
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    """Arguments of `gymnasium.make` besides the id."""
    image_key: str | None = None
    """Key of the image in dict observations; None: the checkpoint's, if the environment has it."""
    max_steps: int | None = None
    """Time limit, if the environment has none, or a shorter one [steps]."""
    success: str | None = None
    """What counts as success, a rule of `velap.data.success`; None: the checkpoint's."""
    device: str = "auto"
    changes: Mapping[str, Mapping[str, Any]] | None = None
    """Fields of the checkpoint's config to replace, `{"planner": {"n_iter": 500}}`, or of the method's own settings,
    `{"mppi": {"temperature": 1.0}}`."""
    head: Path | None = None
    """File of what the method learnt beside the checkpoint; None: `<method>.safetensors` in the checkpoint's folder."""


@dataclass(frozen=True, kw_only=True)
class Player:
    """A loaded method: its agent, its environments and the identity of its records."""

    agent: Agent
    model: LatentModel | None
    config: Config
    key: RunKey
    make_env: Callable[[], gym.Env[Any, Any]]
    image_size: int
    """Side of the images that the agent takes [px]."""
    reading: Reading = AS_THE_TASKS
    """How the training data were read."""

    @property
    def success(self) -> Success | None:
        """What counts as success; None: the environment's info, else a positive reward."""
        return None if self.key.success_rule is None else Success.parse(self.key.success_rule)

    def frames_of(self, env: gym.Env[Any, Any]) -> FrameReader:
        """The reader of an environment's frames, which squares and resizes them as the training data were."""
        size = 0 if self.model is None else self.model.spaces.state_dim
        return FrameReader(env, self.image_size, self.key.image_key, self.reading.fit, self.reading.state_key, size)

    @property
    def device(self) -> str:
        """`cpu`, or the name of the GPU."""
        if self.model is None:
            return "cpu"
        device = next(self.model.parameters()).device
        return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type

    def episodes(self, seeds: Sequence[int], batch: int = BATCH, observer: Observer | None = None) -> Iterator[Episode]:
        """Run every seed once, up to `batch` at a time; yields episodes in the order of finishing."""
        envs = make_envs(self.make_env, min(batch, len(seeds)))
        try:
            yield from Rollout(envs, self.agent, self.frames_of(envs[0]), reset_options=reset_options(envs[0]),
                               max_steps=self.key.max_steps, success=self.success, observer=observer).run(seeds)
        finally:
            for env in envs:
                env.close()


def reset_options(env: gym.Env[Any, Any]) -> dict[str, Any] | None:
    """Options that make the environment of a task start as in evaluation; None for other environments."""
    ids = {task.env_id.rpartition(":")[2] for task in TASKS.imported.values()}
    return {"split": "test"} if env.spec is not None and env.spec.id in ids else None


def load_player(what: Evaluation) -> Player:
    """Load the checkpoint, make the agent, and check that model, camera and time limit fit the environment."""
    task_env = TASKS[what.task].env_id if what.task in TASKS else None
    env_id = what.env or get_task(what.task).env_id
    method, recorded_kwargs = get_method(what.method), _as_recorded(what.env_kwargs)
    loaded = load_method(what)
    model, config = loaded.model, loaded.config
    if what.env is None and config.task != what.task:
        raise ConfigError(f"{what.checkpoint} was trained on {config.task!r}, not on {what.task!r}; expected "
                          f"the same. Name the task {config.task!r}, or an environment with --env.")
    size = model.spaces.height if model is not None else IMAGE_SIZE
    env = make_env(env_id, what.env_kwargs)
    try:
        agent = make_agent(what.method, model, config, _checked_actions(env, model), loaded.head, loaded.settings)
        image_key = what.image_key or known_key(env.observation_space, loaded.reading.image_key)
        read = FrameReader(env, size, image_key, loaded.reading.fit, loaded.reading.state_key,
                           0 if model is None else model.spaces.state_dim)
        if model is not None and read.size != (size, model.spaces.width):
            got, learnt = image_key or "its only camera", loaded.reading.image_key or "one camera"
            raise ConfigError(f"{env_id} gives frames of {read.size[0]} × {read.size[1]} px ({got}); expected {size} × "
                              f"{model.spaces.width} ({learnt}). Name as many cameras, in the same order, with --image-key.")
        max_steps = _time_limit(env, what.max_steps)
    finally:
        env.close()
    key = RunKey(task=what.task if env_id == task_env else env_id, method=what.method, preset=config.preset,
                 train_seed=loaded.seed, env=env_id, env_kwargs=recorded_kwargs, image_key=image_key,
                 max_steps=max_steps, success_rule=what.success or loaded.reading.success or None,
                 config_hash=method.config_hash(config, loaded.head, loaded.settings), checkpoint=loaded.digest,
                 code_version=code_version())
    return Player(agent=agent, model=model, config=config, key=key, image_size=size, reading=loaded.reading,
                  make_env=lambda: make_env(env_id, what.env_kwargs))


def _as_recorded(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """The environment's arguments as a line of JSON keeps them: tuples become lists."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(dict(env_kwargs)))
    except (TypeError, ValueError) as error:
        raise ConfigError(f"the environment's arguments are {dict(env_kwargs)} ({error}); expected numbers, text, lists and "
                          "dicts, which records can name. Register an environment that makes the others itself, or evaluate "
                          "an agent: velap.evaluate(velap.load(checkpoint), env=...).") from error
    return plain


def _time_limit(env: gym.Env[Any, Any], asked: int | None) -> int:
    """The shorter of the environment's time limit and the requested one [steps]."""
    own = env.spec.max_episode_steps if env.spec is not None else None
    limits = [limit for limit in (own, asked) if limit is not None]
    if not limits or min(limits) < 1:
        raise ConfigError(f"got the time limits {own} (environment) and {asked} (asked for); expected at least one of them, "
                          "of 1 step or more. Give one with --max-steps.")
    return min(limits)


class LoadedMethod(NamedTuple):
    """What a method reads from disk, and its settings."""

    model: LatentModel | None
    config: Config
    seed: int
    """Training seed."""
    digest: str
    """Hash of the weights that the method acts by: VELAP's are all of the checkpoint, other methods share a part."""
    head: Head | None = None
    settings: Any = None
    reading: Reading = AS_THE_TASKS


def load_method(what: Evaluation) -> LoadedMethod:
    """Checkpoint, head and settings of the method, with the requested changes; the preset's config for `random`."""
    from velap.config import override
    from velap.training.loop import pick_device

    method = get_method(what.method)
    if what.head is not None and not method.learns:
        raise ConfigError(f"method {what.method!r} learns no head and got {what.head}; expected one of "
                          f"{', '.join(learning_methods())}. Leave --head out, or name that method.")
    if not method.needs_model:
        return LoadedMethod(None, make_config(what.task, what.preset), 0, "")
    if what.checkpoint is None:
        released = f", such as {released_checkpoint(what.task)}" if what.task in TASKS else ""
        raise ConfigError(f"method {what.method!r} acts by a trained model and got none; name one with --checkpoint"
                          f"{released}, or train one with `velap train {what.task}`.")
    device = pick_device(what.device)
    model, config, metadata = load_checkpoint(what.checkpoint, device)
    changes = dict(what.changes or {})
    settings = method.settings_of(config.preset, changes.pop(what.method, None))
    head = None
    if method.learns:
        head = load_head(what.head or head_path(what.checkpoint, what.method), metadata, device)
    seed = int(metadata.get("seed", 0))
    digest = metadata[WEIGHTS_SHA256] if method.whole_checkpoint else shared_weights(metadata)
    reading = Reading.from_json(metadata["reading"]) if "reading" in metadata else AS_THE_TASKS
    return LoadedMethod(model, override(config, **changes), seed, digest, head, settings, reading)


def make_env(env_id: str | MakeEnv, kwargs: Mapping[str, Any] | None = None) -> gym.Env[Any, Any]:
    """The Gymnasium environment of that id, in the render mode `rgb_array` if it has one; or what the function makes.

    Raises UnknownTaskError when Gymnasium cannot make it, ConfigError when it refuses its arguments.
    """
    kwargs = dict(kwargs or {})
    if not isinstance(env_id, str):
        made = env_id(**kwargs) if callable(env_id) else env_id
        if not callable(env_id) or not isinstance(made, gym.Env):
            raise ConfigError(f"got the environment {made!r}; expected a Gymnasium id, or a function that makes a new "
                              "environment at each call, such as `lambda: MyEnv()`.")
        return made
    try:
        env = gym.make(env_id, **kwargs)
        if env.render_mode is None and "rgb_array" in env.metadata.get("render_modes", ()) and "render_mode" not in kwargs:
            env.close()
            env = gym.make(env_id, render_mode="rgb_array", **kwargs)
        return env
    except (gym.error.Error, ImportError) as error:
        raise UnknownTaskError(f"Gymnasium cannot make {env_id!r}: {error}. Expected a registered id, or `module:Env-v0` "
                               "with a module that registers it.") from error
    except TypeError as error:
        raise ConfigError(f"the environment {env_id!r} cannot be made with the arguments {kwargs}: {error}. Expected "
                          "arguments that it takes; give them with --env-kwargs NAME=VALUE.") from error


def _checked_actions(env: gym.Env[Any, Any], model: LatentModel | None) -> gym.spaces.Box:
    """The environment's action space; raises ConfigError when the model acts in another one."""
    space = env.action_space
    if not isinstance(space, gym.spaces.Box) or len(space.shape) != 1:
        raise ConfigError(f"the environment's action space is {space}; expected a one-dimensional Box.")
    if model is not None:
        low, high = np.array(model.spaces.action_low), np.array(model.spaces.action_high)
        if low.shape != space.shape or (low < space.low - 1e-6).any() or (high > space.high + 1e-6).any():
            raise ConfigError(f"the model acts in {low.tolist()} to {high.tolist()}, the environment takes {space}; "
                              "expected the same space. Evaluate the checkpoint on the environment that its data come from.")
    return space


def evaluate(what: Evaluation, seeds: range, records: Path, *, batch: int = BATCH, fresh: bool = False,
             on_record: Callable[[Record], None] = lambda record: None,
             player: Player | None = None) -> list[Record]:
    """Run every seed without a record and return the records of all `seeds`, in their order.

    Args:
        what: method, checkpoint and environment.
        seeds: episode seeds; test seeds are 0 to 99.
        records: root of the record files.
        batch: environments at once.
        fresh: move an existing record file aside first.
        on_record: called for every record; existing records come first.
        player: `load_player(what)` if the caller has it.
    """
    if len(seeds) == 0 or batch < 1:
        raise ConfigError(f"got {len(seeds)} episodes in batches of {batch}; expected at least one of each.")
    if seeds[0] < 0:
        raise ConfigError(f"got the first episode seed {seeds[0]}; expected 0 or more. Test seeds are 0 to 99.")
    player = player or load_player(what)
    with RecordFile(player.key.path(records), player.key, fresh) as file:
        for record in file.records:
            if record.episode_seed in seeds:
                on_record(record)
        missing = [seed for seed in seeds if seed not in file.done]
        if missing:
            batch = min(batch, len(missing))
            for episode in player.episodes(missing, batch):
                record = to_record(player.key, episode, batch, player.device)
                file.append(record)
                on_record(record)
        return select(file.records, seeds)


def play(agent: Agent, env: str | MakeEnv | None, seeds: range, *, env_kwargs: Mapping[str, Any] | None = None,
         image_key: str | None = None, max_steps: int | None = None, success: str | None = None,
         image_size: int = IMAGE_SIZE, batch: int = BATCH, state_key: str | None = None) -> list[Record]:
    """Run an agent's episodes and return their records, one a seed, without writing them.

    Args:
        agent: anything that acts as `velap.methods.base.Agent` does.
        env: task name, any Gymnasium id, or a function that makes an environment.
        seeds: episode seeds; test seeds are 0 to 99.
        env_kwargs: arguments of `gymnasium.make` besides the id.
        image_key: key of the image in dict observations; `a,b` puts two cameras side by side.
        max_steps: time limit, if the environment has none, or a shorter one [steps].
        success: what counts as success, a rule of `velap.data.success`; None: the info's `success`, else a positive reward.
        image_size: side of the images that the agent takes [px].
        batch: environments at once.
        state_key: key of numbers beside the image, for an agent that takes them.
    """
    if env is None:
        raise ConfigError("got an agent and no environment; expected a task name or a Gymnasium id, such as "
                          'velap.evaluate(agent, env="SpiralMaze").')
    if len(seeds) == 0 or batch < 1:
        raise ConfigError(f"got {len(seeds)} episodes in batches of {batch}; expected at least one of each.")
    env_id = TASKS[env].env_id if isinstance(env, str) and env in TASKS else env
    name = env if isinstance(env, str) else getattr(env, "__name__", type(env).__name__)
    first = make_env(env_id, env_kwargs)
    try:
        limit = _time_limit(first, max_steps)
    finally:
        first.close()
    key = RunKey(task=name, method=agent.method, preset="none", train_seed=0, env=name, config_hash="", checkpoint="",
                 code_version=code_version(), image_key=image_key, max_steps=limit,
                 success_rule=success)
    player = Player(agent=agent, model=None, config=Config(task=name, preset="none"), key=key, image_size=image_size,
                    make_env=lambda: make_env(env_id, env_kwargs), reading=Reading(state_key=state_key or ""))
    return [to_record(key, each, min(batch, len(seeds)), device="")
            for each in sorted(player.episodes(seeds, batch), key=lambda each: each.seed)]


def to_record(key: RunKey, episode: Episode, batch: int, device: str) -> Record:
    """The record of an episode that ran with `batch` - 1 others on `device`, times rounded to microseconds."""
    return Record(**vars(key), episode_seed=episode.seed, success=episode.success, steps=episode.steps,
                  truncated=episode.truncated, plan_ms=tuple(round(value, 3) for value in episode.plan_ms),
                  plan_steps=episode.plan_steps, batch=batch, device=device)


@cache
def code_version() -> str:
    """`0.1.0+g1a2b3c4`, with `.dirty` after uncommitted changes; the bare version outside a checkout of velap."""
    package = Path(__file__).resolve().parents[1]
    checkout = package.parents[1]
    if not (checkout / ".git").exists():
        return __version__
    git = ["git", "-C", str(checkout)]
    try:
        commit = subprocess.run([*git, "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True)
        difference = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", "src"], capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        return __version__
    return f"{__version__}+g{commit.stdout.strip()}{'.dirty' if difference.returncode else ''}"
