"""Run directories: atomic checksummed files, seeds → generators, metrics that survive a resume. No pickle anywhere."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from velap.errors import CheckpointError, StorageError
from velap.storage import locked, replace_file

CHECKSUM = "sha256"


def make_generator(seed: int, *, stream: int = 0, device: torch.device | str = "cpu") -> torch.Generator:
    """An independent torch generator for (seed, stream)."""
    digest = hashlib.sha256(f"velap/{seed}/{stream}".encode()).digest()
    generator = torch.Generator(device=device)
    generator.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
    return generator


@contextlib.contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turns a failed write into a StorageError that says what to do."""
    try:
        yield
    except OSError as error:
        reason = {errno.ENOSPC: "the disk is full", errno.EDQUOT: "the disk quota is used up"}.get(
            error.errno or 0, os.strerror(error.errno) if error.errno else str(error)
        )
        raise StorageError(
            f"cannot write {path}: {reason}. Nothing was left half-written and the last good file is intact; "
            "free some space or choose another place, then run the same command again to go on."
        ) from error


@contextlib.contextmanager
def only_writer(folder: Path, name: str) -> Iterator[None]:
    """Write the results called `name` into `folder` alone; raises StorageError where another process does so now."""
    with contextlib.ExitStack() as held:
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            try:
                held.enter_context(locked(folder / f".{name}.lock"))
            except BlockingIOError as error:
                raise StorageError(f"another process is writing {name} in {folder}; expected to be alone. Wait for it or "
                                   "stop it, or give another --out.") from error
        yield


def write_atomic(path: Path, content: bytes) -> None:
    """All of `content` or nothing, folders made as needed; raises StorageError."""
    path = Path(path)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, content)


def content_sha256(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """SHA-256 over names, types, shapes, bytes and metadata: safetensors itself loads flipped payload bits silently."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].detach().cpu().contiguous()
        digest.update(f"{name}|{tensor.dtype}|{tuple(tensor.shape)}|".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().tobytes() if tensor.numel() else b"")
    digest.update(json.dumps({k: v for k, v in metadata.items() if k != CHECKSUM}, sort_keys=True).encode())
    return digest.hexdigest()


def save_tensors(path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """Atomic safetensors file whose metadata carries a SHA-256 of everything else; returns that hash."""
    plain = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    digest = content_sha256(plain, metadata)
    write_atomic(path, save(plain, {**metadata, CHECKSUM: digest}))
    return digest


def load_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Tensors and metadata, the checksum verified; raises CheckpointError."""
    path = Path(path)
    if not path.is_file():
        raise CheckpointError(
            f"no checkpoint at {path}; expected a .safetensors file that velap wrote. "
            "Check the path, or train one with `velap train TASK`."
        )
    try:
        with safe_open(str(path), framework="pt") as file:
            metadata = dict(file.metadata() or {})
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - safe_open is no dict
    except (SafetensorError, OSError, ValueError) as error:
        raise CheckpointError(
            f"{path} is not a readable safetensors file ({error}); it is damaged or truncated. "
            "Restore it from a copy, or train again."
        ) from error
    if CHECKSUM not in metadata:
        raise CheckpointError(
            f"{path} carries no checksum; expected a file that velap wrote. Foreign weights are not loaded."
        )
    if content_sha256(tensors, metadata) != metadata[CHECKSUM]:
        raise CheckpointError(
            f"{path} is damaged: its content does not match the SHA-256 it carries. Restore it from a copy, or train again."
        )
    return tensors, metadata
