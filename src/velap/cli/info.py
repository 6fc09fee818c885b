"""What is installed and what this machine offers, for bug reports."""

from __future__ import annotations

import os
import platform
from importlib.metadata import version

import gymnasium
import torch

import velap.envs  # noqa: F401 - registers the tasks
from velap.data.minari_io import dataset_path
from velap.errors import VelapError
from velap.evaluation.evaluate import code_version
from velap.native.kernels import library
from velap.tasks import TASKS

PACKAGES = ("torch", "gymnasium", "mujoco", "metaworld", "minari", "numpy", "safetensors")


def describe() -> str:
    """Several lines: versions, devices, drawing, tasks with their datasets."""
    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    lines = [
        f"velap {code_version()}, Python {platform.python_version()}, {platform.platform()}",
        ", ".join(f"{name} {version(name)}" for name in PACKAGES),
        f"{os.cpu_count()} cores, {torch.get_num_threads()} torch threads, CUDA device: {cuda}",
        "planning on the CPU: " + ("kernels.c" if library() else "PyTorch (kernels.c is off or could not be built)"),
    ]
    for task in TASKS.values():
        path = dataset_path(task.dataset_id)
        lines.append(f"task {task.name}: environment {task.env_id} ({_drawing(task.env_id)}), dataset {task.dataset_id} "
                     f"({f'in {path}' if path.exists() else 'not collected'})")
    return "\n".join(lines)


def _drawing(env_id: str) -> str:
    """Whether the environment's first frame can be drawn."""
    try:
        env = gymnasium.make(env_id)
        env.reset(seed=0)
        env.close()
    except VelapError as error:
        return f"does not draw: {error}"
    return "draws"
