"""Where episodes fail: every episode's trace, and one class each.

T states of an episode, P entries of a position, K objects, H x W pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from velap.envs.protocol import Measured, Positioned, WithObjects, WithSubtasks
from velap.evaluation.evaluate import Player
from velap.evaluation.rollout import Moment
from velap.methods.tree_agent import TreeAgent
from velap.report.figures import FilmStrip

LEFT_START = 5.0
"""An episode left its start once the agent is farther from it than this many of its fastest steps [steps]. ours."""
TOUCHED = 0.01
"""An object has been moved once it is farther than this from where it was [m]. ours."""
SHOTS = 20
"""Frames of a film strip."""

CLASSES = {
    "solved": "success within the time limit",
    "never left the start": "the agent was never farther from its start than "
                            f"{LEFT_START:.0f} of the longest steps that the data or these episodes show",
    "wrong order": "a later subtask was done while an earlier one was not",
    "object not finished": f"an object was moved by more than {100 * TOUCHED:.0f} cm, and no success: lost, or pushed the "
                           "wrong way",
    "failed near the goal": "Q^g rose above τ_stop, π^g took over, and no success: π^g fails, or Q^g errs about being near",
    "stopped halfway": "none of these: the waypoints led elsewhere, or could not be followed",
}
"""Classes of episodes; an episode belongs to the first that holds."""
REMEDIES = {
    "never left the start": "π^l does not carry out the first waypoint, or the tree is stuck: see the trees' rejections and "
                            "the rollout error",
    "wrong order": "Q^g does not tell the two scenes apart: see Q^g along the expert's path",
    "object not finished": "contact is hard for π^l and π^g: more data near the object, or a shorter controller.n_replan",
    "failed near the goal": "see whether Q^g is high at the right places (its pictures); if it is, more "
                            "rewarded data, or train.c3",
    "stopped halfway": "see whether the planned film strip is a way at all; if so, π^l cannot follow it "
                       "or Q^l errs about steps, if not, the dynamics or the thresholds of the planner",
}
"""What to try."""


@dataclass
class Trace:
    """One episode, state by state."""

    seed: int
    positions: list[NDArray[np.float64]] = field(default_factory=list)
    """[T, P] agent [m]; empty if unknown."""
    objects: list[NDArray[np.float64]] = field(default_factory=list)
    """[T, K, 3] [m]; empty without objects."""
    subtasks: list[tuple[bool, ...]] = field(default_factory=list)
    """[T] which are done, in their order; empty without subtasks."""
    values: list[float] = field(default_factory=list)
    """[T - 1] Q^g before each action [Q-value]."""
    near_goal: list[bool] = field(default_factory=list)
    """[T - 1] π^g led because Q^g was above τ_stop."""
    goal_steps: list[float] = field(default_factory=list)
    """[T] shortest way to the goal [steps]; empty if unknown."""
    shots: list[tuple[int, NDArray[np.uint8]]] = field(default_factory=list)
    """Some time steps and their frames."""
    success: bool = False
    steps: int = 0
    """[steps]"""


@dataclass(frozen=True, kw_only=True)
class JudgedEpisode:
    """One episode and its class."""

    seed: int
    kind: str
    """A key of `CLASSES`."""
    steps: int
    """[steps]"""
    farthest: float | None
    """Largest distance from the start [m]."""
    best_value: float
    """Highest Q^g of the episode [Q-value]."""
    by_global: float
    """Share of the steps that π^g led near the goal."""
    goal_steps: float | None
    """Smallest distance to the goal [steps]."""


@dataclass(frozen=True)
class Failures:
    """All episodes."""

    outcomes: tuple[JudgedEpisode, ...]
    strip: FilmStrip
    """A failed episode, or the longest one if none failed."""

    @property
    def counts(self) -> dict[str, int]:
        """Episodes of every class."""
        return {kind: sum(outcome.kind == kind for outcome in self.outcomes) for kind in CLASSES}


def classify(trace: Trace, fastest: float) -> str:
    """The class of an episode; `fastest` is the longest known step [m/step]."""
    if trace.success:
        return "solved"
    if trace.positions and _farthest(trace) <= LEFT_START * fastest:
        return "never left the start"
    if any(later and not earlier for done in trace.subtasks for earlier, later in pairwise(done)):
        return "wrong order"
    if trace.objects and _moved(trace.objects) > TOUCHED:
        return "object not finished"
    return "failed near the goal" if any(trace.near_goal) else "stopped halfway"


def _farthest(trace: Trace) -> float:
    """[m]"""
    places = np.stack(trace.positions)
    return float(np.linalg.norm(places - places[0], axis=-1).max())


def _moved(objects: Sequence[NDArray[np.float64]]) -> float:
    """Largest displacement of any object [m]."""
    places = np.stack(objects)
    return float(np.linalg.norm(places - places[0], axis=-1).max())


def fastest_step(traces: Sequence[Trace]) -> float:
    """The longest step of any episode [m/step]."""
    ways = [np.linalg.norm(np.diff(np.stack(trace.positions), axis=0), axis=-1) for trace in traces
            if len(trace.positions) > 1]
    return float(np.concatenate(ways).max()) if ways else 0.0


def judge(traces: Sequence[Trace], fastest: float | None) -> tuple[JudgedEpisode, ...]:
    """Classes of all episodes, in the order of their seeds; `fastest` is the longest recorded step if known [m/step]."""
    fastest = max(fastest_step(traces), fastest or 0.0)
    return tuple(JudgedEpisode(
        seed=trace.seed,
        kind=classify(trace, fastest),
        steps=trace.steps,
        farthest=_farthest(trace) if trace.positions else None,
        best_value=max(trace.values, default=float("nan")),
        by_global=float(np.mean(trace.near_goal)) if trace.near_goal else 0.0,
        goal_steps=min(trace.goal_steps, default=None)) for trace in sorted(traces, key=lambda trace: trace.seed))


class Tracer:
    """An observer that keeps a trace of every episode."""

    def __init__(self, every: int) -> None:
        self.traces: dict[int, Trace] = {}
        self._every = every
        """Steps between two kept frames [steps]."""

    def __call__(self, moment: Moment) -> None:
        """One state of one episode."""
        trace, world = self.traces.setdefault(moment.seed, Trace(moment.seed)), moment.env.unwrapped
        agent, outcome = moment.agent, moment.outcome
        if isinstance(world, Positioned):
            trace.positions.append(world.agent_position())
        if isinstance(world, WithObjects):
            trace.objects.append(world.objects())
        if isinstance(world, WithSubtasks):
            trace.subtasks.append(world.subtasks())
        if isinstance(world, Measured):
            trace.goal_steps.append(float(world.geodesic_steps(trace.positions[-1])))
        if outcome is not None:
            trace.success, trace.steps = outcome.success, outcome.steps
        else:
            assert isinstance(agent, TreeAgent)
            trace.values.append(float(agent.last_values[moment.row]))
            trace.near_goal.append(bool(agent.near_goal[moment.row]))
        step = len(trace.values) if outcome is not None else len(trace.values) - 1
        if outcome is not None or step % self._every == 0:
            trace.shots.append((step, np.asarray(moment.env.render(), np.uint8)))


def failure_strip(trace: Trace, kind: str) -> FilmStrip:
    """At most `SHOTS` frames of an episode, the first and the last included."""
    picked = np.unique(np.linspace(0, len(trace.shots) - 1, min(SHOTS, len(trace.shots))).astype(int))
    frames, captions = [], []
    for number in picked:
        step, frame = trace.shots[number]
        frames.append(frame)
        value = f"$Q^g$ {trace.values[step]:.2g}" if step < len(trace.values) else "end"
        by_global = ", $\\pi^g$" if step < len(trace.near_goal) and trace.near_goal[step] else ""
        captions.append(f"step {step}\n{value}{by_global}")
    return FilmStrip(title=f"Episode {trace.seed}: {kind}", frames=np.stack(frames), captions=tuple(captions))


def watch(player: Player, seeds: Sequence[int], fastest: float | None) -> Failures:
    """Run the episodes and classify each; `fastest` is the longest recorded step if known [m/step]."""
    tracer = Tracer(every=5)
    for _ in player.episodes(seeds, observer=tracer):
        pass
    outcomes = judge(list(tracer.traces.values()), fastest)
    shown = max(outcomes, key=lambda outcome: (outcome.kind != "solved", outcome.steps))
    return Failures(outcomes, failure_strip(tracer.traces[shown.seed], shown.kind))
