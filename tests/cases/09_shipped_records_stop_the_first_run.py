"""In a fresh clone one's own checkpoint, of other weights than the authors', meets the records that are shipped.

Weights differ with threads and CPU, so the checkpoint hash differs on another machine (cf. huggingface/transformers#1187).
"""

import shutil
from pathlib import Path

import torch
from case import CHECKOUT, run, verdict

from velap.models.checkpoint import load_checkpoint, save_checkpoint

shutil.copytree(CHECKOUT / "results", "results")
model, config, metadata = load_checkpoint(CHECKOUT / "checkpoints/SpiralMaze.safetensors")
with torch.no_grad():
    next(model.parameters()).add_(1e-6)  # the same recipe on another machine
kept = ("command", "seed", "dataset_id", "dataset_hash", "train_seconds", "steps")
own = Path("runs/SpiralMaze/default/seed0/model.safetensors")
save_checkpoint(own, model, config, {name: value for name, value in metadata.items() if name in kept})
code, text = run("evaluate", "SpiralMaze", "--checkpoint", own, "--episodes", 2)
verdict(code == 0 and "--fresh" in run("run", "--help")[1], "one's own records elsewhere, and `velap run --fresh`")
