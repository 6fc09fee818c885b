"""`velap view`: the decisions of an agent in one episode, and real states to compare its latents with.

T steps of an episode, D latent dimensions.
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
from velap.models.checkpoint import load_checkpoint, released_checkpoint
from velap.report.diagnose.model import open_recorded, real_states_of
from velap.report.figures import PROBES, Planned, RealStates, planned
from velap.report.video import latent_map_of, picture
from velap.search.types import Plan
from velap.tasks import TASKS

FIRST_SEED = 1000
"""Default episode: the first validation seed."""
SIDE = 256
"""Side of the pictures of the world [px]."""


@dataclass(frozen=True, kw_only=True)
class MadePlan(Planned):
    """A plan, and when and how it was made."""

    step: int
    """Step that it was made at."""
    reached_goal: bool | None
    """Some node has Q^g > τ_goal; None for planners without a tree."""
    cost: float | None
    """c(g*) [steps]."""
    milliseconds: float


@dataclass(frozen=True, kw_only=True)
class Step:
    """One decision."""

    picture: NDArray[np.uint8]
    """[SIDE, SIDE, 3] the world before the action."""
    latent: NDArray[np.float32] | None
    """[D]; None for methods other than VELAP."""
    value: float | None
    """Q^g [Q-value]."""
    actor: Actor | None
    """Who acts; None for methods other than VELAP."""
    waypoint: int | None
    """Number of the current waypoint, from 1; None without a plan to follow."""
    plan: int | None
    """Number of the current plan."""


@dataclass(frozen=True, kw_only=True)
class Trace:
    """One episode."""

    outcome: Episode
    steps: tuple[Step, ...]
    last_picture: NDArray[np.uint8]
    """[SIDE, SIDE, 3] after the last action."""
    plans: tuple[MadePlan, ...]


class Tracer:
    """An observer that keeps the decisions of one episode at a time, in one row."""

    def __init__(self) -> None:
        self._steps: list[Step] = []
        self._plans: list[MadePlan] = []
        self.traces: list[Trace] = []
        """Finished episodes."""

    def __call__(self, moment: Moment) -> None:
        """Keep a step, or finish the episode."""
        seen = picture(moment, SIDE)
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
            self._plans.append(_made(agent, row, len(self._steps)))
        actor = agent.last_actors[row]
        return Step(picture=seen, latent=agent.last_latents[row], value=float(agent.last_values[row]), actor=actor,
                    waypoint=int(agent.plans.current[row]) if actor in FOLLOWING else None,
                    plan=len(self._plans) - 1 if self._plans else None)


def _made(agent: TreeAgent, row: int, step: int) -> MadePlan:
    """The plan that the agent has just made for `row`."""
    plans, place = agent.last_plan, int(np.flatnonzero(agent.last_plan_rows == row)[0])
    assert plans is not None
    tree = plans if isinstance(plans, Plan) else None
    return MadePlan(**vars(planned(plans, place)), step=step, milliseconds=float(agent.last_plan_ms[row]),
                    reached_goal=None if tree is None else bool(tree.reached_goal[place]),
                    cost=None if tree is None else float(tree.cost[place]))


def trace(player: Player, seed: int) -> Trace:
    """Run the episode of `seed`."""
    tracer = Tracer()
    for _ in player.episodes([seed], 1, tracer):
        pass
    return tracer.traces[0]


def backdrop_of(player: Player, seed: int, dataset: str | None = None, count: int = PROBES) -> RealStates | None:
    """Real states of the given dataset; else of the episode's own scene if the robot can be placed anywhere; else of the
    task's dataset if it exists; else the checkpoint's bank of latents, without frames."""
    if player.model is None:
        return None
    if dataset is None:
        if (found := latent_map_of(player, seed, count)) is not None:
            return found
        own = TASKS[player.key.task].dataset_id if player.key.task in TASKS else None
        dataset = own if own is not None and minari_io.exists(own) else None
    if dataset is not None:
        metadata = {"seed": str(player.key.train_seed), "reading": player.reading.to_json()}
        recorded = open_recorded(dataset, player.key.image_key, player.model, player.config, metadata)
        return real_states_of(player.model, recorded, np.random.default_rng(0), count)
    bank = getattr(player.model, "bank_latents", torch.empty(0))
    if len(bank) == 0:
        return None
    return RealStates(source="the checkpoint's bank", latents=bank[:count].float().cpu().numpy(),
                      frames=np.empty((0, 0, 0, 3), np.uint8))


@dataclass(frozen=True, kw_only=True)
class Subject:
    """An episode to view."""

    player: Player
    seed: int
    records: tuple[Record, ...] = ()
    """All records of the given file."""


def subject_of(source: Path, *, episode_seed: int | None = None, checkpoint: Path | None = None, method: str = "velap",
               env: str | None = None, env_kwargs: dict[str, Any] | None = None, max_steps: int | None = None,
               device: str = "auto") -> Subject:
    """An episode of a checkpoint, or a recorded one that runs again as it was recorded.

    Defaults for a record file: the first failed episode, and the task's released checkpoint.
    """
    if source.suffix != ".jsonl":
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
    """The player that made a record file; raises ConfigError for another checkpoint."""
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
