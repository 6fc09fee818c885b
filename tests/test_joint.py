"""Gradients reach exactly the parameters they should, the target networks none, resume goes on to the same bits."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from velap.config import Config, ModelConfig
from velap.config.training import TrainConfig
from velap.data.frames import FrameStore, Reading
from velap.errors import CheckpointError, ConfigError, DatasetError
from velap.models.velap import load_checkpoint
from velap.runs import load_tensors
from velap.training.joint import rollouts
from velap.training.loop import MODEL, STATE, Trainer, train
from velap.training.pairs import Pairs

SMALL = ModelConfig(
    frame_stack=2,
    latent_dim=4,
    encoder_filters=(4, 4),
    encoder_kernels=(4, 4),
    encoder_strides=(2, 2),
    encoder_dense=(8,),
    dynamics_dense=(16,),
    generative_dense=(16,),
    noise_dim=2,
    policy_dense=(16,),
    critic_dense=(16,),
    bank_size=10,
)
QUICK = TrainConfig(
    joint_steps=6,
    batch_windows=3,
    window=5,
    latent_steps=6,
    latent_horizon=3,
    precision="float32",
    checkpoint_every=2,
    log_every=2,
    diagnose_every=4,
    holdout_episodes=1,
)


FRAMES = torch.zeros(1, 2, 16, 16, 3, dtype=torch.uint8)


def make_store(episodes: int = 12, length: int = 6) -> FrameStore:
    rng = np.random.default_rng(0)
    n = episodes * (length + 1)
    rewards, terminated, truncated = np.zeros(n, np.float32), np.zeros(n, bool), np.zeros(n, bool)
    ends = np.arange(length - 1, n, length + 1)
    rewards[ends[:2]] = 1
    terminated[ends[:2]] = True
    truncated[ends[2:]] = True
    return FrameStore(
        frames=rng.integers(0, 255, (n, 16, 16, 3), dtype=np.uint8),
        actions=rng.uniform(-2, 2, (n, 3)).astype(np.float32),
        rewards=rewards,
        terminated=terminated,
        truncated=truncated,
        episode_start=np.arange(episodes) * (length + 1),
        episode_length=np.full(episodes, length),
        action_low=np.full(3, -2, np.float32),
        action_high=np.full(3, 2, np.float32),
        dataset_id="test/noise-v0",
        content_hash="abc",
    )


def config(model: ModelConfig = SMALL, **changes) -> Config:
    return Config("test", "default", model=model, train=dataclasses.replace(QUICK, **changes))


def trainer(tmp_path: Path, norm: str = "layer", **changes) -> Trainer:
    settings = config(dataclasses.replace(SMALL, norm=norm), **changes)
    return Trainer(settings, make_store(), tmp_path, 0, torch.device("cpu"))


def straight_and_resumed(path: Path, settings: Config, stop: int) -> tuple[Trainer, Trainer]:
    """A run to its end, and one that is saved after `stop` updates and resumed; their weights have the same bits."""
    straight, broken, again = (
        Trainer(settings, make_store(), path / name, 0, torch.device("cpu")) for name in ("straight", "broken", "broken")
    )
    for _ in range(straight.total):
        straight.update()
    for _ in range(stop):
        broken.update()
    broken.run_dir.mkdir(parents=True, exist_ok=True)
    broken.save()
    again.resume()
    while again.step < again.total:
        again.update()
    expected = straight.model.state_dict()
    assert [name for name, value in again.model.state_dict().items() if not torch.equal(value, expected[name])] == []
    return straight, again


def touched(module: torch.nn.Module) -> bool:
    return any(p.grad is not None and p.grad.abs().sum() > 0 for p in module.parameters())


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_model_loss_reaches_encoder_dynamics_and_critics_only(tmp_path, norm):
    run = trainer(tmp_path, norm)
    run.learner.model_optimizer.step = lambda: None
    run.learner._update_policies = lambda latents, batch: {}
    run.update()
    model = run.model
    for part in (model.encoder, model.dynamics, model.local_critics, model.global_critic):
        assert touched(part)
    for part in (
        model.local_policy,
        model.global_policy,
        model.action_model,
        run.learner.local_target,
        run.learner.global_target,
    ):
        assert not touched(part)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_policy_step_reaches_policies_and_action_model_only(tmp_path, norm):
    run = trainer(tmp_path, norm)
    learner, model = run.learner, run.model
    batch = run.sampler.sample(3, 5, True, run.generator)
    before = {k: v.clone() for k, v in model.state_dict().items()}
    learner._update_policies(model.encode(run.sampler.stacks(batch.rows)).detach(), batch)
    changed = {
        k.split(".")[0]
        for k, v in model.state_dict().items()
        if not torch.equal(v, before[k]) and "running" not in k and "num_batches" not in k
    }
    assert changed == {"local_policy", "global_policy", "action_model"}
    assert not touched(model.encoder) and not touched(model.local_critics) and not touched(model.global_critic)


def test_targets_follow_slowly_and_have_no_gradient(tmp_path):
    run = trainer(tmp_path, target_rate=0.5)
    old = next(run.learner.local_target.parameters()).clone()
    run.update()
    new, online = next(run.learner.local_target.parameters()), next(run.model.local_critics.parameters())
    torch.testing.assert_close(new, (old + online) / 2)
    assert all(not p.requires_grad for p in run.learner.local_target.parameters())


def test_evaluated_networks_keep_their_batch_statistics(tmp_path):
    run = trainer(tmp_path, "batch")
    learner, model = run.learner, run.model
    batch = run.sampler.sample(3, 5, True, run.generator)
    latents = model.encode(run.sampler.stacks(batch.rows)).detach()
    policies = [b.clone() for b in model.local_policy.buffers()]
    learner.value_loss(latents, batch)
    assert all(torch.equal(a, b) for a, b in zip(policies, model.local_policy.buffers(), strict=True))
    critics = [b.clone() for b in model.local_critics.buffers()]
    learner.acting_loss(latents, batch)
    assert all(torch.equal(a, b) for a, b in zip(critics, model.local_critics.buffers(), strict=True))


def test_rollouts_chain_the_dynamics_along_the_data(tmp_path):
    run = trainer(tmp_path)
    batch = run.sampler.sample(3, 5, True, run.generator)
    latents = torch.randn(len(batch.rows), 4)
    predicted, truth, valid = rollouts(run.model, latents, batch, 3)
    assert predicted.shape == (3, 9, 4)
    # rollout 4 starts in window 1 (6 frames each) at step 1
    first = run.model.step(latents[7], batch.actions[1, 1])
    torch.testing.assert_close(predicted[0, 4], first)
    torch.testing.assert_close(predicted[1, 4], run.model.step(first, batch.actions[1, 2]))
    assert truth[:, 4].tolist() == [8, 9, 10] and valid[:, 4].tolist() == batch.valid[1, 1:4].tolist()


def test_a_part_of_the_transitions_is_drawn_anew_for_every_batch(tmp_path):
    run = trainer(tmp_path, value_transitions=7, dynamics_rollouts=4)
    batches = [run.sampler.sample(3, 5, True, run.generator) for _ in range(40)]
    for batch in batches:
        assert len(batch.start.unique()) == len(batch.start) == len(batch.weight) == len(batch.goals.position) == 7
        assert len(batch.unrolled.unique()) == len(batch.unrolled) == 4 and (batch.unrolled % 6 <= 2).all()
        inside = batch.valid[batch.start // 6, batch.start % 6]
        assert torch.equal(batch.weight, inside.float())
        assert torch.equal(batch.action, batch.actions[batch.start // 6, batch.start % 6])
    assert len(torch.cat([batch.start for batch in batches]).unique()) == 15  # the last frame of a window starts nothing
    only_first = run.sampler.sample(3, 5, False, run.generator)
    assert only_first.start.tolist() == only_first.unrolled.tolist() == [0, 6, 12]


def test_latent_phase_leaves_the_encoder_alone(tmp_path):
    run = trainer(tmp_path, joint_steps=0)
    before = [p.clone() for p in run.model.encoder.parameters()]
    run.update()
    assert all(torch.equal(a, b) for a, b in zip(before, run.model.encoder.parameters(), strict=True))


def test_the_decoder_teaches_the_encoder_and_is_not_part_of_the_model(tmp_path):
    plain, taught = trainer(tmp_path / "plain"), trainer(tmp_path / "taught", reconstruction=1.0)
    for a, b in zip(plain.model.parameters(), taught.model.parameters(), strict=True):
        assert torch.equal(a, b), "the decoder must not touch the model's first weights"
    assert "reconstruction/loss" in taught.update() and "reconstruction/loss" not in plain.update()
    assert not torch.equal(plain.model.encoder(FRAMES), taught.model.encoder(FRAMES))
    assert plain.model.state_dict().keys() == taught.model.state_dict().keys()
    decoder = taught.learner.decoder
    stacks = taught.sampler.stacks(torch.arange(5))
    assert decoder.shrink(stacks).shape == (5, 3 * 16 * 16)
    newest = stacks[:, -1].permute(0, 3, 1, 2).flatten(1).float() / 255  # frames of 16 x 16 are what they are shrunk to
    assert torch.allclose(decoder.shrink(stacks), newest)


def test_a_decoded_scene_is_learnt(tmp_path):
    run = trainer(tmp_path, reconstruction=1.0, joint_steps=60, learning_rate=1e-2)
    losses = [float(run.update()["reconstruction/loss"]) for _ in range(60)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])


def test_the_encoder_phase_moves_the_encoder_alone_and_the_others_follow(tmp_path):
    run = trainer(tmp_path, encoder_steps=2, joint_steps=2, latent_steps=1)
    before = {name: value.clone() for name, value in run.model.state_dict().items()}
    phases, losses = [], []
    for _ in range(run.total):
        losses.append(set(run.update()))
        phases.append(run.phase)
        if len(phases) == 2:
            changed = {name for name, value in run.model.state_dict().items() if not torch.equal(value, before[name])}
            assert changed and all(name.startswith("encoder.") for name in changed)
    assert phases == ["encoder", "encoder", "joint", "joint", "latent"]
    assert losses[1] == {"encoder/displacement", "encoder/reconstruction"} and "local/loss" in losses[2] & losses[4]
    assert run.model.state_dict().keys() == before.keys(), "what taught the encoder is thrown away"
    plain = trainer(tmp_path / "plain")
    for a, b in zip(plain.model.parameters(), trainer(tmp_path / "b", encoder_steps=2).model.parameters(), strict=True):
        assert torch.equal(a, b), "the phase must not touch the model's first weights"


def test_pairs_lie_in_one_training_episode_and_know_their_actions(tmp_path, monkeypatch):
    monkeypatch.setattr(Pairs, "REACH", 3)
    run = trainer(tmp_path, encoder_steps=1, encoder_pairs=500)
    sampler, pairs = run.sampler, run.learner.pairs
    now, then = pairs.draw(run.generator)
    assert torch.equal(sampler.first[now], sampler.first[then])
    assert set((then - now).tolist()) == {1, 2, 3}
    held_out = run.store.episode_start[run.holdout][0]
    assert not torch.isin(sampler.first[now], torch.tensor([held_out])).any()
    sums = pairs.before[then] - pairs.before[now]
    for a, b, total in zip(now[:20].tolist(), then[:20].tolist(), sums[:20], strict=True):
        assert torch.allclose(sampler.actions[a:b].sum(0).double(), total, atol=1e-6)


def test_the_critics_loss_and_the_policies_gain_are_those_of_the_config(tmp_path):
    runs = {name: trainer(tmp_path / name, **changes) for name, changes in {
        "plain": {}, "entropy": {"critic_loss": "cross_entropy"}, "relative": {"policy_relative": True},
        "floor": {"critic_loss": "cross_entropy", "critic_floor": 0.01}}.items()}
    infos = {}
    for name, run in runs.items():
        batch = run.sampler.sample(8, 3, True, torch.Generator().manual_seed(0))
        latents = run.model.encode(run.sampler.stacks(batch.rows)).detach()
        infos[name] = run.learner.value_loss(latents, batch)[1] | run.learner.acting_loss(latents, batch)[1]
    plain, entropy, relative = infos["plain"], infos["entropy"], infos["relative"]
    for loss in ("local/loss", "global/loss"):
        assert entropy[loss] > 1.5 * plain[loss], "at least twice the squared error, by Pinsker's inequality"
        assert torch.equal(relative[loss], plain[loss])
    assert torch.equal(infos["floor"]["local/loss"], entropy["local/loss"]), "the floor is that of the global critics"
    assert not torch.isclose(infos["floor"]["global/loss"], entropy["global/loss"], rtol=0.01)
    weight = runs["relative"].config.train.c3
    assert relative["global/policy"].item() == pytest.approx(-1 + weight * relative["global/imitation"].item(), abs=1e-5)


def test_the_latent_phase_has_its_own_share_of_rewards(tmp_path):
    run = trainer(tmp_path, rewarded_share=1.0, latent_rewarded_share=0.0)
    run.learner.begin_latent_phase()
    shares, sample = [], run.sampler.sample
    run.sampler.sample = lambda *args, **kwargs: shares.append(kwargs["rewarded_share"]) or sample(*args, **kwargs)
    run.learner.latent_step()
    assert shares == [0.0]


def test_pairs_teach_where_the_agent_went(tmp_path):
    """Frames that show a dot at the sum of all actions: the error of the summed actions falls."""
    store = make_store(episodes=40)
    place = np.zeros((len(store.frames), 2), int)
    for start, length in zip(store.episode_start, store.episode_length, strict=True):
        place[start : start + length + 1] = 8
        walked = np.cumsum(store.actions[start : start + length, :2] * 0.8, 0)
        place[start + 1 : start + length + 1] = (8 + walked).round().clip(1, 14)
    store.frames[:] = 0
    for row, (x, y) in enumerate(place):
        store.frames[row, y - 1 : y + 2, x - 1 : x + 2] = 255
    settings = config(encoder_steps=150, encoder_learning_rate=3e-3)
    run = Trainer(settings, store, tmp_path, 0, torch.device("cpu"))
    errors = [float(run.update()["encoder/displacement"]) for _ in range(150)]
    assert np.mean(errors[-20:]) < 0.75 * np.mean(errors[:10])


def test_policies_learn_in_every_second_update_whatever_the_phase(tmp_path):
    run = trainer(tmp_path, joint_steps=3, latent_steps=3, latent_value_steps=2, policy_every=2)
    learnt = []
    while run.step < run.total:
        before = run.model.global_policy[0].weight.clone()
        said = "global/policy" in run.update()
        assert said != torch.equal(before, run.model.global_policy[0].weight)
        learnt.append(said)
    assert learnt == [False, True] * 4


CLONED = dataclasses.replace(SMALL, success_policy=True)


def test_the_clone_phase_moves_the_policy_of_successes_alone_towards_their_actions(tmp_path, monkeypatch):
    monkeypatch.setattr(Pairs, "REACH", 3)
    run = Trainer(config(CLONED, clone_steps=400), make_store(), tmp_path, 0, torch.device("cpu"))
    while run.phase != "clone":
        run.update()
        before = {k: v.clone() for k, v in run.model.state_dict().items()}
    first = run.update()["clone/loss"]
    while run.step < run.total:
        last = run.update()["clone/loss"]
    changed = {k.split(".")[0] for k, v in run.model.state_dict().items() if not torch.equal(v, before[k])}
    assert changed == {"success_policy"}
    # two successful episodes of six steps in the store, none held out
    assert run.sampler.episodes[run.sampler.rank_of_row[run.learner.cloning.rows]].unique().tolist() == [0, 1]
    assert len(run.learner.cloning.rows) == 12 and last < 0.7 * first, "noise, learnt by heart"


def test_a_resume_in_the_clone_phase_goes_on_to_the_same_bits(tmp_path):
    settings = config(CLONED, clone_steps=4)
    _, again = straight_and_resumed(tmp_path, settings, settings.train.steps - 2)
    loaded, _, _ = load_checkpoint(again.finish("x").checkpoint)
    assert loaded.search_fns()["act_success"](torch.zeros(2, SMALL.latent_dim)).shape == (2, 3)


def test_nothing_to_clone_is_an_error(tmp_path):
    store = make_store()
    store = dataclasses.replace(store, rewards=np.zeros_like(store.rewards))
    with pytest.raises(DatasetError, match="no successful episode"):
        Trainer(config(CLONED, clone_steps=4), store, tmp_path, 0, torch.device("cpu"))
    with pytest.raises(ConfigError, match="success_policy"):
        config(clone_steps=4)


def test_runs_older_than_a_field_can_be_resumed(tmp_path):
    run = trainer(tmp_path)
    run.update()
    run.save()
    _, metadata = load_tensors(tmp_path / STATE)
    assert not [name for name in ("group_windows", "reconstruction") if name in metadata["config"]]
    trainer(tmp_path).resume()


@pytest.mark.parametrize("norm", ["layer", "batch"])
@pytest.mark.parametrize(("encoder", "stop"), [(0, 2), (0, 6), (0, 10), (3, 2), (3, 4)])
def test_resume_goes_on_to_the_same_bits(tmp_path, norm, encoder, stop):
    settings = config(dataclasses.replace(SMALL, norm=norm), reconstruction=0.5, encoder_steps=encoder)
    straight, _ = straight_and_resumed(tmp_path, settings, stop)
    assert straight.finish("x").sha256  # the measured latents and the bank complete the model


def test_train_writes_a_loadable_model_and_readable_metrics(tmp_path):
    seen = []
    result = train(config(), make_store(), tmp_path, device="cpu", on_progress=seen.append, command="velap train test")
    model, loaded, metadata = load_checkpoint(result.checkpoint)
    assert loaded == config() and metadata["command"] == "velap train test" and metadata["dataset_hash"] == "abc"
    assert Reading.from_json(metadata["reading"]) == make_store().reading
    assert result.checkpoint.name == MODEL and model.step_distance > 0 and (model.bank_rows >= 0).all()
    rows = [json.loads(line) for line in (tmp_path / "metrics.jsonl").read_text().splitlines()]
    assert [row["step"] for row in rows] == [2, 4, 6, 8, 10, 12]
    assert "rollout/error_3" in rows[1] and rows[-1]["phase"] == "latent"
    assert [p.step for p in seen] == [2, 4, 6, 8, 10, 12]


def test_foreign_and_existing_runs_are_refused(tmp_path):
    train(config(), make_store(), tmp_path, device="cpu")
    with pytest.raises(CheckpointError, match="--resume"):
        train(config(), make_store(), tmp_path, device="cpu")
    with pytest.raises(CheckpointError, match="another config"):
        train(config(c0=0.3), make_store(), tmp_path, device="cpu", resume=True)
    with pytest.raises(CheckpointError, match="another seed"):
        train(config(), make_store(), tmp_path, device="cpu", resume=True, seed=1)


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


def test_schedule_may_change_until_the_latent_phase_begins(tmp_path):
    run = trainer(tmp_path)
    run.update()
    run.save()
    longer = trainer(tmp_path, joint_steps=8, latent_steps=2)
    longer.resume()
    assert longer.step == 1
    for _ in range(7):
        run.update()
    run.save()
    with pytest.raises(CheckpointError, match="schedule"):
        longer.resume()


def test_a_finished_run_can_be_given_more_phases(tmp_path):
    more = {"latent_value_steps": 3}
    whole, first = trainer(tmp_path / "whole", **more), trainer(tmp_path / "first")
    for run in (whole, first):
        while run.step < run.total:
            run.update()
    first.save()
    again = trainer(tmp_path / "first", **more)
    again.resume()
    assert (again.step, again.total) == (12, 15)
    while again.step < again.total:
        again.update()
    for (name, a), b in zip(whole.model.state_dict().items(), again.model.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
    again.save()
    for other in ({}, {"latent_value_steps": 2}, {"latent_steps": 7, **more}):
        with pytest.raises(CheckpointError, match="schedule"):
            trainer(tmp_path / "first", **other).resume()


def test_weights_hash_does_not_depend_on_how_long_training_took(tmp_path):
    hashes = []
    for name, seconds in (("a", 1.0), ("b", 2.0)):
        run = trainer(tmp_path / name)
        run.update()
        run.seconds = seconds
        run.finish(f"velap train {name}")
        hashes.append(load_tensors(tmp_path / name / MODEL)[1])
    assert hashes[0]["weights_sha256"] == hashes[1]["weights_sha256"]
    assert hashes[0]["sha256"] != hashes[1]["sha256"]
