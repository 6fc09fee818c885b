"""The page of `velap diagnose`: each number with what is expected and what to try otherwise.

The bounds are ours: they separate models that work from models that do not.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from velap.models.horizon import steps_from_q
from velap.report.diagnose.failures import CLASSES, REMEDIES, Failures
from velap.report.diagnose.model import APART, LAST, LED, ActionValues, RolloutError, StatePairs, ValueCurve
from velap.report.diagnose.plans import TreeNumbers, Trees
from velap.report.diagnose.world import NEAR, Scene
from velap.search.types import Rejections

if TYPE_CHECKING:
    from velap.report.diagnose.command import Diagnosis

ERROR_SHARE = 0.5
"""Largest error of a rollout, as a share of the true displacement."""
LOCAL_FACTOR = 2.0
"""Largest factor between Q^l's steps within a trajectory and the steps taken, which are an upper bound."""
ALIASED = 0.05
"""Largest share of distant states that count as arrived by Q^l."""
RHO = 0.7
"""Spearman's rho of learnt and true distances."""
ACTION_RHO = 0.3
"""Spearman's rho of Q^g's promise of an action and its outcome; 0.4 to 0.75 where a task is solved."""
GAIN = 10.0
"""A plan that does not find the goal comes at least this much nearer by Q^g [steps]."""
SUPPORT_FACTOR = 1.5
"""Nodes of a tree are at most this factor farther from the data than held-out states are."""


@dataclass(frozen=True, kw_only=True)
class Check:
    """One thing that was measured."""

    title: str
    numbers: str
    good: bool | None
    """None without a bound."""
    expected: str
    advice: str

    @property
    def mark(self) -> str:
        """One word."""
        return {True: "ok", False: "LOOK", None: "info"}[self.good]


def checks(diagnosis: Diagnosis) -> list[Check]:
    """All checks, in the order in which a fault spreads: model, distances, values, plans, episodes."""
    limit = diagnosis.arrived_steps
    found = [*_of_rollouts(diagnosis.rollout, diagnosis.simulated), *_of_pairs(diagnosis.pairs, limit)]
    found += _of_scenes(diagnosis.scenes, limit) if diagnosis.scenes else []
    found += [_of_curves(diagnosis.curves)] if diagnosis.curves else []
    found.append(_of_actions(diagnosis.actions))
    found += _of_trees(diagnosis.trees, diagnosis.discount)
    return found + ([_of_failures(diagnosis.failures)] if diagnosis.failures is not None else [])


def _of_rollouts(rollout: RolloutError, simulated: int) -> Iterator[Check]:
    """h and Q^l within trajectories."""
    at = rollout.at(simulated)
    error, moved, length = rollout.error[1, at], rollout.moved[1, at], rollout.lengths[at]
    yield Check(
        title="Dynamics h",
        numbers=f"after {length} steps a rollout is {error:.2f} one-step lengths off; the state has moved {moved:.2f}",
        good=bool(error <= ERROR_SHARE * moved),
        expected=f"an error of at most {ERROR_SHARE:.0%} of the displacement",
        advice="train longer (train.joint.steps, train.latent.steps), simulate fewer steps a node (planner.n_sim), or "
               "check whether model.frame_stack frames show the whole state")
    steps = rollout.local_steps[1, at]
    yield Check(
        title="Q^l within a trajectory", numbers=f"states {length} steps apart are {steps:.1f} steps apart by Q^l (median)",
        good=bool(length / LOCAL_FACTOR / LOCAL_FACTOR <= steps <= length * LOCAL_FACTOR),
        expected=f"at most about {length}, since a random walk takes detours, and not near 0",
        advice="near 0: distances have collapsed, raise train.joint.c1; far above: train longer")


def _of_pairs(pairs: Sequence[StatePairs], limit: float) -> Iterator[Check]:
    """Q^l between trajectories."""
    for each in pairs:
        aliased, share = each.aliased(limit), each.arrived(limit)
        known = "" if aliased is None else (f", {aliased:.1%} of those whose agent is more than {APART * limit:.0f} steps "
                                            "apart")
        yield Check(
            title=f"Q^l, {each.name}",
            numbers=f"median {np.median(each.local_steps):.1f} steps; {share:.1%} of the pairs count as arrived (at most "
                    f"{limit:.0f} steps){known}",
            good=(share if aliased is None else aliased) <= ALIASED,
            expected=f"far more steps than within a trajectory, at most {ALIASED:.0%} that count as arrived",
            advice="aliased states make short cuts through walls: draw windows together (train.group_windows), raise "
                   "model.frame_stack, or lower controller.waypoint_exponent")


def _of_scenes(scenes: Sequence[Scene], limit: float) -> Iterator[Check]:
    """True distances in mazes."""
    local, near, value = ([getattr(scene, name) for scene in scenes] for name in ("local_rho", "near_rho", "value_rho"))
    aliased = max(scene.aliased(limit, APART * limit) or 0.0 for scene in scenes)
    yield Check(
        title="Q^l against shortest ways in test scenes",
        numbers=f"rho {_numbers(near)} up to {NEAR:.0f} steps, {_numbers(local)} in all; {aliased:.1%} of the pairs more "
                f"than {APART * limit:.0f} steps apart count as arrived",
        good=min(near) >= RHO and aliased <= ALIASED,
        expected=f"rho of {RHO} and more up to {NEAR:.0f} steps, at most {ALIASED:.0%}; far pairs are beyond what Q^l was "
                 "taught",
        advice="where recorded episodes above are fine and these are not, the encoder does not generalise to new scenes: "
               "more contexts in the data, or train.group_windows")
    yield Check(
        title="Q^g against the shortest way to the goal",
        numbers=f"rho {_numbers(value)}",
        good=None,
        expected=f"high near the goal; {RHO} and more over a whole maze is a luxury, the tree does without",
        advice="see Q^g along episodes")


def _of_curves(curves: Sequence[ValueCurve]) -> Check:
    """Q^g along rewarded episodes."""
    rhos, errors = [curve.rho for curve in curves], [curve.steps_error for curve in curves]
    ends = [float(curve.values[-2]) for curve in curves]
    return Check(
        title="Q^g before the reward",
        numbers=f"{_numbers(ends)} at the rewarded action, rho with time over the {LAST} steps before it {_numbers(rhos)}, "
                f"{_numbers(errors, 0)} steps off (median over all) along {len(curves)} episodes",
        good=min(ends) >= 0.5 and min(rhos) >= RHO,
        expected=f"near 1 at the rewarded action, rho of {RHO} and more; far from the goal Q^g may flatten, the tree "
                 "searches there",
        advice="low at the end: too few rewards seen, raise train.joint.rewarded_share or add successes; flat: train longer")


def _of_actions(actions: ActionValues) -> Check:
    """Q^g of actions against where they lead."""
    rhos = [actions.rho(far) for far in (False, True)]
    return Check(
        title="Q^g of recorded actions against what comes of them",
        numbers=f"rho {_numbers(rhos)} in the nearer and the farther half of {len(actions.away)} transitions (Q^g {LED} "
                "steps later)",
        good=None if any(math.isnan(rho) for rho in rhos) else min(rhos) >= ACTION_RHO,
        expected=f"{ACTION_RHO} and more in both, 0.4 to 0.75 on our own tasks; π^g climbs Q^g over actions, so of two "
                 "models the one with the lower rho knows less where to go, however right its values along episodes are",
        advice="low in the farther half: the critics see steps near the goal alone, train.critic_floor; low in the nearer "
               "half: more rewarded data, or train.c3 for more imitation")


def _of_trees(trees: Trees, discount: float) -> Iterator[Check]:
    """Plans."""
    numbers = trees.numbers
    reached = sum(each.reached_goal for each in numbers)
    nodes = [each.nodes for each in numbers]
    best = [each.best_value for each in numbers]
    gains = [steps_from_q(each.start_value, discount) - steps_from_q(each.best_value, discount) for each in numbers]
    yield Check(
        title="Trees",
        numbers=f"{reached} of {len(numbers)} plans find the goal (Q^g above {trees.goal_value:.2f}); best Q^g "
                f"{_numbers(best)}, {_numbers(gains, 0)} steps nearer than the start; {min(nodes)} to {max(nodes)} nodes",
        good=all(each.reached_goal or gain >= GAIN for each, gain in zip(numbers, gains, strict=True)),
        expected=f"the goal, or where it is far a place at least {GAIN:.0f} steps nearer by Q^g",
        advice=_tree_advice(numbers))
    distances = [each.distance for each in numbers]
    typical = float(np.median(distances))
    yield Check(
        title="Tree nodes against real states",
        numbers=f"nodes are {_numbers(distances)} one-step lengths from the nearest frame of the data (means), recorded "
                f"states that were kept apart {trees.held_out_distance:.2f}",
        good=typical <= max(SUPPORT_FACTOR * trees.held_out_distance, 1.0),
        expected=f"at most a step, or {SUPPORT_FACTOR} times as far as recorded states",
        advice="the tree leaves the data: planner.anchor=reject, fewer planner.n_sim, or better dynamics; from new scenes "
               "some excess is normal")
    if trees.scene_distance is not None and trees.scene_spacing is not None:
        yield Check(
            title="Tree nodes against their own scene",
            numbers=f"nodes from {numbers[0].start} are {trees.scene_distance:.2f} one-step lengths from the nearest real "
                    f"state of that scene, its real states {trees.scene_spacing:.2f} from each other",
            good=trees.scene_distance <= max(SUPPORT_FACTOR * trees.scene_spacing, 1.0),
            expected=f"at most a step, or {SUPPORT_FACTOR} times as far as real states",
            advice="the tree drifts into other scenes or out of all: more contexts in the data, fewer planner.n_sim, "
                   "shorter edges (planner.discard_low_exponent)")


def _tree_advice(numbers: Sequence[TreeNumbers]) -> str:
    """By the commonest reason of rejection."""
    totals = {name: sum(each.rejected[name] for each in numbers) for name in Rejections._fields}
    commonest = max(totals, key=lambda name: totals[name])
    advice = {
        "unsupported": "most candidates leave the data: improve the dynamics, or set planner.anchor to none",
        "low": "most candidates are called too far from their parent: raise planner.discard_low_exponent, or check Q^l",
        "std": "the ensemble disagrees on most candidates: train longer",
        "high": "most candidates are near a node already: the reachable space is full, or Q^l takes different states for "
                "one; see the share that counts as arrived",
    }[commonest]
    return f"{advice}; or raise planner.n_iter"


def _of_failures(failures: Failures) -> Check:
    """Episodes."""
    counts = {kind: count for kind, count in failures.counts.items() if count}
    failed = {kind: count for kind, count in counts.items() if kind != "solved"}
    advice = REMEDIES[max(failed, key=lambda kind: failed[kind])] if failed else "nothing failed"
    text = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    return Check(
        title="Episodes",
        numbers=text,
        good=2 * failures.counts["solved"] >= len(failures.outcomes),
        expected="solved ones",
        advice=advice)


def _numbers(values: Sequence[float], digits: int = 2) -> str:
    return " / ".join("-" if math.isnan(value) else f"{value:.{digits}f}" for value in values)


def page(diagnosis: Diagnosis, pictures: Sequence[str]) -> str:
    """The report, in Markdown; the last picture stands at its end."""
    lines = [f"# Diagnosis of {diagnosis.subject}", "", f"Written by `{diagnosis.command}`. {diagnosis.origin}", ""]
    lines += [f"Left out: {text}\n" for text in diagnosis.left_out]
    lines += [f"- {each.mark} **{each.title}**: {each.numbers}. *Expected*: {each.expected}. *Otherwise*: {each.advice}."
              for each in checks(diagnosis)]
    lines += ["", "Faults spread downwards: mend the first `LOOK` first. One-step length: mean distance of subsequent "
              f"encodings, {diagnosis.rollout.one_step:.3g}. Q-values are read as steps by log_γ; the bounds are rules of "
              "thumb.", ""]
    lines += [f"![{name}]({name})" for name in pictures[:-1]] + ["", *_tree_table(diagnosis.trees)]
    if diagnosis.failures is not None:
        lines += ["", *_failure_table(diagnosis.failures)]
    return "\n".join([*lines, "", f"![{pictures[-1]}]({pictures[-1]})", ""])


def _tree_table(trees: Trees) -> list[str]:
    """Every plan on a line."""
    return ["## Trees", "", "Rejected candidates by the first reason that held: beyond the data, too far from the parent "
            "(low), ensemble disagrees (std), too near another node (high).", "",
            "| from | nodes | beyond | low | std | high | Q^g at the root | best Q^g | goal found | waypoints | steps |",
            "| --- " * 11 + "|",
            *(f"| {each.start} | {each.nodes} | {' | '.join(str(count) for count in each.rejected.values())} | "
              f"{each.start_value:.4f} | {each.best_value:.4f} | {'yes' if each.reached_goal else 'no'} | "
              f"{each.waypoints} | {each.cost:.0f} |" for each in trees.numbers)]


def _failure_table(failures: Failures) -> list[str]:
    """Every episode on a line, and what the classes mean."""
    rows = [f"| {each.seed} | {each.kind} | {each.steps} | {'-' if each.farthest is None else f'{each.farthest:.2f}'} | "
            f"{each.best_value:.3f} | {each.by_global:.0%} | "
            f"{'-' if each.goal_steps is None else f'{each.goal_steps:.0f}'} |" for each in failures.outcomes]
    return ["## Episodes", "", "| seed | class | steps | farthest from start [m] | best Q^g | led by π^g near the goal | "
            "nearest to goal [steps] |", "| --- " * 7 + "|", *rows, "", "The first class that holds:", "",
            *(f"- **{kind}**: {meaning}." for kind, meaning in CLASSES.items())]
