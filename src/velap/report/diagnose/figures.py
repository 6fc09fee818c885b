"""The pictures of `velap diagnose`; they show results and compute none.

K rollout lengths, T transitions of an episode.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from velap.report.diagnose.model import RolloutError, StatePairs, ValueCurve
from velap.report.diagnose.world import NEAR, Scene
from velap.report.figures import SMALLEST_SHOWN, new_figure, save_figure

SHOWN_PAIRS = 3000
"""Points of a scatter plot at most."""


def model_figure(path: Path, rollout: RolloutError, pairs: Sequence[StatePairs]) -> None:
    """Rollout error against displacement, Q^l against true steps, Q^l between trajectories."""
    figure = new_figure(15, 4.6, "Model on recorded episodes (medians and quartiles)")
    in_rollout, in_local, in_pairs = figure.subplots(1, 3)
    _band(in_rollout, rollout.lengths, rollout.moved, "tab:blue", "true displacement")
    _band(in_rollout, rollout.lengths, rollout.error, "tab:red", "error of the rollout")
    in_rollout.set(title="Dynamics h", xlabel="simulated steps", ylabel="one-step lengths", ylim=(0, None))
    in_rollout.legend()
    _band(in_local, rollout.lengths, rollout.local_steps, "tab:green", r"$\log_\gamma Q^l_{min}$")
    in_local.plot(rollout.lengths, rollout.lengths, "k--", linewidth=1, label="steps taken: an upper bound")
    in_local.set(title="$Q^l$ within a trajectory", xlabel="steps taken", ylabel="steps by $Q^l$", ylim=(0, None))
    in_local.legend()
    for each in pairs:
        ordered = np.sort(each.local_steps)
        in_pairs.plot(ordered, np.linspace(0, 1, len(ordered)), label=each.name)
    in_pairs.set(title="$Q^l$ between trajectories", xlabel="steps by $Q^l$", ylabel="share of pairs below", ylim=(0, 1))
    if pairs:
        in_pairs.legend()
    save_figure(figure, path)


def _band(axes: Any, x: NDArray[np.int64], quartiles: NDArray[np.float64], colour: str, label: str) -> None:
    """A median [3, K] with its quartiles."""
    axes.fill_between(x, quartiles[0], quartiles[2], color=colour, alpha=0.2, linewidth=0)
    axes.plot(x, quartiles[1], "o-", color=colour, markersize=3, label=label)
    axes.xaxis.get_major_locator().set_params(integer=True)


def values_figure(path: Path, curves: Sequence[ValueCurve]) -> None:
    """Q^g along episodes that end in the reward, one panel each."""
    figure = new_figure(5 * len(curves), 4.2, "$Q^g$ along episodes that end in the reward")
    for axes, curve in zip(figure.subplots(1, len(curves), sharey=True, squeeze=False)[0], curves, strict=True):
        steps = np.arange(len(curve.values))
        axes.plot(steps, np.clip(curve.values, SMALLEST_SHOWN, None), color="tab:blue", label="$Q^g$")
        axes.plot(steps[:-1], np.clip(curve.ideal, SMALLEST_SHOWN, None), "k--", linewidth=1,
                  label=r"$\gamma^{steps\ left}$")
        axes.axvline(len(steps) - 2, color="tab:red", linewidth=1, label="rewarded action")
        axes.set(title=curve.label, xlabel="step", yscale="log", ylim=(SMALLEST_SHOWN, 1.3))
        axes.legend(loc="lower right")
    figure.axes[0].set_ylabel("$Q^g$")
    save_figure(figure, path)


def scenes_figure(path: Path, scenes: Sequence[Scene], seed: int = 0) -> None:
    """Q^l and Q^g against true ways, a column a scene."""
    figure = new_figure(5 * len(scenes), 8, "Learnt against true distances in test scenes (points: real states)")
    rng = np.random.default_rng(seed)
    for column, scene in zip(figure.subplots(2, len(scenes), squeeze=False).T, scenes, strict=True):
        shown = rng.permutation(len(scene.pair_steps))[:SHOWN_PAIRS]
        column[0].scatter(scene.pair_steps[shown], scene.pair_local[shown], s=4, alpha=0.3, linewidths=0)
        longest = float(scene.pair_steps.max())
        column[0].plot([0, longest], [0, longest], "k--", linewidth=1)
        column[0].set(title=f"scene {scene.seed}: $Q^l$, rho {scene.local_rho:.2f}, up to {NEAR:.0f} steps "
                            f"{scene.near_rho:.2f}", xlabel="shortest way between two states [steps]",
                      ylabel="steps by $Q^l$")
        values = np.clip(scene.values, SMALLEST_SHOWN, None)
        column[1].scatter(scene.goal_steps, values, s=6, alpha=0.6, linewidths=0)
        column[1].set(title=f"$Q^g$, rho {scene.value_rho:.2f}", xlabel="shortest way to the goal [steps]", ylabel="$Q^g$",
                      yscale="log", ylim=(values.min() / 1.3, 1.3))
    save_figure(figure, path)
