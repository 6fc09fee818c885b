"""`velap view`: what an agent did in an episode, step by step, and real states to compare its latents with.

T steps of an episode, D latent dimensions, M nodes of a tree, L waypoints, P states of a backdrop, H x W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from velap.data import minari_io
from velap.errors import CheckpointError, ConfigError, UnknownTaskError
from velap.evaluation.evaluate import Evaluation, Player, load_player
from velap.evaluation.records import Record, read_records
from velap.evaluation.rollout import Episode, Moment
from velap.methods.tree_agent import FOLLOWING, Actor, TreeAgent
from velap.report.demo import released_checkpoint
from velap.report.diagnose.model import open_recorded, real_states_of
from velap.report.figures import can_probe, probe
from velap.report.video import picture
from velap.search.types import Plan
from velap.tasks import TASKS

FIRST_SEED = 1000
"""Episode that is shown unless said: the first validation seed."""
SIDE = 256
"""Side of the pictures of the world [px]."""
STATES = 1200
"""P at most. ours: enough to see a maze's corridors, and some seconds of Isomap."""


@dataclass(frozen=True, kw_only=True)
class Planned:
    """One plan of the episode."""

    step: int
    """Step that it was made at."""
    latents: NDArray[np.float32]
    """[M, D] nodes in the order in which they were added, the root first; of a planner without a tree its waypoints."""
    parents: NDArray[np.int64]
    """[M] -1 for the root."""
    path: NDArray[np.int64]
    """[L] nodes of the chosen path, root first."""
    reached_goal: bool | None
    """Some node has Q^g > τ_goal; None where the planner does not tell."""
    cost: float | None
    """c(g*) [steps]."""
    milliseconds: float

    @property
    def waypoints(self) -> NDArray[np.float32]:
        """[L, D]."""
        return self.latents[self.path]


@dataclass(frozen=True, kw_only=True)
class Step:
    """One decision."""

    picture: NDArray[np.uint8]
    """[SIDE, SIDE, 3] the world before the action."""
    latent: NDArray[np.float32] | None
    """[D]; None for methods that do not tell."""
    value: float | None
    """Q^g [Q-value]."""
    actor: Actor | None
    """Who acts; None for methods that do not tell."""
    waypoint: int | None
    """Number of the waypoint headed for, from 1 on; None where no plan is followed."""
    plan: int | None
    """Number of the plan held."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """An episode as it was seen."""

    outcome: Episode
    steps: tuple[Step, ...]
    last_picture: NDArray[np.uint8]
    """[SIDE, SIDE, 3] after the last action."""
    plans: tuple[Planned, ...]


class Tracer:
    """An observer of one episode at a time, in one row, that keeps what the agent tells."""

    def __init__(self) -> None:
        self._steps: list[Step] = []
        self._plans: list[Planned] = []
        self.traces: list[Trace] = []
        """Finished episodes."""

    def __call__(self, moment: Moment) -> None:
        """Keep a step, or close the episode."""
        seen = picture(moment.env, SIDE)
        if moment.outcome is not None:
            self.traces.append(Trace(outcome=moment.outcome, steps=tuple(self._steps), last_picture=seen,
                                     plans=tuple(self._plans)))
            self._steps, self._plans = [], []
        elif isinstance(moment.agent, TreeAgent):
            self._steps.append(self._step_of(moment.agent, moment.row, seen))
        else:
            self._steps.append(Step(picture=seen, latent=None, value=None, actor=None, waypoint=None, plan=None))

    def _step_of(self, agent: TreeAgent, row: int, seen: NDArray[np.uint8]) -> Step:
        if row in agent.planned_rows:
            self._plans.append(_planned(agent, row, len(self._steps)))
        actor = agent.last_actors[row]
        return Step(picture=seen, latent=agent.last_latents[row], value=float(agent.last_values[row]), actor=actor,
                    waypoint=int(agent.plans.current[row]) if actor in FOLLOWING else None,
                    plan=len(self._plans) - 1 if self._plans else None)


def _planned(agent: TreeAgent, row: int, step: int) -> Planned:
    """The plan that the agent has just made for `row`."""
    plan, place = agent.last_plan, int(np.flatnonzero(agent.last_plan_rows == row)[0])
    assert plan is not None
    length, milliseconds = int(plan.length[place]), float(agent.last_plan_ms[row])
    if not isinstance(plan, Plan):
        return Planned(step=step, latents=plan.waypoints[place, :length].float().cpu().numpy(),
                       parents=np.arange(length) - 1, path=np.arange(length), reached_goal=None, cost=None,
                       milliseconds=milliseconds)
    size = int(plan.tree.size[place])
    return Planned(step=step, latents=plan.tree.latents[place, :size].float().cpu().numpy(),
                   parents=plan.tree.parents[place, :size].cpu().numpy(), path=plan.nodes[place, :length].cpu().numpy(),
                   reached_goal=bool(plan.reached_goal[place]), cost=float(plan.cost[place]), milliseconds=milliseconds)


def trace(player: Player, seed: int) -> Trace:
    """Run the episode of `seed` and keep it."""
    tracer = Tracer()
    for _ in player.rollout(1, tracer).run([seed]):
        pass
    return tracer.traces[0]


@dataclass(frozen=True, kw_only=True)
class Backdrop:
    """Real states that the latents of an episode are shown among."""

    source: str
    """Where they come from, in words."""
    latents: NDArray[np.float32]
    """[P, D]."""
    frames: NDArray[np.uint8] | None
    """[P, H, W, 3]; None where the latents alone are known."""

    def nearest(self, latents: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Numbers [L] of the states nearest to latents [L, D], and how far they are [L] [latent distance]."""
        away = np.linalg.norm(latents[:, None].astype(np.float64) - self.latents, axis=-1)
        found = away.argmin(1)
        return found, away[np.arange(len(found)), found]


def backdrop_of(player: Player, seed: int, dataset: str | None = None, count: int = STATES) -> Backdrop | None:
    """Real states: of the dataset where one is named; else of the episode's own scene, where the environment can be put
    anywhere; else of the task's dataset, where it is here; else the bank of latents in the checkpoint, without frames."""
    if player.model is None:
        return None
    rng = np.random.default_rng(0)
    if dataset is None:
        env = player.make_env()
        try:
            if can_probe(env):
                found = probe(player.model, env, player.frames_of(env), frame_stack=player.config.model.frame_stack, rng=rng,
                              count=count, seed=seed)
                return Backdrop(source="the episode's scene", latents=found.latents, frames=found.frames)
        finally:
            env.close()
        own = TASKS[player.key.task].dataset_id if player.key.task in TASKS else None
        dataset = own if own is not None and minari_io.exists(own) else None
    if dataset is not None:
        metadata = {"seed": str(player.key.train_seed), "reading": player.reading.to_json()}
        recorded = open_recorded(dataset, player.key.image_key, player.model, player.config, metadata)
        states = real_states_of(player.model, recorded, rng, count)
        return Backdrop(source=f"the dataset {dataset}", latents=states.latents.cpu().numpy(), frames=states.frames)
    bank = getattr(player.model, "bank_latents", torch.empty(0))
    if len(bank) == 0:
        return None
    return Backdrop(source="the checkpoint's bank", latents=bank.float().cpu().numpy()[:count], frames=None)


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is to be viewed."""

    player: Player
    seed: int
    records: tuple[Record, ...] = ()
    """Of the file that was named."""


def subject_of(source: Path, *, episode_seed: int | None = None, checkpoint: Path | None = None, method: str = "velap",
               env: str | None = None, env_kwargs: dict[str, Any] | None = None, max_steps: int | None = None,
               device: str = "auto") -> Subject:
    """A checkpoint, or a record file: then an episode of it is run again as it was recorded.

    Of a record file the first failed episode is taken unless one is named, and the checkpoint is the task's released one
    unless one is named.
    """
    if source.suffix != ".jsonl":
        from velap.models.checkpoint import load_checkpoint

        task = load_checkpoint(source)[1].task
        what = Evaluation(task, method=method, checkpoint=source, env=env, env_kwargs=env_kwargs or {}, max_steps=max_steps,
                          device=device)
        return Subject(player=load_player(what), seed=FIRST_SEED if episode_seed is None else episode_seed)
    records = read_records(source)
    if not records:
        raise ConfigError(f"{source} holds no record; expected at least one episode. Evaluate first, or name a checkpoint.")
    seeds = [record.episode_seed for record in records]
    failed = [record.episode_seed for record in records if not record.success]
    seed = (failed or seeds)[0] if episode_seed is None else episode_seed
    if seed not in seeds:
        raise ConfigError(f"{source} has no episode of seed {seed}; expected one from {min(seeds)} to {max(seeds)}. Name "
                          "one of them with --episode-seed.")
    return Subject(player=_recorded_player(source, records[0], checkpoint, device), seed=seed, records=tuple(records))


def _recorded_player(source: Path, key: Record, checkpoint: Path | None, device: str) -> Player:
    """The player that a record file comes from; raises ConfigError where the checkpoint is another one."""
    if checkpoint is None and key.checkpoint:
        try:
            checkpoint = released_checkpoint(key.task)
        except (CheckpointError, UnknownTaskError) as error:
            raise ConfigError(f"{source} does not hold its checkpoint, and {key.task} has no released one; expected its "
                              "path. Name it with --checkpoint.") from error
    what = Evaluation(key.task, method=key.method, checkpoint=checkpoint, preset=key.preset, env=key.env,
                      env_kwargs=key.env_kwargs, image_key=key.image_key, max_steps=key.max_steps, success=key.success_rule,
                      device=device)
    player = load_player(what)
    if player.key.checkpoint != key.checkpoint:
        raise ConfigError(f"{source} was made by the weights {key.checkpoint[:12]}…, {checkpoint} holds "
                          f"{player.key.checkpoint[:12]}…; expected the same. Name the right file with --checkpoint.")
    return player
