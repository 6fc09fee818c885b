"""Checkpoints: one safetensors file with weights, config and provenance."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from velap._version import __version__
from velap.config import Config
from velap.errors import CheckpointError, ConfigError
from velap.models.velap import LatentModel, Spaces
from velap.runs import content_sha256, load_tensors, save_tensors, write_atomic
from velap.tasks import get_task

MODEL = "model.safetensors"
"""Name of a checkpoint in its folder."""
PROVENANCE = ("command", "seed", "dataset_id", "dataset_hash", "reading", "train_seconds", "diagnostics", "steps")
"""Metadata of a checkpoint that say where it comes from."""
MODEL_FORMAT = "velap-latent-model/1"
WEIGHTS_SHA256 = "weights_sha256"
"""Metadata key: hash of weights and config alone, the same for the same training however long it took."""
SHARED_SHA256 = "shared_sha256"
"""Metadata key: hash of the weights that heads and other methods share; see `shared_weights`."""
SHARED = ("encoder.", "command_weight", "state_", "action_", "dynamics.", "global_policy.", "global_critic.")
"""Beginnings of the names of weights that heads and other methods act by: φ, g, h, π^g and Q^g; `action_` is g and the
bounds."""
YOUNGER = ("bank_gap", "success_share", "arrival_rates")
"""Tensors that the first files lack."""
FORMER = "held_policy."
"""Beginning of the names of tensors that older files have and today's models do not."""
HALF_ABOVE = 3_000_000
"""Weights larger than this are stored in half precision, which keeps a released file below it [bytes]. ours."""


def shared_weights(metadata: Mapping[str, str]) -> str:
    """Hash of what heads and other methods act by, which their files and records name. The first files have one hash
    only."""
    return metadata.get(SHARED_SHA256, metadata.get(WEIGHTS_SHA256, "none"))


def make_model(config: Config, spaces: Spaces) -> LatentModel:
    """The model of a config with fresh weights."""
    train = config.train
    return LatentModel(config.model, spaces, train.discount, clones=train.clones)


def save_checkpoint(path: Path, model: LatentModel, config: Config, provenance: Mapping[str, str]) -> str:
    """One safetensors file with weights, config and provenance (command, seed, dataset hash); returns its SHA-256."""
    weights = model.state_dict()
    if sum(value.nbytes for value in weights.values()) > HALF_ABOVE:
        weights = {name: value.half() if value.dtype == torch.float32 and value.dim() > 1 else value
                   for name, value in weights.items()}
    shared = {name: value for name, value in weights.items() if name.startswith(SHARED)}
    metadata = {
        **provenance,
        WEIGHTS_SHA256: content_sha256(weights, {"config": config.hash()}),
        SHARED_SHA256: content_sha256(shared, {"model": json.dumps(dataclasses.asdict(config.model), sort_keys=True)}),
        "format": MODEL_FORMAT,
        "config": config.to_json(),
        "spaces": json.dumps(dataclasses.asdict(model.spaces)),
        "code_version": __version__,
    }
    return save_tensors(path, weights, metadata)


def load_checkpoint(path: Path | str, device: torch.device | str = "cpu") -> tuple[LatentModel, Config, dict[str, str]]:
    """Model in eval mode, its config and the metadata, of a file, a run directory or a repository of the Hugging Face hub.

    Raises CheckpointError on anything but an intact velap model.
    """
    path = find_checkpoint(path)
    tensors, metadata = load_tensors(path)
    if metadata.get("format") != MODEL_FORMAT:
        raise CheckpointError(
            f"{path} has format {metadata.get('format')!r}; expected {MODEL_FORMAT!r}. "
            "Give the `model.safetensors` of a run, not its training state."
        )
    config = Config.from_json(metadata["config"])
    raw = json.loads(metadata["spaces"])
    tuples = {name: tuple(value) for name, value in raw.items() if isinstance(value, list)}
    spaces = Spaces(**{**raw, **tuples})
    model = make_model(config, spaces)
    restore(model, tensors, path)
    return model.to(device).eval().requires_grad_(False), config, metadata


def find_checkpoint(place: Path | str) -> Path:
    """The checkpoint file that a path, a folder or an id of the Hugging Face hub names; raises CheckpointError."""
    path = Path(place)
    if path.exists() or path.as_posix().count("/") != 1 or path.suffix:
        return path / MODEL if path.is_dir() else path
    try:
        from huggingface_hub import hf_hub_download  # type: ignore[import-not-found]
        from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError  # type: ignore[import-not-found]
    except ImportError as error:
        raise CheckpointError(f"found no file or folder {place}, and the package huggingface-hub, which would look for "
                              f"{place} on the Hugging Face hub, is not installed; expected one of them. Check the path, "
                              "or `pip install huggingface-hub`.") from error
    try:
        return Path(hf_hub_download(str(place), MODEL))
    except (HfHubHTTPError, LocalEntryNotFoundError) as error:
        raise CheckpointError(f"found no file or folder {place}, and no {MODEL} in a repository {place} of the Hugging "
                              f"Face hub ({error}); expected one of them. Check the name and the connection.") from error


def save_folder(model: LatentModel, folder: Path, config: Config | None) -> Path:
    """`LatentModel.save_pretrained`."""
    if config is None and model.origin is None:
        raise ConfigError("the model was not made by from_pretrained and got no config; expected one of them. Give the "
                          "config of its training.")
    provenance = dict(model.origin.metadata) if model.origin is not None else {}
    kept = {name: provenance[name] for name in PROVENANCE if name in provenance}
    whole = config or (model.origin.config if model.origin is not None else None)
    assert whole is not None, "checked above"
    save_checkpoint(folder / MODEL, model, whole, kept)
    write_atomic(folder / "config.json", whole.to_json().encode())
    return folder / MODEL


def restore(module: nn.Module, tensors: Mapping[str, Tensor], path: Path | str) -> None:
    """Load weights into a module built from the file's own config; raises CheckpointError where names or shapes differ."""
    expected = module.state_dict()
    tensors = {**{name: expected[name] for name in YOUNGER if name in expected},
               **{name: value for name, value in tensors.items() if not name.startswith(FORMER)}}
    wrong = sorted(
        name
        for name in expected.keys() | tensors.keys()
        if name not in tensors or name not in expected or tensors[name].shape != expected[name].shape
    )
    if wrong:
        raise CheckpointError(
            f"{path} does not fit its own config: {len(wrong)} tensors differ, {wrong[0]} first. "
            "The file comes from another version of velap; train again."
        )
    module.load_state_dict(tensors)


def released_checkpoint(task: str) -> Path:
    """The checkpoint of a task that is shipped with the package; in a checkout the package links to `checkpoints/`."""
    path = Path(__file__).resolve().parents[1] / "checkpoints" / f"{get_task(task).name}.safetensors"
    if not path.is_file():
        raise CheckpointError(f"no released checkpoint of {task}: expected it at {path}. Train one with "
                              f"`velap run {task}`, or name one with --checkpoint.")
    return path.resolve()
