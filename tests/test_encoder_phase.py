"""The encoder phase: pairs of states and the actions between them, what moves, and an encoder of somebody else's."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from torch import Tensor

from tiny_training import SMALL, config, make, make_store, moved, straight_and_resumed, to_end, trainer, weights
from velap.config import ModelConfig
from velap.errors import UnknownTaskError
from velap.models.checkpoint import load_checkpoint
from velap.models.encoders.base import Encoder
from velap.registry import ENCODERS, register_encoder
from velap.training.encoder import draw_pairs
from velap.training.loop import Trainer


def test_the_encoder_phase_moves_the_encoder_alone_and_the_others_follow(tmp_path):
    run = trainer(tmp_path, encoder={"steps": 2}, joint={"steps": 2}, latent={"steps": 1})
    before = weights(run.model)
    phases, losses = [], []
    for _ in range(run.total):
        losses.append(set(run.update()))
        phases.append(run.phase)
        if len(phases) == 2:
            assert moved(before, run.model) == {"encoder"}
    assert phases == ["encoder", "encoder", "joint", "joint", "latent"]
    assert losses[1] == {"encoder/displacement", "encoder/reconstruction"} and "local/loss" in losses[2] & losses[4]
    assert run.model.state_dict().keys() == before.keys(), "what taught the encoder is thrown away"
    plain = trainer(tmp_path / "plain")
    for a, b in zip(plain.model.parameters(), trainer(tmp_path / "b", encoder={"steps": 2}).model.parameters(), strict=True):
        assert torch.equal(a, b), "the phase must not touch the model's first weights"


def test_pairs_lie_in_one_training_episode_and_know_their_actions(tmp_path, monkeypatch):
    monkeypatch.setattr("velap.training.encoder.REACH", 3)
    run = trainer(tmp_path, encoder={"steps": 2})
    run.update()
    sampler, before = run.sampler, run.learner.before
    now, then = draw_pairs(sampler, 500, run.run.generator)
    assert torch.equal(sampler.first[now], sampler.first[then])
    assert set((then - now).tolist()) == {1, 2, 3}
    held_out = run.store.episode_start[run.holdout][0]
    assert not torch.isin(sampler.first[now], torch.tensor([held_out])).any()
    sums = before[then] - before[now]
    for a, b, total in zip(now[:20].tolist(), then[:20].tolist(), sums[:20], strict=True):
        assert torch.allclose(sampler.actions[a:b].sum(0).double(), total, atol=1e-6)


def test_pairs_teach_where_the_agent_went(tmp_path, monkeypatch):
    """Frames that show a dot at the sum of all actions: the error of the summed actions falls."""
    monkeypatch.setattr("velap.training.encoder.LEARNING_RATE", 3e-3)
    store = make_store(episodes=40)
    place = np.zeros((len(store.frames), 2), int)
    for start, length in zip(store.episode_start, store.episode_length, strict=True):
        place[start : start + length + 1] = 8
        walked = np.cumsum(store.actions[start : start + length, :2] * 0.8, 0)
        place[start + 1 : start + length + 1] = (8 + walked).round().clip(1, 14)
    store.frames[:] = 0
    for row, (x, y) in enumerate(place):
        store.frames[row, y - 1 : y + 2, x - 1 : x + 2] = 255
    run = Trainer(config(encoder={"steps": 150}), store, tmp_path, 0, torch.device("cpu"))
    errors = [float(run.update()["encoder/displacement"]) for _ in range(150)]
    assert np.mean(errors[-20:]) < 0.75 * np.mean(errors[:10])


@pytest.fixture
def random_features():
    """A stranger's encoder: frozen random features of the newest frame."""

    @register_encoder("random-features")
    class RandomFeatures(Encoder):
        def __init__(self, config: ModelConfig, size: tuple[int, int]) -> None:
            super().__init__()
            drawn = torch.randn(3 * size[0] * size[1], 6, generator=torch.Generator().manual_seed(1))
            self.register_buffer("weight", drawn / 1000)

        @classmethod
        def width(cls, config: ModelConfig) -> int:
            return 6

        def features(self, frames: Tensor) -> Tensor:
            return torch.tanh(frames.flatten(1).float() @ self.weight / 10)

        def encode(self, stacks: Tensor) -> Tensor:
            return stacks[:, -1]

    yield "random-features"
    ENCODERS._entries.pop("random-features")


def test_a_strangers_encoder_trains_in_every_phase_and_is_read_again(tmp_path, random_features):
    settings = config(dataclasses.replace(SMALL, encoder=random_features, command_dims=2), encoder={"steps": 2})
    straight, _ = straight_and_resumed(tmp_path, settings, 5)
    model, again, _ = load_checkpoint(straight.finish("x").checkpoint)
    assert again == settings
    frames = torch.from_numpy(make_store().frames[:4]).unflatten(0, (2, 2))
    assert model.encode(frames).shape == (2, 6 + 2)
    torch.testing.assert_close(model.encode(frames)[:, :6], model.encoder.features(frames[:, -1]))


def test_an_unknown_encoder_names_those_that_exist(tmp_path):
    with pytest.raises(UnknownTaskError, match=r"unknown encoder 'dino'.*conv"):
        make(tmp_path, config(dataclasses.replace(SMALL, encoder="dino")))


def test_frames_of_any_prefix_are_encoded_alike(tmp_path):
    model = to_end(trainer(tmp_path)).model.eval()
    frames = torch.from_numpy(make_store().frames[:12]).view(2, 3, 2, 16, 16, 3)
    torch.testing.assert_close(model.encode(frames)[1], model.encode(frames[1]))
