"""The Eq. 1 bundle: shapes for any prefix, action scaling, the bank, and the functions that the search is given."""

import dataclasses
import sys
import types

import numpy as np
import pytest
import torch

from tiny_training import SMALL as TINY
from velap.config import Config
from velap.config.planning import SNAP_GAP
from velap.errors import CheckpointError, ConfigError, VelapError
from velap.models.checkpoint import load_checkpoint, save_checkpoint, shared_weights
from velap.models.velap import LatentModel, Spaces
from velap.training.diagnostics import measure_gap

SMALL = dataclasses.replace(TINY, latent_dim=5)


def make_model(**changes) -> LatentModel:
    torch.manual_seed(0)
    model = LatentModel(dataclasses.replace(SMALL, **changes), Spaces(16, 16, (-2.0, 0.0), (2.0, 1.0)), 0.96)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        model.bank_latents.normal_()
        model.step_distance.fill_(0.5)
        for buffer in model.buffers():
            if buffer.dtype == torch.float32 and buffer.dim() == 1 and len(buffer) > 2:
                buffer.uniform_(0.5, 1.5)
    return model.eval().requires_grad_(False)


@pytest.mark.parametrize("prefix", [(), (3,), (2, 3), (0, 2)])
@pytest.mark.parametrize(
    "changes", [{}, {"norm": "batch"}, {"critic_bounded": False, "dynamics_residual": False}]
)
@pytest.mark.parametrize("hidden", [None, "float32"])
def test_search_functions_equal_the_model(prefix, changes, hidden):
    model = make_model(**changes)
    fns = model.search_fns(hidden)
    z, goal = torch.randn(*prefix, 5), torch.randn(*prefix, 5)
    action, noise = torch.rand(*prefix, 2) * 2 - 1, torch.randn(*prefix, 16)
    pairs = [
        (fns.propose(z, noise), model.propose(z, noise)),
        (fns.act_global(z), model.act_global(z)),
        (fns.step(z, action), model.step(z, action)),
        (fns.q(z, action), model.global_q(z, action)),
        (fns.value(z), model.value(z)),
        *zip(fns.reach(z, goal), model.reach(z, goal), strict=True),
        *zip(fns.project(z), model.project(z), strict=True),
    ]
    for got, expected in pairs:
        torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
    assert fns.d_neigh == 1.5
    assert fns.step_distance == 0.5


def test_train_mode_is_refused():
    model = make_model().train()
    with pytest.raises(VelapError, match="train mode"):
        model.search_fns()


def test_reach_is_minimum_and_deviation_over_the_members():
    model = make_model()
    z, goal = torch.randn(4, 5), torch.randn(4, 5)
    q = model.local_q(z, goal, model.act_local(z, goal))
    assert q.shape == (3, 4)
    q_min, q_std = model.reach(z, goal)
    torch.testing.assert_close(q_min, q.min(0).values)
    torch.testing.assert_close(q_std, ((q - q.mean(0)) ** 2).mean(0).sqrt())


def test_bounded_critics_lie_in_the_unit_interval_and_start_near_zero():
    torch.manual_seed(0)
    model = LatentModel(SMALL, Spaces(16, 16, (-1.0,), (1.0,)), 0.96).eval()
    q = model.global_q(torch.randn(100, 5), torch.rand(100, 1))
    assert q.min() > 0
    assert q.max() < 0.2


def test_actions_scale_to_the_environment_and_back():
    model = make_model()
    np.testing.assert_allclose(model.to_env(torch.tensor([[-1.0, 0.0], [3.0, 1.0]])), [[-2.0, 0.5], [2.0, 1.0]])
    torch.testing.assert_close(model.to_unit(torch.tensor([1.0, 0.25])), torch.tensor([0.5, -0.5]))


def test_project_finds_the_nearest_bank_latent():
    model = make_model()
    z = torch.randn(20, 5)
    found, distance = model.project(z)
    every = torch.cdist(z, model.bank_latents.float())
    torch.testing.assert_close(distance, every.min(1).values)
    torch.testing.assert_close(found, model.bank_latents[every.argmin(1)].float())


def test_the_gap_of_the_bank_is_that_of_held_out_latents_to_the_other_ones():
    model = make_model()
    cache = torch.zeros(12, 5)
    cache[:10, 0] = torch.arange(10.0)  # rows 0 to 9 are held out, a latent unit apart
    cache[10, 0], cache[11, 0] = 0.0, 100.0
    model.bank_rows.copy_(torch.tensor([0, 1, 2, 3, 4, 5, 6, 7, 10, 11]))
    model.bank_latents.copy_(cache[model.bank_rows.long()])
    sampler = types.SimpleNamespace(device=torch.device("cpu"))
    measure_gap(model, sampler, [(0, 4), (5, 9)], cache)  # the bank's own held-out rows, at distance 0, do not count
    torch.testing.assert_close(model.bank_gap, torch.tensor(8.1 / 0.5))  # nine tenths of 0 to 9, in step distances
    model.bank_rows.fill_(3)
    measure_gap(model, sampler, [(0, 4)], cache)
    measure_gap(model, sampler, [], cache)
    assert model.bank_gap == pytest.approx(8.1 / 0.5), "nothing to measure it by"


@pytest.mark.parametrize(("gap", "snaps"), [(SNAP_GAP - 0.1, True), (SNAP_GAP + 0.1, False), (float("inf"), False)])
def test_a_dense_bank_lets_the_search_snap(gap, snaps):
    model = make_model()
    model.bank_gap.fill_(gap)
    assert model.search_fns().snaps == snaps


def test_encode_takes_any_prefix_and_reads_every_frame_of_the_stack():
    model = make_model()
    frames = torch.randint(0, 255, (2, 3, 2, 16, 16, 3), dtype=torch.uint8)
    latents = model.encode(frames)
    assert latents.shape == (2, 3, 5)
    torch.testing.assert_close(model.encode(frames[1, 2]), latents[1, 2])
    changed = frames.clone()
    changed[..., 0, :, :, :] = 0
    assert (model.encode(changed) - latents).abs().max() > 1e-4


def test_large_weights_are_stored_in_half_precision_and_read_into_single(tmp_path, monkeypatch):
    sizes, read = {}, {}
    for limit in (10_000_000, 100_000):
        monkeypatch.setattr("velap.models.checkpoint.HALF_ABOVE", limit)
        model = make_model()
        config = Config("SpiralMaze", "default", model=model.config)
        digest = save_checkpoint(tmp_path / "model.safetensors", model, config, {})
        sizes[limit] = (tmp_path / "model.safetensors").stat().st_size
        read[limit], again, _ = load_checkpoint(tmp_path / "model.safetensors")
        assert again == config
        # what was rounded stays as it is
        assert save_checkpoint(tmp_path / "again.safetensors", read[limit], config, {}) == digest
    single, half = read.values()
    assert sizes[100_000] < 0.6 * sizes[10_000_000]
    for (name, exact), rounded in zip(single.state_dict().items(), half.state_dict().values(), strict=True):
        assert rounded.dtype == exact.dtype
        rough = 1e-3 if exact.dtype == torch.float32 and exact.dim() > 1 else 0.0
        torch.testing.assert_close(rounded, exact, rtol=rough, atol=1e-3 * rough, msg=name)
    assert not torch.equal(half.dynamics.state_dict()["0.weight"], single.dynamics.state_dict()["0.weight"])


def test_heads_belong_to_the_weights_that_they_act_by(tmp_path):
    """Local critics, bank and planner may change beside a head; encoder and π^g may not."""
    hashes = {}
    for name in ("same", "local", "bank", "encoder", "global"):
        model, config = make_model(), Config("SpiralMaze", "default", model=SMALL)
        parts = {"local": model.local_critics, "encoder": model.encoder, "global": model.global_policy}
        if name in parts:
            next(parts[name].parameters()).add_(1.0)
        elif name == "bank":
            model.bank_latents.add_(1.0)
        save_checkpoint(tmp_path / name, model, config, {})
        hashes[name] = shared_weights(load_checkpoint(tmp_path / name)[2])
    assert hashes["same"] == hashes["local"] == hashes["bank"]
    assert len({hashes["same"], hashes["encoder"], hashes["global"]}) == 3


def test_a_pretrained_model_is_read_from_file_and_folder_and_written_again(tmp_path):
    model, config = make_model(), Config("SpiralMaze", "default", model=SMALL)
    save_checkpoint(tmp_path / "a" / "model.safetensors", model, config, {"seed": "7", "command": "velap train"})
    frames = torch.randint(0, 255, (2, 2, 16, 16, 3), dtype=torch.uint8)
    for place in (tmp_path / "a", str(tmp_path / "a" / "model.safetensors")):
        read = LatentModel.from_pretrained(place)
        assert not read.training and read.origin.config == config and read.origin.metadata["seed"] == "7"
        torch.testing.assert_close(read.encode(frames), model.encode(frames))
    written = read.save_pretrained(tmp_path / "b")
    again = LatentModel.from_pretrained(tmp_path / "b")
    assert written == tmp_path / "b" / "model.safetensors"
    assert (tmp_path / "b" / "config.json").read_text() == config.to_json()
    assert again.origin.metadata["weights_sha256"] == read.origin.metadata["weights_sha256"]
    assert again.origin.metadata["command"] == "velap train"
    with pytest.raises(ConfigError, match="got no config"):
        model.save_pretrained(tmp_path / "c")
    model.save_pretrained(tmp_path / "c", config)
    assert LatentModel.from_pretrained(tmp_path / "c").origin.config == config


def test_a_place_that_holds_no_model_is_named(tmp_path, monkeypatch):
    with pytest.raises(CheckpointError, match=r"no checkpoint at .*gone\.safetensors"):
        LatentModel.from_pretrained(tmp_path / "gone.safetensors")
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with pytest.raises(CheckpointError, match=r"somebody/model.*pip install huggingface-hub"):
        LatentModel.from_pretrained("somebody/model")


def test_a_model_of_the_hub_is_fetched(tmp_path, monkeypatch):
    """By huggingface_hub's own function, here of a hub that holds one file."""
    save_checkpoint(tmp_path / "model.safetensors", make_model(), Config("SpiralMaze", "default", model=SMALL), {})
    hub, errors = types.ModuleType("huggingface_hub"), types.ModuleType("huggingface_hub.errors")
    errors.HfHubHTTPError = errors.LocalEntryNotFoundError = OSError
    asked = []
    hub.hf_hub_download = lambda repository, name: asked.append((repository, name)) or str(tmp_path / name)
    monkeypatch.setitem(sys.modules, "huggingface_hub", hub)
    monkeypatch.setitem(sys.modules, "huggingface_hub.errors", errors)
    assert LatentModel.from_pretrained("somebody/model").config == SMALL
    assert asked == [("somebody/model", "model.safetensors")]
