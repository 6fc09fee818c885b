"""A run of several phases: what it writes, exact resume, what may follow a finished run, what is refused."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

from tiny_training import SMALL, config, make, make_store, straight_and_resumed, to_end, trainer
from velap.data.frames import Reading
from velap.errors import CheckpointError, ConfigError, DatasetError, StorageError
from velap.models.checkpoint import load_checkpoint
from velap.runs import load_tensors
from velap.training.loop import MODEL, STATE, Trainer, train
from velap.training.steps import interrupt_flag


@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize(("encoder", "stop"), [(0, 2), (0, 6), (0, 10), (3, 2), (3, 3), (3, 4)])
def test_resume_goes_on_to_the_same_bits(tmp_path, norm, encoder, stop):
    settings = config(dataclasses.replace(SMALL, norm=norm), joint={"reconstruction_side": 16}, encoder={"steps": encoder})
    straight, _ = straight_and_resumed(tmp_path, settings, stop)
    assert straight.finish("x").sha256  # the measured latents and the bank complete the model


@pytest.mark.parametrize("stop", [1, 2, 3])
def test_a_training_without_joint_phase_resumes_to_the_same_bits(tmp_path, stop):
    settings = config(dataclasses.replace(SMALL, command_dims=3), encoder={"steps": 2}, joint={"steps": 0},
                      latent={"steps": 3})
    straight_and_resumed(tmp_path, settings, stop)


def test_train_writes_a_loadable_model_and_readable_metrics(tmp_path):
    seen, store = [], make_store()
    result = train(config(), store, tmp_path, device="cpu", on_progress=seen.append, command="velap train test")
    model, loaded, metadata = load_checkpoint(result.checkpoint)
    assert loaded == config() and metadata["command"] == "velap train test" and metadata["dataset_hash"] == "abc"
    assert Reading.from_json(metadata["reading"]) == make_store().reading
    assert model.success_share == pytest.approx(np.mean([
        store.rewards[first : first + length].any()
        for first, length in zip(store.episode_start, store.episode_length, strict=True)]))
    assert result.checkpoint.name == MODEL and model.step_distance > 0 and (model.bank_rows >= 0).all()
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6, 8, 10, 12]
    assert "rollout/error_3" in rows[-1] and [row["phase"] for row in rows] == ["joint"] * 3 + ["latent"] * 3
    assert [p.step for p in seen] == [2, 4, 6, 8, 10, 12]
    assert json.loads((tmp_path / "config.json").read_text())["schema"] == 4
    assert any((tmp_path / "tensorboard").iterdir())


class Kept:
    """A logger of the user's own."""

    def __init__(self):
        self.rows, self.closed = [], False

    def log(self, step, phase, seconds, values):
        self.rows.append((step, phase, set(values)))

    def close(self):
        self.closed = True


def test_a_training_that_fails_closes_its_loggers(tmp_path):
    def fail(progress):
        raise OverflowError

    kept, threads = Kept(), threading.active_count()
    with pytest.raises(OverflowError):
        train(config(), make_store(), tmp_path, device="cpu", loggers=["tensorboard", kept], on_progress=fail)
    assert kept.closed and threading.active_count() == threads


def test_loggers_are_the_callers(tmp_path):
    kept = Kept()
    train(config(), make_store(), tmp_path, device="cpu", loggers=[kept])
    assert [row[0] for row in kept.rows] == [2, 4, 6, 8, 10, 12] and kept.closed and "global/q" in kept.rows[0][2]
    assert not (tmp_path / "tensorboard").exists() and not (tmp_path / "metrics.jsonl").exists()
    with pytest.raises(ConfigError, match=r"unknown logger 'tensorbord'.*tensorboard"):
        train(config(), make_store(), tmp_path / "other", device="cpu", loggers=["tensorbord"])


@pytest.fixture(autouse=True)
def heard_signals() -> Iterator[None]:
    """Signals as in the foreground of a shell: `nohup` and background jobs ignore some, which velap respects."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGXCPU])
def test_a_signal_saves_the_state_and_gives_the_handlers_back(tmp_path, number):
    before = signal.getsignal(number)

    def stop(progress):
        if progress.step == 4:
            os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt):
        train(config(), make_store(), tmp_path, device="cpu", on_progress=stop)
    assert load_tensors(tmp_path / STATE)[1]["step"] == "4" and signal.getsignal(number) == before
    train(config(), make_store(), tmp_path, device="cpu", resume=True)
    rows = [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert rows == [2, 4, 6, 8, 10, 12]


def test_a_second_signal_acts_at_once():
    with interrupt_flag() as flag:
        os.kill(os.getpid(), signal.SIGINT)
        assert flag.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_clusters_may_send_their_signal_again_while_the_state_is_saved(tmp_path):
    def stop(progress):
        if progress.step == 4:
            os.kill(os.getpid(), signal.SIGUSR1)
            os.kill(os.getpid(), signal.SIGTERM)
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(KeyboardInterrupt):
        train(config(), make_store(), tmp_path, device="cpu", on_progress=stop)
    assert load_tensors(tmp_path / STATE)[1]["step"] == "4"


def test_ignored_signals_stay_ignored():
    """`nohup velap train` outlives its terminal."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interrupt_flag() as flag:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not flag.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_one_training_at_a_time_in_a_folder(tmp_path):
    refused = []

    def again(progress):
        with pytest.raises(StorageError, match=r"another process is writing a training.*--out"):
            train(config(), make_store(), tmp_path, device="cpu", seed=1)
        refused.append(progress.step)

    train(config(), make_store(), tmp_path, device="cpu", on_progress=again)
    rows = [json.loads(line)["step"] for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert rows == refused == [2, 4, 6, 8, 10, 12] and not list(tmp_path.glob(".*lock"))


def test_foreign_and_existing_runs_are_refused(tmp_path):
    train(config(), make_store(), tmp_path, device="cpu")
    with pytest.raises(CheckpointError, match="--resume"):
        train(config(), make_store(), tmp_path, device="cpu")
    with pytest.raises(CheckpointError, match="another config"):
        train(config(c0=0.3), make_store(), tmp_path, device="cpu", resume=True)
    with pytest.raises(CheckpointError, match="another seed"):
        train(config(), make_store(), tmp_path, device="cpu", resume=True, seed=1)


def test_cadences_may_change_with_a_resume(tmp_path):
    run = trainer(tmp_path)
    run.update()
    run.save()
    again = trainer(tmp_path, log_every=7, checkpoint_every=3)
    again.resume()
    assert again.step == 1 and config(log_every=7).hash() == config().hash()


def test_phases_that_have_begun_cannot_change(tmp_path):
    run = trainer(tmp_path)
    for _ in range(7):
        run.update()
    run.save()
    for changes in ({"joint": {"steps": 8}}, {"latent": {"steps": 5}}, {"encoder": {"steps": 2}}):
        with pytest.raises(CheckpointError, match="has begun the phases"):
            trainer(tmp_path, **changes).resume()


def test_phases_to_come_may_change(tmp_path):
    run = trainer(tmp_path)
    for _ in range(6):
        run.update()
    run.save()
    other = trainer(tmp_path, latent={"steps": 2})
    other.resume()
    assert (other.step, other.total) == (6, 8)
    to_end(other)


def test_a_finished_run_can_be_given_more_phases(tmp_path):
    more = {"values": {"steps": 3}}
    whole, first = to_end(trainer(tmp_path / "whole", **more)), to_end(trainer(tmp_path / "first"))
    first.save()
    again = trainer(tmp_path / "first", **more)
    again.resume()
    assert (again.step, again.total) == (12, 15)
    to_end(again)
    for (name, a), b in zip(whole.model.state_dict().items(), again.model.state_dict().values(), strict=True):
        assert torch.equal(a, b), name


def test_states_of_another_version_are_refused_with_the_way_out(tmp_path):
    run = trainer(tmp_path)
    run.save()
    tensors, metadata = load_tensors(tmp_path / STATE)
    from velap.runs import save_tensors

    save_tensors(tmp_path / STATE, tensors, {**metadata, "format": "velap-training-state/1"})
    with pytest.raises(CheckpointError, match=r"velap-training-state/1.*start a new run elsewhere with --out"):
        trainer(tmp_path).resume()


def test_short_episodes_are_an_error(tmp_path):
    with pytest.raises(DatasetError, match="longest episode has 2 steps"):
        Trainer(config(), make_store(length=2), tmp_path, 0, torch.device("cpu"))


@pytest.mark.parametrize("damage", ["truncate", "flip", "foreign"])
def test_damaged_checkpoints_are_refused(tmp_path, damage):
    train(config(), make_store(), tmp_path, device="cpu")
    path = tmp_path / MODEL
    raw = bytearray(path.read_bytes())
    if damage == "truncate":
        raw = raw[: len(raw) // 2]
    elif damage == "flip":
        raw[-20] ^= 4
    else:
        raw = bytearray((tmp_path / STATE).read_bytes())
    path.write_bytes(bytes(raw))
    with pytest.raises(CheckpointError):
        load_checkpoint(path)


def test_state_holds_no_pickle(tmp_path):
    train(config(), make_store(), tmp_path, device="cpu")
    tensors, metadata = load_tensors(tmp_path / STATE)
    assert metadata["step"] == "12" and "generator" in tensors


def test_weights_hash_does_not_depend_on_how_long_training_took(tmp_path):
    hashes = []
    for name, seconds in (("a", 1.0), ("b", 2.0)):
        run = make(tmp_path / name, config())
        run.update()
        run.seconds = seconds
        run.finish(f"velap train {name}")
        hashes.append(load_tensors(tmp_path / name / MODEL)[1])
    assert hashes[0]["weights_sha256"] == hashes[1]["weights_sha256"]
    assert hashes[0]["sha256"] != hashes[1]["sha256"]


def test_held_out_frames_that_never_change_have_no_step_length(tmp_path: Path) -> None:
    store = make_store(episodes=40)
    still = dataclasses.replace(store, frames=np.zeros_like(store.frames))
    report = Trainer(config(), still, tmp_path, seed=0, device=torch.device("cpu")).report()
    assert report["latent/step"] == 0
    assert np.isnan(report["rollout/error_1"])
