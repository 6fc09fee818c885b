"""Environments: an import registers the tasks of the paper; physics and drawing load on `gymnasium.make`."""

from __future__ import annotations

import gymnasium

from velap.tasks import PAPER_TASKS, ROBOT_TASKS


def register_tasks() -> None:
    """Register the tasks that Gymnasium does not know yet. Their time limits truncate, they do not terminate."""
    for task in (*PAPER_TASKS, *ROBOT_TASKS):
        if task.env_id not in gymnasium.registry:
            gymnasium.register(
                id=task.env_id, entry_point=task.entry_point, max_episode_steps=task.max_steps, disable_env_checker=True
            )


register_tasks()
