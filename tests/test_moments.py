"""Colour moments: what they say of pictures with known contents, slow features of them, and an encoder that takes them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from tiny_training import SMALL, config, make, make_store, straight_and_resumed
from velap.data.sampling import WindowSampler
from velap.models.checkpoint import load_checkpoint
from velap.models.encoders.moments import KEPT_LIMIT, KEPT_SCALE, LAG, LIMIT, ColourMoments, MomentEncoder, slow_features
from velap.models.velap import LatentModel, Spaces
from velap.training.encoding import encode_all, encode_rows

WHOLLY, SLOWLY = (dataclasses.replace(SMALL, encoder=name) for name in ("moments", "slow-moments"))
GREY, RED, BLUE = (90, 90, 90), (200, 20, 20), (20, 20, 200)


def pictures(corners: list[tuple[int, int]], side: int = 32, block: int = 6) -> np.ndarray:
    """A red block on grey at each (row, column)."""
    frames = np.full((len(corners), side, side, 3), GREY, np.uint8)
    for frame, (row, column) in zip(frames, corners, strict=True):
        frame[row : row + block, column : column + block] = RED
    return frames


def fitted(frames: np.ndarray, colours: int) -> ColourMoments:
    moments = ColourMoments(colours, frames.shape[1:3])
    moments.fit(frames, 0)
    return moments


def red_of(moments: ColourMoments, frames: np.ndarray) -> torch.Tensor:
    """Area's root, x, y, three spreads of the red block: [M, 6]."""
    red = int(moments.palette[tuple(channel >> 3 for channel in RED)])
    return moments.measure(torch.from_numpy(frames)).view(len(frames), 6, moments.colours)[..., red]


def test_moments_are_area_centre_and_spread():
    frames = pictures([(10, 4), (10, 5), (20, 4)], block=10)
    first, right, below = red_of(fitted(frames, 2), frames)
    assert first[0] == pytest.approx(10.0)
    pixel, drawn = 2 / 31, 100 / 103  # the middle of the picture counts as 3 pixels
    assert first[1] == pytest.approx(drawn * ((4 + 4.5) * pixel - 1), abs=1e-5)
    assert first[2] == pytest.approx(drawn * ((10 + 4.5) * pixel - 1), abs=1e-5)
    assert right[1] - first[1] == pytest.approx(drawn * pixel, abs=1e-5)
    assert right[2] == pytest.approx(float(first[2]), abs=1e-6)
    assert below[2] - first[2] == pytest.approx(10 * drawn * pixel, abs=1e-5)
    xs = np.linspace(-1, 1, 32)[4:14]
    assert first[3] == pytest.approx(drawn * np.square(xs).mean() - float(first[1]) ** 2, abs=1e-5)
    ys = np.linspace(-1, 1, 32)[10:20]
    assert first[4] == pytest.approx(drawn * np.square(ys).mean() - float(first[2]) ** 2, abs=1e-5)
    assert first[5] == pytest.approx(drawn * xs.mean() * ys.mean() - float(first[1] * first[2]), abs=1e-5)


def test_a_colour_that_is_not_there_is_in_the_middle():
    moments = fitted(np.concatenate([pictures([(4, 4)]), np.full((1, 32, 32, 3), BLUE, np.uint8)]), 3)
    red = red_of(moments, np.full((1, 32, 32, 3), GREY, np.uint8))
    torch.testing.assert_close(red, torch.zeros(1, 6))


def test_moments_are_standardised_over_the_sample_and_bounded():
    rng = np.random.default_rng(0)
    frames = pictures([tuple(rng.integers(0, 26, 2)) for _ in range(200)])
    moments = fitted(frames, 2)
    seen = moments(torch.from_numpy(frames))
    moving = moments.deviation > 2e-3
    torch.testing.assert_close(seen.mean(0), torch.zeros(12), atol=0.2, rtol=0)
    torch.testing.assert_close(seen.std(0)[moving], torch.ones(int(moving.sum())), atol=0.05, rtol=0)
    assert moments(torch.zeros(1, 32, 32, 3, dtype=torch.uint8)).abs().amax() <= LIMIT


def test_fewer_colours_than_asked_for_leave_the_rest_empty_and_a_fit_repeats():
    frames = pictures([(3, 3), (9, 9)])
    first, second = fitted(frames, 8), fitted(frames, 8)
    assert int(first.palette.amax()) == 1
    for name, value in first.state_dict().items():
        assert torch.equal(value, second.state_dict()[name]), name
    assert first(torch.from_numpy(frames)).isfinite().all()


def test_the_slowest_feature_is_what_an_episode_keeps():
    rng = np.random.default_rng(0)
    episodes, length = 40, LAG + 10
    scene = np.repeat(rng.normal(size=episodes), length)
    fast = 10 * rng.normal(size=(episodes * length, 3))
    mixed = np.concatenate([fast, 0.1 * scene[:, None] + fast[:, :1] + 2 * fast[:, 1:2]], 1)
    last = torch.from_numpy(np.repeat(np.arange(1, episodes + 1) * length - 1, length))
    moments = torch.from_numpy(mixed).float()
    mean, directions = slow_features(moments, last, 2)
    slowest = (moments - mean) @ directions
    assert slowest.shape == (episodes * length, 2)
    assert abs(np.corrcoef(slowest[:, 0], scene)[0, 1]) > 0.95
    torch.testing.assert_close(slowest.std(0), torch.ones(2))


def test_short_episodes_have_slow_features_too():
    last = torch.tensor([2, 2, 2, 5, 5, 5])
    assert all(part.isfinite().all() for part in slow_features(torch.randn(6, 4), last, 2))


@pytest.fixture
def few_colours(monkeypatch):
    """A small palette and few slow features."""
    monkeypatch.setattr("velap.models.encoders.moments.COLOURS", 4)
    monkeypatch.setattr("velap.models.encoders.moments.SLOW", 3)


@pytest.mark.usefixtures("few_colours")
@pytest.mark.parametrize("settings", [WHOLLY, SLOWLY])
def test_latents_of_a_dataset_are_those_of_its_stacks(settings):
    torch.manual_seed(0)
    model = LatentModel(settings, Spaces(16, 16, (-2.0,) * 3, (2.0,) * 3), 0.96).eval().requires_grad_(False)
    sampler = WindowSampler(make_store(), config().train, 2, torch.device("cpu"), np.zeros(0, np.int64))
    features = model.encoder.fit(sampler.frames, sampler.last, 0)
    assert features.shape == (len(sampler.frames), 24)
    rows = torch.arange(len(sampler.frames))
    together = encode_all(model, sampler)
    assert torch.equal(together, encode_all(model, sampler, features)) and together.std(0).amin() > 0
    torch.testing.assert_close(together, encode_rows(model, sampler, rows))
    torch.testing.assert_close(together[3:7].view(2, 2, -1), model.encode(sampler.stacks(rows[3:7]).unflatten(0, (2, 2))))


@pytest.mark.usefixtures("few_colours")
def test_the_encoder_learns_moments_and_slow_features(tmp_path: Path):
    run = make(tmp_path, config(dataclasses.replace(WHOLLY, latent_dim=16), encoder={"steps": 200, "pairs": 32}))
    losses = [run.update() for _ in range(200)]
    for name in ("encoder/moments", "encoder/slow"):
        early, late = (np.mean([float(info[name]) for info in part]) for part in (losses[:5], losses[-5:]))
        assert late < 0.8 * early, name


@pytest.mark.usefixtures("few_colours")
@pytest.mark.parametrize("settings", [WHOLLY, SLOWLY])
@pytest.mark.parametrize("stop", [1, 3, 5])
def test_a_training_with_moments_resumes_to_the_same_bits_and_is_read_again(tmp_path: Path, settings, stop: int):
    asked = config(settings, encoder={"steps": 2}, joint={"steps": 2}, latent={"steps": 2})
    _, second = straight_and_resumed(tmp_path, asked, stop)
    read, _, _ = load_checkpoint(second.finish("test").checkpoint)
    assert isinstance(read.encoder, MomentEncoder)
    assert torch.equal(read.encoder.moments.palette, second.model.encoder.moments.palette)


@pytest.mark.usefixtures("few_colours")
@pytest.mark.parametrize("settings", [WHOLLY, SLOWLY])
def test_what_is_kept_stands_behind_what_is_learnt_and_stays_as_it_is(tmp_path: Path, settings):
    run = make(tmp_path, config(settings, encoder={"steps": 3}, joint={"steps": 2}, latent={"steps": 1}))
    encoder, moments = run.model.encoder, run.run.features
    assert isinstance(encoder, MomentEncoder)
    mean, directions = slow_features(moments, run.sampler.last, 3)
    slow = (KEPT_SCALE * (moments - mean) @ directions).clamp(-KEPT_LIMIT, KEPT_LIMIT)
    expected = KEPT_SCALE * moments if settings is WHOLLY else slow
    for _ in range(2):  # the joint phase changes what is learnt alone
        latents = encode_all(run.model, run.sampler)
        assert latents.shape == (len(moments), encoder.width(settings)) and encoder.learnt_width(settings) == 4
        torch.testing.assert_close(latents[:, 4:], expected, atol=1e-4, rtol=1e-4)
        stacks = torch.stack([moments, moments], 1)
        torch.testing.assert_close(encoder.encode(stacks)[:, :4], encoder.learnt(stacks))
        while run.step < run.total:
            run.update()
