"""`velap info`: what is installed and what this machine offers, for bug reports."""

from __future__ import annotations

from velap.cli.options import say
from velap.errors import VelapError

PACKAGES = ("torch", "gymnasium", "mujoco", "metaworld", "minari", "numpy", "safetensors")


def info() -> None:
    """Versions, tasks and what this machine offers."""
    import os
    import platform
    from importlib.metadata import version

    import torch

    import velap.envs  # noqa: F401 - registers the tasks
    from velap.data.minari_io import dataset_path
    from velap.evaluation.evaluate import code_version
    from velap.native.kernels import library
    from velap.tasks import TASKS

    cuda = torch.cuda.get_device_name() if torch.cuda.is_available() else "none"
    say(f"velap {code_version()}, Python {platform.python_version()}, {platform.platform()}")
    say(", ".join(f"{name} {version(name)}" for name in PACKAGES))
    say(f"{os.cpu_count()} cores, {torch.get_num_threads()} torch threads, CUDA device: {cuda}")
    say("planning on the CPU: " + ("kernels.c" if library() else "PyTorch (kernels.c is off or could not be built)"))
    for task in TASKS.values():
        path = dataset_path(task.dataset_id)
        say(f"task {task.name}: environment {task.env_id} ({_drawing(task.env_id)}), dataset {task.dataset_id} "
            f"({f'in {path}' if path.exists() else 'not collected'})")


def _drawing(env_id: str) -> str:
    """Whether the environment's first frame can be drawn."""
    import gymnasium

    try:
        env = gymnasium.make(env_id)
        env.reset(seed=0)
        env.close()
    except VelapError as error:
        return f"does not draw: {error}"
    return "draws"
