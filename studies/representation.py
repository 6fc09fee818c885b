"""Figure 5 (App. E.2): what shapes the latent, and what comes of it. See `studies.ablations`."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

from studies.ablations import (
    COLOURS,
    METHODS,
    Results,
    Study,
    Variant,
    bars,
    success_bars,
    text_of,
    updates_of,
    with_phases,
)
from studies.objectives import Objective, ObjectivePhase
from velap.config import Config, JointPhase
from velap.evaluation.summary import markdown_rows
from velap.report.figures import new_figure, save_figure

STEPS = 10
"""Rollout length whose error is shown [steps]."""
SIDE = 32
"""Side of the frames that the autoencoder decodes [px]. ours: that of the encoder phase."""


def shaped(objective: Objective, encoder: str = "conv") -> Callable[[Config], Config]:
    """All updates on frames are by one objective; phases on frozen latents, search and controller stay the preset's."""

    def change(config: Config) -> Config:
        side = SIDE if objective == "reconstruction" else 0
        phase = objective_phase(config, objective=objective, reconstruction_side=side)
        frozen = [each for each in config.train.phases if each.frozen]
        # a true state holds the agent's last steps already
        commands = 0 if encoder == "exact-states" else config.model.command_dims
        return with_phases(config, [phase, *frozen], encoder=encoder, command_dims=commands)

    return change


def objective_phase(config: Config, **fields: Any) -> ObjectivePhase:
    """As long as the preset's phases on frames, with the settings of its joint phase if it has one."""
    joint = next((phase for phase in config.train.phases if isinstance(phase, JointPhase)), JointPhase(1))
    known = {each.name: getattr(joint, each.name) for each in dataclasses.fields(JointPhase)}
    return ObjectivePhase(**{**known, "steps": max(1, updates_of(config)[0]), **fields})


VARIANTS = (
    Variant(name="joint", label="joint (Eq. 2)", change=shaped("joint")),
    Variant(name="contrastive", label="contrastive alone (Eq. 9)", change=shaped("contrastive")),
    Variant(name="values", label="values alone (Eq. 3, 4)", change=shaped("values")),
    Variant(name="reconstruction", label="reconstruction", change=shaped("reconstruction")),
    Variant(name="inverse", label="inverse dynamics", change=shaped("inverse")),
    Variant(name="random", label="random, fixed", change=shaped("none", "random-conv")),
    Variant(name="default", label="the default's", change=lambda config: config),
    Variant(name="states", label="true state (ruler)", change=shaped("none", "exact-states"), states=True),
)


def table(results: Results) -> str:
    """A row an encoder and task."""
    columns = ("task", "encoder", *(f"{label} [%]" for label in METHODS.values()), "probe error [deviations]",
               "agent's position [cm]", f"error of h after {STEPS} steps", f"moved in {STEPS} steps")
    rows = [(task, each.variant.label, *(text_of(each.success(method), 0) for method in METHODS),
             text_of(each.mean("probe"), 2), text_of(each.mean("position_cm"), 1),
             text_of(each.mean("rollout")[STEPS - 1], 2), f"{each.mean('moved')[STEPS - 1][0]:.1f}")
            for task, of_task in results.items() for each in of_task]
    return markdown_rows(columns, rows)


def draw(results: Results, path: Path) -> None:
    """A row of panels a task, a bar an encoder."""
    heights = [1.2 + 0.4 * len(of_task) for of_task in results.values()]
    figure = new_figure(13, 0.4 + sum(heights), "")
    rows = figure.subplots(len(results), 3, squeeze=False,
                           gridspec_kw={"height_ratios": heights, "width_ratios": (1.2, 1, 1)})
    for (task, of_task), (success, probing, rolling) in zip(results.items(), rows, strict=True):
        success_bars(success, task, of_task)
        for axes, name, colour in ((probing, "probe", COLOURS[2]), (rolling, "rollout", COLOURS[3])):
            values = [each.mean(name) for each in of_task]
            values = values if name == "probe" else [each[STEPS - 1] for each in values]
            bars(axes, [""] * len(of_task), {name: values}, [colour])
        still = [each.mean("moved")[STEPS - 1][0] for each in of_task]
        rolling.plot(still, range(len(still)), "|", color="black", markersize=13, markeredgewidth=2,
                     label="if h predicted no change")
        probing.set(xlabel="probe error in unseen scenes [deviations]", xlim=(0, None))
        rolling.set(xlabel=f"error of h after {STEPS} steps [one-step lengths]", xlim=(0, None))
    rows[0][0].legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2, frameon=False)
    rolling_handles, rolling_labels = rows[0][2].get_legend_handles_labels()
    rows[0][2].legend(rolling_handles[:1], rolling_labels[:1], loc="lower right", bbox_to_anchor=(1, 1), frameon=False)
    save_figure(figure, path)


STUDY = Study(root=Path("results/representation"), variants=VARIANTS, table=table, draw=draw)
