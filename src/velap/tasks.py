"""Tasks: environment, dataset recipe (Table 10) and time limit. `velap.config.presets` has the config of each (Tables 7-9).

The six of App. C and the two of App. E.1 are here. Add your own by `velap.register_task("Mine")(Task(...))`, or by an entry
point of the group `velap.tasks`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from velap import registry
from velap.config import Config, override
from velap.config.presets import PRESETS as PRESETS
from velap.config.presets import preset_config
from velap.registry import Registry


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
    overrides: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Config fields by part in which the task differs from the preset for data of no task of ours."""

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


PAPER_TASKS = (
    Task(
        name="SpiralMaze",
        env_id="velap/SpiralMaze-v0",
        entry_point="velap.envs.mazes.env:SpiralMaze",
        max_steps=300,
        recipe=Recipe(contexts=1, trajectories=1000, max_steps=20, success_percent=0.12),
    ),
    Task(
        name="ObstacleMaze",
        env_id="velap/ObstacleMaze-v0",
        entry_point="velap.envs.mazes.obstacle:ObstacleMaze",
        max_steps=100,
        recipe=Recipe(contexts=250, trajectories=20, max_steps=20, success_percent=0.11),
    ),
    Task(
        name="WindowClose",
        env_id="velap/WindowClose-v0",
        entry_point="velap.envs.sawyer.tasks:WindowClose",
        max_steps=150,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.48, expert_radius=0.2),
        behaviours={"random-walk": 0.43, "noisy-expert": 0.57},
    ),
    Task(
        name="FaucetClose",
        env_id="velap/FaucetClose-v0",
        entry_point="velap.envs.sawyer.tasks:FaucetClose",
        max_steps=150,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.31, expert_radius=0.2),
        behaviours={"random-walk": 0.41, "noisy-expert": 0.59},
    ),
    Task(
        name="ButtonWall",
        env_id="velap/ButtonWall-v0",
        entry_point="velap.envs.sawyer.tasks:ButtonWall",
        max_steps=250,
        recipe=Recipe(contexts=200, trajectories=10, max_steps=50, success_percent=0.16, expert_radius=0.2),
        behaviours={"random-walk": 0.835, "noisy-expert": 0.165},
    ),
    Task(
        name="DrawerButton",
        env_id="velap/DrawerButton-v0",
        entry_point="velap.envs.sawyer.tasks:DrawerButton",
        max_steps=150,
        recipe=Recipe(contexts=150, trajectories=20, max_steps=50, success_percent=0.16, expert_radius=0.2),
        behaviours={"random-walk": 0.7, "noisy-expert": 0.3},
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
    """The config of a task in a preset; `task` may be the id of a foreign dataset or environment.

    Raises UnknownTaskError for an unknown preset.
    """
    config = preset_config(task, preset)
    return override(config, **TASKS[task].overrides) if task in TASKS else config
