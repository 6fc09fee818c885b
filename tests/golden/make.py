"""Writes the golden files beside it from the code at hand: `python make.py [traces] [losses] [checkpoints] [old]`.

Run it only where what it writes is meant to change; README.md says from which commit the files come.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

GOLDEN = Path(__file__).resolve().parent
sys.path[:0] = [str(GOLDEN.parent)]
os.environ["OMP_NUM_THREADS"] = "1"

import torch  # noqa: E402

import golden_access as velap  # noqa: E402

TASKS = ("SpiralMaze", "ObstacleMaze", "WindowClose", "FaucetClose", "ButtonWall", "DrawerButton")
SEEDS = (1000, 1001)
"""Validation seeds."""
STEPS = {"velap": 60, "mppi": 6, "mbop": 6, "iris": 21, "iris-multistep": 21}
"""Steps of a trace, so that every method that plans does so at least twice; 12 where nothing is said."""
ONE_SEED = ("mppi", "mbop", "iris", "iris-multistep")
"""Methods whose plans are slow or whose head is random: one seed."""
RECORDED = (1, 2, 5, 10, 20)
"""Updates whose losses are kept."""


def traces() -> dict[str, Any]:
    """{task: {method: {seed: actions [T, A]}}}."""
    found: dict[str, Any] = {}
    with velap.pytorch_networks():
        for task in TASKS:
            for method in velap.ALL_METHODS:
                seeds = SEEDS[:1] if method in ONE_SEED else SEEDS
                steps = STEPS.get(method, 12)
                found.setdefault(task, {})[method] = {
                    str(seed): velap.trace(task, method, seed, steps).tolist() for seed in seeds}
    return found


def losses() -> dict[str, Any]:
    """{case: {update: {name: value}}}; `report` of a head is its held-out losses after the last update."""
    found: dict[str, Any] = {}
    with velap.pytorch_networks(), tempfile.TemporaryDirectory() as folder:
        for case in velap.PHASES:
            seen = velap.phase_losses(case, Path(folder) / case)
            found[case] = {str(update): _rounded(seen[update - 1]) for update in RECORDED}
        for method in velap.HEADED:
            *seen, report = velap.head_losses(method, Path(folder) / method)
            found[f"head-{method}"] = {str(update): _rounded(seen[update - 1]) for update in RECORDED}
            found[f"head-{method}"]["report"] = _rounded(report)
    return found


def checkpoints() -> dict[str, Any]:
    """{task: facts}."""
    return {task: velap.checkpoint_facts(task) for task in TASKS}


def old() -> None:
    """An unfinished and a finished run, a head, and records, as this code writes them."""
    with velap.pytorch_networks(), tempfile.TemporaryDirectory() as scratch:
        unfinished = velap.train_old(Path(scratch) / "unfinished", stop=velap.OLD_STOP)
        finished = velap.train_old(Path(scratch) / "finished")
        checkpoint = finished / "model.safetensors"
        velap.train_old_head(checkpoint, "bc")
        kept = {
            "unfinished": [unfinished / "state.safetensors", unfinished / "config.json", unfinished / "metrics.jsonl"],
            "finished": [finished / "config.json", finished / "metrics.jsonl", checkpoint, finished / "bc.safetensors"],
        }
        for method in ("velap", "bc"):
            records = velap.evaluate_old(checkpoint, Path(scratch) / "records", method)
            kept[f"records/{records.parent.relative_to(Path(scratch) / 'records')}"] = [records]
        shutil.rmtree(GOLDEN / "old", ignore_errors=True)
        for folder, paths in kept.items():
            (GOLDEN / "old" / folder).mkdir(parents=True)
            for path in paths:
                shutil.copy(path, GOLDEN / "old" / folder)


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.7g}") for name, value in values.items()}


def _write(name: str, content: dict[str, Any]) -> None:
    """JSON with one line for each entry of the two outer levels."""
    lines = []
    for key, inner in content.items():
        rows = [f" {json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}" for name, value in inner.items()]
        lines.append(f"{json.dumps(key)}: {{\n" + ",\n".join(rows) + "\n}")
    (GOLDEN / name).write_text("{\n" + ",\n".join(lines) + "\n}\n")


if __name__ == "__main__":
    torch.set_num_threads(1)
    asked = sys.argv[1:] or ["traces", "losses", "checkpoints", "old"]
    for part, make in {"traces": traces, "losses": losses, "checkpoints": checkpoints}.items():
        if part in asked:
            _write(f"{part}.json", make())
    if "old" in asked:
        old()
