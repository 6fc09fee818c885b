"""How long the jobs of a table should take: from what was measured, else from calibrated costs.

Costs are seconds on one of two cores (AMD EPYC, both busy, one thread a job), the setting of the table's time budget. A job
that was measured is foretold by its own rate; one that was not by its calibrated cost, corrected by how far jobs of its kind
and method were off. ours throughout: the paper gives no times for this hardware.
"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass

from studies.jobs import Job
from studies.paper import TABLE_1
from studies.timings import Timings
from velap.config import Config
from velap.tasks import get_task, make_config

BUDGET_HOURS = 24.0
"""Wanted for 9 methods × 6 tasks × 1 training seed on two cores [h]."""

START_SECONDS = 4.0
"""Imports and model of a process [s]."""
FRAME_LOAD_SECONDS = 0.00015
"""Reading a frame of the dataset [s]."""
ENV_STEP_SECONDS = {"block": 0.0005, "arm": 0.0018}
"""One environment step with its frame [s]."""
ENCODE_SECONDS = 0.0010
"""Encoding one state and a policy's answer [s]."""
SOLVED_SAVING = 0.35
"""Share of the time limit that a solved episode leaves unused; how many are solved is read from the paper's table."""
PLAN_SECONDS = {"mppi": 0.7, "mbop": 0.7, "iris": 0.0025, "iris-multistep": 0.01}
"""One plan of a method whose cost is the same on every task [s]."""
PLAN_EVERY = {"mppi": 5, "mbop": 5, "iris": 5, "iris-multistep": 5}
"""Environment steps between two plans [steps], App. D.4 to D.7."""
EXPANSION_STEP_SECONDS = 0.000012
"""VELAP's search, one simulated step of one expansion [s]."""
CORRECTED_FACTOR = 4.0
"""Plans along corrected dynamics (`residuals`), relative to those that kernels.c grows."""
LOOKAHEAD_SECONDS = 0.0013
"""VELAP's lookahead at each environment step [s]."""
CORRECTED_LOOKAHEAD_SECONDS = 0.045
"""The same along corrected dynamics [s]."""
FRAME_SECONDS = {1: 0.00046, 3: 0.00060}
"""Joint training on whole windows, one encoded state of so many frames with its share of the update [s]."""
SINGLE_FACTOR = 1.5
"""Joint training where the first transition of a window alone trains the values (`paper`), relative to whole windows."""
LATENT_UPDATE_SECONDS = 0.05
"""One update of the latent phase [s]."""
VALUE_UPDATE_SECONDS = 0.029
"""One update of critics and policies alone on frozen latents [s]."""
MEMBER_UPDATE_SECONDS = 0.011
"""Of the members' phase, for each member [s]."""
DISTIL_UPDATE_SECONDS = 0.015
"""Of the phase after it [s]."""
CLONE_UPDATE_SECONDS = 0.005
"""One update of the policy cloned from successes [s]."""
HEAD_UPDATE_SECONDS = {"bc": 0.0020, "bc-success": 0.0008, "iql": 0.0115, "iql-sparse": 0.0115, "iris": 0.0095,
                       "iris-multistep": 0.0100}
"""One update of a learner on frozen latents [s]."""


@dataclass(frozen=True)
class Expectation:
    """How long a whole job should take, and how that is known."""

    seconds: float
    source: str
    """`measured`, `scaled` by other jobs of its kind, or `calibrated`."""


class Forecast:
    """Expected times of the jobs of a plan."""

    def __init__(self, jobs: Sequence[Job], timings: Timings, machine: str) -> None:
        self._measured = {job.name: seconds for job in jobs if (seconds := measured(job, timings, machine)) is not None}
        self._ratios: dict[tuple[str, str], dict[str, float]] = {}
        for job in jobs:
            if job.name in self._measured:
                self._ratios.setdefault(_class(job), {})[job.name] = self._measured[job.name] / calibrated(job)

    def measured(self, job: Job) -> float | None:
        """What the whole job took, or would take at the rate that it has had so far [s]."""
        return self._measured.get(job.name)

    def foretold(self, job: Job) -> Expectation:
        """What is said of the job without its own measurement: its calibrated cost, corrected by the others of its kind."""
        others = [ratio for name, ratio in self._ratios.get(_class(job), {}).items() if name != job.name]
        if others:
            return Expectation(calibrated(job) * statistics.median(others), "scaled")
        return Expectation(calibrated(job), "calibrated")

    def __call__(self, job: Job) -> Expectation:
        """The best guess for the whole job: its own measurement where there is one."""
        took = self.measured(job)
        return self.foretold(job) if took is None else Expectation(took, "measured")

    def left(self, job: Job) -> float:
        """Time until the job is finished [s]; 0 where it need not run."""
        if not job.wanted:
            return 0.0
        return self(job).seconds * (1 - job.finding.done / job.finding.total)


def _class(job: Job) -> tuple[str, str]:
    """Jobs whose calibrated costs are off by the same factor."""
    return job.kind, job.cell.method if job.kind in ("head", "evaluate") else job.cell.preset


def measured(job: Job, timings: Timings, machine: str) -> float | None:
    """Time of the whole job at its measured rate on this machine; its result's own note where there is no timing [s]."""
    timing = timings.get(job.name)
    if timing is not None and timing.machine == machine:
        return timing.rate * job.finding.total
    return job.finding.seconds


def calibrated(job: Job) -> float:
    """Time of the whole job by calibrated costs alone [s]."""
    config, task = make_config(job.cell.task, job.cell.preset), get_task(job.cell.task)
    if job.kind == "dataset":
        return START_SECONDS + task.recipe.transitions * _env_step(job.cell.task)
    if job.kind == "joint":
        train = config.train
        frame = FRAME_SECONDS.get(config.model.frame_stack, FRAME_SECONDS[3])
        windows = train.batch_windows * (train.window + 1) * (1.0 if train.whole_windows else SINGLE_FACTOR)
        encoded = train.encoder_steps * 2 * train.encoder_pairs + train.joint_steps * windows
        frozen = (
            train.latent_steps * LATENT_UPDATE_SECONDS
            + train.latent_value_steps * VALUE_UPDATE_SECONDS
            + train.member_steps * train.members * MEMBER_UPDATE_SECONDS
            + train.distil_steps * DISTIL_UPDATE_SECONDS
            + train.clone_steps * CLONE_UPDATE_SECONDS
        )
        return START_SECONDS + encoded * frame + frozen
    if job.kind == "head":
        loading = task.recipe.transitions * FRAME_LOAD_SECONDS
        return START_SECONDS + loading + job.finding.total * HEAD_UPDATE_SECONDS[job.cell.method]
    published = TABLE_1.get((job.cell.task, job.cell.method))
    solved = published.mean / 100 if published is not None else 0.0
    decisions = job.finding.total * task.max_steps * (1 - SOLVED_SAVING * solved)
    return START_SECONDS + decisions * (_env_step(job.cell.task) + act_seconds(job.cell.method, config))


def _env_step(task: str) -> float:
    return ENV_STEP_SECONDS["block" if task.endswith("Maze") else "arm"]


def act_seconds(method: str, config: Config) -> float:
    """One decision of a method, plans spread over the steps between them [s]."""
    if method == "random":
        return 0.0
    if method in PLAN_SECONDS:
        return ENCODE_SECONDS + PLAN_SECONDS[method] / PLAN_EVERY[method]
    if method != "velap":
        return ENCODE_SECONDS
    planner, controller = config.planner, config.controller
    plan = planner.n_iter * planner.n_sim * EXPANSION_STEP_SECONDS
    if controller.residuals:
        plan *= CORRECTED_FACTOR
    simulated = CORRECTED_LOOKAHEAD_SECONDS if controller.residuals else LOOKAHEAD_SECONDS
    lookahead = simulated if controller.lookahead else 0.0
    return ENCODE_SECONDS + lookahead + plan / controller.n_replan
