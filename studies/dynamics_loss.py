"""Figure 6 (App. E.3): the loss of h, with and without its residual, and what comes of it. See `studies.ablations`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from studies.ablations import COLOURS, METHODS, Results, Study, Variant, success_bars, text_of, with_phases
from studies.objectives import DynamicsPhase
from studies.representation import objective_phase
from studies.unseen import HORIZON
from velap.config import Config, LatentPhase
from velap.config.training import DYNAMICS_HORIZON, DynamicsLoss
from velap.evaluation.summary import markdown_rows
from velap.report.figures import new_figure, save_figure

SHOWN = (1, 10, 30)
"""Rollout lengths in the table [steps]."""
LOSSES: dict[str, tuple[str, DynamicsLoss, int]] = {
    "infonce": (f"InfoNCE, {DYNAMICS_HORIZON} steps (Eq. 9)", "infonce", DYNAMICS_HORIZON),
    "mse": (f"MSE, {DYNAMICS_HORIZON} steps", "mse", DYNAMICS_HORIZON),
    "mse-1": ("MSE, 1 step", "mse", 1),
}
"""Name -> label, loss, and k [steps]."""


def with_loss(loss: DynamicsLoss, horizon: int, residual: bool) -> Callable[[Config], Config]:
    """Eq. 2 with that loss shapes φ on frames, and h goes on by it on frozen latents; the rest is the preset's."""

    def change(config: Config) -> Config:
        phase = objective_phase(config, dynamics_loss=loss, horizon=horizon, reconstruction_side=0)
        frozen = [DynamicsPhase(each.steps, rewarded_share=each.rewarded_share, horizon=horizon, dynamics_loss=loss)
                  if isinstance(each, LatentPhase) else each for each in config.train.phases if each.frozen]
        return with_phases(config, [phase, *frozen], encoder="conv", dynamics_residual=residual)

    return change


VARIANTS = tuple(
    Variant(name=f"{name}{'' if residual else '-plain'}", label=f"{label}, {'residual' if residual else 'plain'}",
            change=with_loss(loss, horizon, residual))
    for residual in (True, False) for name, (label, loss, horizon) in LOSSES.items())
STYLES = {name + suffix: (colour, line) for suffix, line in (("", "-"), ("-plain", "--"))
          for name, colour in zip(LOSSES, COLOURS, strict=False)}


def table(results: Results) -> str:
    """A row a loss and task."""
    columns = ("task", "loss of h", *(f"{label} [%]" for label in METHODS.values()),
               *(f"error after {steps}" for steps in SHOWN), f"moved in {SHOWN[-1]}")
    rows = [(task, each.variant.label, *(text_of(each.success(method), 0) for method in METHODS),
             *(text_of(each.mean("rollout")[steps - 1], 2) for steps in SHOWN),
             f"{each.mean('moved')[SHOWN[-1] - 1][0]:.1f}")
            for task, of_task in results.items() for each in of_task]
    return markdown_rows(columns, rows)


def draw(results: Results, path: Path) -> None:
    """A row of panels a task: success, and the error of h against the length of its rollouts."""
    figure = new_figure(12, 0.4 + 4.2 * len(results), "")
    rows = figure.subplots(len(results), 2, squeeze=False, gridspec_kw={"width_ratios": (1, 1.1)})
    steps = np.arange(1, HORIZON + 1)
    for (task, of_task), (success, curves) in zip(results.items(), rows, strict=True):
        success_bars(success, task, of_task)
        for each in of_task:
            colour, line = STYLES[each.variant.name]
            error, low, high = each.mean("rollout").T
            curves.plot(steps, error, line, color=colour, linewidth=2, label=each.variant.label)
            curves.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
        moved = np.mean([each.mean("moved")[:, 0] for each in of_task], 0)
        curves.plot(steps, moved, ":", color="0.35", linewidth=2, label="no change predicted (mean)")
        curves.set(xlabel="steps that h is unrolled", ylabel="error of h in unseen scenes [one-step lengths]", yscale="log",
                   xlim=(1, HORIZON))
        curves.yaxis.set_major_formatter("{x:g}")
        curves.grid(alpha=0.3, which="both")
        curves.spines[["top", "right"]].set_visible(False)
        curves.legend(frameon=False, fontsize=8, loc="upper left")
    rows[0][0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    save_figure(figure, path)


STUDY = Study(root=Path("results/dynamics_loss"), variants=VARIANTS, table=table, draw=draw)
