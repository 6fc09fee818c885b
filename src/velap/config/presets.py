"""The presets, one complete definition a task. `paper` is Tables 2-10 and nothing else, `default` what was measured to be
best.

Fields that are not named have the values of their classes, which say where those come from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from velap.config.model import ModelConfig
from velap.config.planning import ControllerConfig, PlannerConfig
from velap.config.serialise import Config
from velap.config.training import (
    ClonePhase,
    EncoderPhase,
    EnsemblePhase,
    JointPhase,
    LatentPhase,
    TrainConfig,
    ValuePhase,
)
from velap.errors import UnknownTaskError

PRESETS = ("default", "paper")


@dataclass(frozen=True)
class PaperRow:
    """What Tables 7-9 vary by task. The defaults are for data of another task, with frames stacked as in E.1."""

    frame_stack: int = 3
    c1: float = 0.01
    c3: float = 0.001
    n_iter: int = 250
    n_sim: int = 5
    n_replan: int = 15


PAPER_ROWS = {
    "SpiralMaze": PaperRow(frame_stack=1, c1=0.001, n_sim=10, n_replan=25),
    "ObstacleMaze": PaperRow(frame_stack=1),
    "WindowClose": PaperRow(c3=0.5),
    "FaucetClose": PaperRow(c3=0.5),
    "ButtonWall": PaperRow(c3=0.5, n_iter=500, n_sim=10, n_replan=25),
    "DrawerButton": PaperRow(c3=0.5, n_sim=10),
}


def paper(task: str) -> Config:
    """Tables 2-10."""
    row = PAPER_ROWS.get(task, PaperRow())
    return Config(
        task, "paper",
        ModelConfig(frame_stack=row.frame_stack, norm="batch", dynamics_residual=False, critic_bounded=False, n_global=1,
                    bank_size=0),
        TrainConfig(
            phases=(JointPhase(24_000, rewarded_share=0.0, c1=row.c1, windows=64, window=1),),
            c3=row.c3, target_rate=0.005, policy_every=1),
        PlannerConfig(provenance=False, n_iter=row.n_iter, n_sim=row.n_sim, candidates=50, discard_high_exponent=2.0,
                      discard_low_exponent=None, neighbour_exponent=3.0, goal_exponent=5.0,
                      p_policy=0.2, coherent_noise=False, anchor="none"),
        ControllerConfig(n_replan=row.n_replan, stop_exponent=5.0, waypoint_exponent=3.0),
    )


def foreign(task: str) -> Config:
    """Data of no task of ours: many scenes, of which nothing is known."""
    return Config(
        task, "default",
        ModelConfig(bank_size=4096),
        TrainConfig(
            phases=(JointPhase(5_000, reconstruction_side=16), LatentPhase(4_000)),
            group_windows=6, group_reach=4),
    )


def spiral_maze(task: str) -> Config:
    """One scene, which a short training knows exactly."""
    return Config(
        task, "default",
        ModelConfig(frame_stack=1, bank_size=4096),
        TrainConfig(phases=(JointPhase(4_000, c1=0.02), LatentPhase(4_000))),
        PlannerConfig(n_iter=1000),
    )


def obstacle_maze(task: str) -> Config:
    """Many scenes: the encoder first learns where things are."""
    return Config(
        task, "default",
        ModelConfig(frame_stack=1, bank_size=4096),
        TrainConfig(
            phases=(EncoderPhase(3_000), JointPhase(5_000, rewarded_share=0.01, c1=0.02, reconstruction_side=32),
                    LatentPhase(4_000, rewarded_share=0.01), ValuePhase(8_000, rewarded_share=0.01)),
            critic_loss="cross_entropy", group_windows=6, group_reach=4),
        PlannerConfig(n_sim=5),
    )


def window_close(task: str) -> Config:
    """Places come from colour moments, the hand's speed from past commands, all else is learnt on frozen latents. π^g is
    the median of five policies."""
    return Config(
        task, "default",
        ModelConfig(encoder="slow-moments", command_dims=3),
        TrainConfig(
            phases=(EncoderPhase(8_000, pairs=128, inverse=1.0), LatentPhase(3_000, rewarded_share=0.0, horizon=20),
                    EnsemblePhase(5_000, members=5)),
            c0=1.0, c3=1.0, critic_loss="cross_entropy", group_windows=4),
    )


def faucet_close(task: str) -> Config:
    """A short joint phase of small windows tells a pretrained encoder what counts. The best of eight policies cloned from
    successes proposes edges."""
    return Config(
        task, "default",
        ModelConfig(),
        TrainConfig(
            phases=(EncoderPhase(3_000), JointPhase(1_500, c1=0.02, windows=64, window=3),
                    LatentPhase(3_000, rewarded_share=0.0, horizon=20), ClonePhase(8_000, candidates=8)),
            c0=1.0, c3=0.5, critic_loss="cross_entropy", group_windows=4),
    )


def button_wall(task: str) -> Config:
    """As WindowClose, but the latent keeps all moments, far values count as much as near ones, and noise keeps π^g from
    learning single moments."""
    return Config(
        task, "default",
        ModelConfig(encoder="moments", command_dims=3),
        TrainConfig(
            phases=(EncoderPhase(8_000, pairs=128, inverse=1.0), LatentPhase(3_000, rewarded_share=0.0, horizon=20),
                    EnsemblePhase(8_000, noise=0.15)),
            c0=1.0, c3=0.2, critic_loss="cross_entropy", critic_floor=0.005, group_windows=4),
    )


def drawer_button(task: str) -> Config:
    """As ButtonWall with two subtasks: less imitation, and a clone of the successes."""
    return Config(
        task, "default",
        ModelConfig(encoder="moments", command_dims=3),
        TrainConfig(
            phases=(EncoderPhase(8_000, pairs=128, inverse=1.0), LatentPhase(3_000, rewarded_share=0.0, horizon=20),
                    EnsemblePhase(8_000, noise=0.15), ClonePhase(3_000)),
            c0=1.0, c3=0.1, critic_loss="cross_entropy", critic_floor=0.005, group_windows=4),
    )


DEFAULTS: dict[str, Callable[[str], Config]] = {
    "SpiralMaze": spiral_maze, "ObstacleMaze": obstacle_maze, "WindowClose": window_close, "FaucetClose": faucet_close,
    "ButtonWall": button_wall, "DrawerButton": drawer_button,
}


def preset_config(task: str, preset: str = "default") -> Config:
    """The config of a task in a preset. `task` may be the id of a foreign dataset or environment.

    Raises UnknownTaskError for an unknown preset.
    """
    if preset not in PRESETS:
        raise UnknownTaskError(f"unknown preset {preset!r}; expected one of {', '.join(PRESETS)}.")
    return paper(task) if preset == "paper" else DEFAULTS.get(task, foreign)(task)
