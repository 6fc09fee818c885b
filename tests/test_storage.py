"""Two processes in one place: one holds the lock, the other is refused or waits; what both need is made once."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from latent_data import joint_checkpoint, noise_store
from tiny_training import make_store
from velap.data.mapped import open_or_build
from velap.errors import StorageError
from velap.evaluation.records import record_path
from velap.methods.learning import train_head
from velap.storage import locked, run_dir
from velap.training import frozen


def test_every_id_is_a_folder_on_every_system() -> None:
    assert run_dir("my_package:Robot-v0", "default", 0) == Path("runs/my_package_Robot-v0/default/seed0")
    assert run_dir(r"C:\data\robot.npz", "default", 0) == Path("runs/C__data_robot.npz/default/seed0")
    records = record_path(Path("r"), "../other:Env-v0", "velap", "default", 1)
    assert records == Path("r/.._other_Env-v0/velap-default/train1.jsonl")


def test_a_lock_has_one_holder_however_often_it_changes_hands(tmp_path: Path) -> None:
    command = [sys.executable, Path(__file__).with_name("lock_turns.py"), tmp_path / "lock", "10", "60"]
    with contextlib.ExitStack() as running:
        workers = [running.enter_context(subprocess.Popen(command, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE))
                   for _ in range(3)]
        assert [worker.stdout.readline() for worker in workers] == ["ready\n"] * 3  # type: ignore[union-attr]
        for worker in workers:
            worker.stdin.close()  # type: ignore[union-attr]  # all begin at once
        assert [worker.stdout.read() for worker in workers] == ["10 0\n"] * 3  # type: ignore[union-attr]
    assert list(tmp_path.iterdir()) == []


def test_one_lock_is_refused_and_waited_for(tmp_path: Path) -> None:
    entered = threading.Event()

    def wait() -> None:
        with locked(tmp_path / "lock", wait=True):
            entered.set()

    with locked(tmp_path / "lock"):
        with pytest.raises(BlockingIOError), locked(tmp_path / "lock"):
            pass
        waiting = threading.Thread(target=wait)
        waiting.start()
        assert not entered.wait(0.3)
    waiting.join(timeout=20)
    assert entered.is_set()


def test_mapped_frames_are_made_once_for_all_that_want_them(tmp_path: Path) -> None:
    built: list[int] = []

    def build(path: Path | None) -> frozen.FrameStore:
        built.append(1)
        store = make_store()
        assert path is not None
        path.write_bytes(store.frames.tobytes())
        return store

    hashes: list[str] = []
    place = tmp_path / "data" / "mapped"
    threads = [threading.Thread(target=lambda: hashes.append(open_or_build(build, place, "noise").content_hash))
               for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert (len(built), hashes) == (1, [make_store().content_hash] * 4)


def test_latents_are_encoded_once_for_heads_that_are_learnt_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = noise_store(successes=10)
    checkpoint, encoded, encode = joint_checkpoint(tmp_path / "model.safetensors", store), [], frozen.encode_all
    monkeypatch.setattr(frozen, "encode_all", lambda *given: encoded.append(1) or encode(*given))
    threads = [threading.Thread(target=train_head, args=(method, checkpoint, store), kwargs={"steps": 4, "loggers": []})
               for method in ("bc", "iql", "bc-success")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout=60)
    assert len(encoded) == 1 and all((tmp_path / f"{method}.safetensors").exists() for method in ("bc", "iql", "bc-success"))


def test_one_training_of_a_head_at_a_time(tmp_path: Path) -> None:
    store, refused = noise_store(successes=10), []
    checkpoint = joint_checkpoint(tmp_path / "model.safetensors", store)

    def again(progress: object) -> None:
        with pytest.raises(StorageError, match="another process is writing bc"):
            train_head("bc", checkpoint, store, steps=4, loggers=[])
        refused.append(progress)

    train_head("bc", checkpoint, store, steps=4, on_progress=again)
    assert refused
