"""Tasks: environment, dataset recipe (Table 10), time limit and config of each (Tables 7-9).

The six of App. C and the two of App. E.1 are here. Add your own by `velap.register_task("Mine")(Task(...))`, or by an entry
point of the group `velap.tasks`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from velap import registry
from velap.config import Config, override
from velap.config.presets import (
    DEFAULT_CONTROLLER,
    DEFAULT_TRAIN,
    ONE_SCENE,
    PAPER_CONTROLLER,
    PAPER_MODEL,
    PAPER_PLANNER,
    PAPER_TRAIN,
)
from velap.errors import UnknownTaskError
from velap.registry import Registry

PRESETS = ("default", "paper")


@dataclass(frozen=True)
class Recipe:
    """How a dataset is made (Table 10)."""

    contexts: int
    """Environment initialisations apart from the agent."""
    trajectories: int
    """Trajectories a context."""
    max_steps: int
    """Longest trajectory [steps]."""
    success_percent: float | None = None
    """Share of transitions with reward 1, as Table 10 reports it [%]; None where it does not."""
    action_noise: float = 0.3
    """Standard deviation of the Gaussian steps of the random-walk actions (C.1.1). ours: the paper gives no number."""
    expert_radius: float = 0.0
    """Distance to the goal within which a noisy expert acts as the expert (C.2), or an operator's successes start (E.1) [m].
    ours: the paper says "close" and "within the vicinity"."""
    expert_noise: float = 0.3
    """Standard deviation of the Gaussian noise on a noisy expert's actions. ours: the paper gives no number."""

    @property
    def transitions(self) -> int:
        """Transitions of the dataset where no trajectory ends early."""
        return self.contexts * self.trajectories * self.max_steps


@dataclass(frozen=True)
class Task:
    """One task."""

    name: str
    env_id: str
    """Gymnasium id; `module:Env-v0` imports a module that registers it."""
    max_steps: int
    """Time limit of an episode [steps], App. C."""
    recipe: Recipe
    behaviours: Mapping[str, float] = field(default_factory=lambda: {"random-walk": 1.0})
    """Share of the dataset's trajectories by each behaviour of `velap.data.behaviours`."""
    entry_point: str | None = None
    """`module:Class`, imported only when the environment is made. None: whoever registers the id, `module:Env-v0`, does."""
    overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Tables 7-9: fields that differ on this task, in both presets."""
    default_overrides: dict[str, dict[str, Any]] = field(default_factory=dict)
    """ours: fields that differ on this task in the default preset."""

    @property
    def dataset_id(self) -> str:
        """Minari id of the dataset that `velap collect` writes with seed 0."""
        return _dataset_id(self.name)

    @property
    def shares(self) -> dict[str, float]:
        """`behaviours` with shares that add up to 1."""
        total = sum(self.behaviours.values())
        return {name: share / total for name, share in self.behaviours.items()}


def _dataset_id(name: str) -> str:
    return f"velap/{name}-v0"


_SAWYER_DEFAULTS: dict[str, dict[str, Any]] = {
    "model": {"success_policy": True, "bank_size": 2048},
    "train": {
        "encoder_steps": 3_000,
        "reconstruction_side": 32,
        "reconstruction": 0.0,
        "joint_steps": 1_500,
        "batch_windows": 64,
        "window": 3,
        "value_transitions": 0,
        "group_windows": 4,
        "group_reach": 8,
        "c0": 1.0,
        "c1": 0.02,
        "latent_steps": 3_000,
        "latent_horizon": 20,
        "latent_rewarded_share": 0.0,
        "clone_steps": 8_000,
        "critic_loss": "cross_entropy",
        "policy_relative": True,
    },
    "planner": {
        "n_iter": 500,
        "n_sim": 10,
        "discard_low_exponent": 20.0,
        "p_sparse": 0.9,
        "p_value": 0.1,
        "p_policy": 0.1,
        "expansion_weight": 1.0,
        "anchor": "none",
    },
    "controller": {
        **ONE_SCENE["controller"],
        "n_replan": 25,
        "stop_exponent": 35.0,
        "shortcut_exponent": 12.0,
        "lookahead_gain": 2.0,
        "goal_lookahead": 3,
        "revisit_penalty": 1.0,
        "success_rollout": 150,
    },
}
"""ours: the encoder first learns where things are from pairs of states, a short joint phase of small windows tells it what
counts, the latent phase learns the rest, and a policy is cloned from the successes. The search is SpiralMaze's; near the
goal π^g, which has seen experts there, takes over, and wherever the cloned policy gets to the goal by the model, that one. A
smaller bank keeps the checkpoint below 3 MB."""

_MEMBERS_DEFAULTS: dict[str, dict[str, Any]] = {
    **_SAWYER_DEFAULTS,
    "model": {
        **_SAWYER_DEFAULTS["model"],
        "success_policy": False,
        "latent_dim": 64,
        "slow_features": 32,
        "moment_colours": 24,
        "command_memory": 0.7,
        "command_dims": 3,
    },
    "train": {
        **_SAWYER_DEFAULTS["train"],
        "encoder_steps": 8_000,
        "encoder_pairs": 128,
        "inverse": 1.0,
        "joint_steps": 0,
        "heads_afresh": True,
        "clone_steps": 0,
        "c3": 1.0,
        "member_steps": 5_000,
        "members": 5,
        "distil_steps": 3_000,
    },
    "controller": {
        **_SAWYER_DEFAULTS["controller"],
        "stop_exponent": 150.0,
        "success_rollout": 0,
        "goal_lookahead": 0,
        "revisit_penalty": 8.0,
    },
}
"""ours: places come from colour moments, of which slow features tell where things stand, the hand's speed from the past
actions, and all else is learnt on frozen latents. π^g is the median of five that imitate more and learn no longer than they
gain by it. It leads; the tree takes over where the hand is stuck, which a high price of revisits says soon."""

_ALL_MOMENTS_DEFAULTS: dict[str, dict[str, Any]] = {
    **_MEMBERS_DEFAULTS,
    "model": {
        **_MEMBERS_DEFAULTS["model"],
        "latent_dim": 176,
        "slow_features": 0,
        "keep_moments": True,
        "half_weights": True,
    },
    "train": {
        **_MEMBERS_DEFAULTS["train"],
        "c3": 0.2,
        "critic_floor": 0.005,
        "member_steps": 8_000,
        "members": 4,
        "member_noise": 0.15,
    },
    "controller": {**_MEMBERS_DEFAULTS["controller"], "stop_exponent": 250.0},
}
"""ours: the latent keeps all moments, values far from the goal count as much as near ones, and noise on the latents keeps
π^g from learning single ones. The tree is the last resort: h errs by most of a step in latents with the moments' noise."""

PAPER_TASKS = (
    Task(
        name="SpiralMaze",
        env_id="velap/SpiralMaze-v0",
        entry_point="velap.envs.mazes.env:SpiralMaze",
        max_steps=300,
        recipe=Recipe(contexts=1, trajectories=1000, max_steps=20, success_percent=0.12),
        overrides={
            "model": {"frame_stack": 1},
            "train": {"c1": 0.001},
            "planner": {"n_sim": 10},
            "controller": {"n_replan": 25},
        },
        default_overrides={
            "train": {**ONE_SCENE["train"], "c1": 0.02},
            "planner": {
                "n_iter": 1000,
                "discard_low_exponent": 20.0,
                "p_sparse": 0.9,
                "p_value": 0.1,
                "p_policy": 0.1,
                "expansion_weight": 1.0,
                "anchor": "snap",
            },
            "controller": ONE_SCENE["controller"],
        },
    ),
    Task(
        name="ObstacleMaze",
        env_id="velap/ObstacleMaze-v0",
        entry_point="velap.envs.mazes.obstacle:ObstacleMaze",
        max_steps=100,
        recipe=Recipe(contexts=250, trajectories=20, max_steps=20, success_percent=0.11),
        # Tables 7-9 give it the values that most tasks have: c1 = 0.01, n_iter 250, n_sim 5, n_replan 15
        overrides={"model": {"frame_stack": 1}},
        default_overrides={
            "train": {
                "c1": 0.02,
                "rewarded_share": 0.01,
                "encoder_steps": 3_000,
                "reconstruction_side": 32,
                "critic_loss": "cross_entropy",
                "policy_relative": True,
                "latent_value_steps": 8_000,
            },
            "planner": {
                "n_iter": 500,
                "discard_low_exponent": 10.0,
                "p_sparse": 0.9,
                "p_value": 0.1,
                "p_policy": 0.1,
                "expansion_weight": 1.0,
                "anchor": "none",
            },
            "controller": {"n_replan": 2},
        },
    ),
    Task(
        name="WindowClose",
        env_id="velap/WindowClose-v0",
        entry_point="velap.envs.sawyer.tasks:WindowClose",
        max_steps=150,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.48, expert_radius=0.2),
        behaviours={"random-walk": 0.43, "noisy-expert": 0.57},
        overrides={
            "train": {"c3": 0.5},
        },
        default_overrides=_MEMBERS_DEFAULTS,
    ),
    Task(
        name="FaucetClose",
        env_id="velap/FaucetClose-v0",
        entry_point="velap.envs.sawyer.tasks:FaucetClose",
        max_steps=150,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.31, expert_radius=0.2),
        behaviours={"random-walk": 0.41, "noisy-expert": 0.59},
        overrides={
            "train": {"c3": 0.5},
        },
        default_overrides={
            **_SAWYER_DEFAULTS,
            "train": {**_SAWYER_DEFAULTS["train"], "clone_candidates": 8},
        },
    ),
    Task(
        name="ButtonWall",
        env_id="velap/ButtonWall-v0",
        entry_point="velap.envs.sawyer.tasks:ButtonWall",
        max_steps=250,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.16, expert_radius=0.2),
        behaviours={"random-walk": 0.835, "noisy-expert": 0.165},
        overrides={
            "train": {"c3": 0.5},
            "planner": {"n_iter": 500, "n_sim": 10},
            "controller": {"n_replan": 25},
        },
        default_overrides=_ALL_MOMENTS_DEFAULTS,
    ),
    Task(
        name="DrawerButton",
        env_id="velap/DrawerButton-v0",
        entry_point="velap.envs.sawyer.tasks:DrawerButton",
        max_steps=150,
        recipe=Recipe(contexts=150, trajectories=20, max_steps=50, success_percent=0.16, expert_radius=0.2),
        behaviours={"random-walk": 0.7, "noisy-expert": 0.3},
        overrides={
            "train": {"c3": 0.5},
            "planner": {"n_sim": 10},
        },
        # two subtasks: less imitation; far from the goal held actions and π^g in turns, near it what has worked
        default_overrides={
            **_ALL_MOMENTS_DEFAULTS,
            "model": {**_ALL_MOMENTS_DEFAULTS["model"], "held_policy": True, "success_policy": True},
            "train": {
                **_ALL_MOMENTS_DEFAULTS["train"],
                "c3": 0.1,
                "held_steps": 8_000,
                "clone_steps": 3_000,
                "clone_candidates": 1,
                "clone_reach": 25,
            },
            "controller": {**_ALL_MOMENTS_DEFAULTS["controller"], "held_turn": 8, "success_exponent": 30.0},
        },
    ),
)
"""The six tasks of App. C."""
ROBOT_TASKS = (
    Task(
        name="Sponge",
        env_id="velap/Sponge-v0",
        entry_point="velap.envs.widowx.sponge:Sponge",
        max_steps=150,
        recipe=Recipe(contexts=200, trajectories=1, max_steps=80, expert_radius=0.14),
        behaviours={"gamepad-play": 0.4, "gamepad-purpose": 0.6},
    ),
    Task(
        name="Rope",
        env_id="velap/Rope-v0",
        entry_point="velap.envs.widowx.rope:Rope",
        max_steps=200,
        recipe=Recipe(contexts=150, trajectories=1, max_steps=140, expert_radius=0.12),
        behaviours={"gamepad-play": 0.4, "gamepad-purpose": 0.6},
    ),
)
"""The two tasks of the real robot (App. E.1), in simulation: 200 and 150 episodes of about 15,000 steps together."""
TASKS: Registry[Task] = registry.TASKS
for _task in (*PAPER_TASKS, *ROBOT_TASKS):
    TASKS.add(_task.name, _task)


def get_task(name: str) -> Task:
    """The task of that name; raises UnknownTaskError with the names that exist."""
    return TASKS[name]


def task_of(task_or_dataset: str) -> str:
    """The task that a dataset id belongs to; the id itself where it is a stranger's."""
    name = task_or_dataset.removeprefix("velap/").removesuffix("-v0")
    return name if name in TASKS and task_or_dataset in (name, _dataset_id(name)) else task_or_dataset


def make_config(task: str, preset: str = "default") -> Config:
    """The config of one task and preset: `paper` is Tables 2-10 and nothing else, `default` what we measured to be best.

    `task` may be the id of a foreign dataset or environment: it then gets no overrides.
    """
    if preset not in PRESETS:
        raise UnknownTaskError(f"unknown preset {preset!r}; expected one of {', '.join(PRESETS)}.")
    config = Config(task=task, preset=preset)
    if preset == "paper":
        config = override(config, model=PAPER_MODEL, train=PAPER_TRAIN, planner=PAPER_PLANNER, controller=PAPER_CONTROLLER)
    else:
        config = override(config, train=DEFAULT_TRAIN, controller=DEFAULT_CONTROLLER)
    if task in TASKS:
        config = override(config, **TASKS[task].overrides)
        if preset == "default":
            config = override(config, **TASKS[task].default_overrides)
    return config
