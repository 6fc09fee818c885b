"""Joint training and the latent and value phases: gradients reach exactly the parameters they should, targets follow."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tiny_training import FRAMES, config, make, to_end, touched, trainer, until, weights
from velap.config import ModelConfig
from velap.data.sampling import FirstTransitions, WholeWindows
from velap.models.encoders.conv import ConvEncoder, native_precision
from velap.training.encoding import encode_rows
from velap.training.joint import TRANSITIONS_A_WINDOW, rollouts
from velap.training.loop import Trainer

WHOLE = WholeWindows(3, 5, 0, 0, 3)
ALL = WholeWindows(8, 3)


def batch_of(run: Trainer, draw=WHOLE, seed: int = 0):
    batch = run.sampler.sample(draw, torch.Generator().manual_seed(seed), 0.05)
    return batch, encode_rows(run.model, run.sampler, batch.rows).detach()


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_model_loss_reaches_encoder_dynamics_and_critics_only(tmp_path, norm):
    run = trainer(tmp_path, norm, policy_every=2)
    run.update()
    model = run.model
    for part in (model.encoder, model.dynamics, model.local_critics, model.global_critic):
        assert touched(part)
    targets = (run.run.actor_critic.local_target, run.run.actor_critic.global_target)
    for part in (model.local_policy, model.global_policy, model.action_model, *targets):
        assert not touched(part)


@pytest.mark.parametrize("norm", ["layer", "batch"])
def test_policy_step_reaches_policies_and_action_model_only(tmp_path, norm):
    run = trainer(tmp_path, norm)
    model, before = run.model, weights(run.model)
    batch, latents = batch_of(run)
    optimizer = torch.optim.Adam(run.run.actor_critic.policy_parameters)
    run.run.actor_critic.improve_policies(optimizer, latents, batch, run.run.generator)
    changed = {name.split(".")[0] for name, value in model.state_dict().items()
               if not torch.equal(value, before[name]) and "running" not in name and "num_batches" not in name}
    assert changed == {"local_policy", "global_policy", "action_model"}
    assert not touched(model.encoder) and not touched(model.local_critics) and not touched(model.global_critic)


def test_targets_follow_slowly_and_have_no_gradient(tmp_path):
    run = trainer(tmp_path, target_rate=0.5)
    target = run.run.actor_critic.local_target
    old = next(target.parameters()).clone()
    run.update()
    torch.testing.assert_close(next(target.parameters()), (old + next(run.model.local_critics.parameters())) / 2)
    assert all(not p.requires_grad for p in target.parameters())


def test_evaluated_networks_keep_their_batch_statistics(tmp_path):
    run = trainer(tmp_path, "batch")
    model, learner = run.model, run.run.actor_critic
    batch, latents = batch_of(run)
    policies = [b.clone() for b in model.local_policy.buffers()]
    learner.critic_losses(latents, batch)
    assert all(torch.equal(a, b) for a, b in zip(policies, model.local_policy.buffers(), strict=True))
    critics = [b.clone() for b in model.local_critics.buffers()]
    learner.policy_losses(latents, batch, run.run.generator)
    assert all(torch.equal(a, b) for a, b in zip(critics, model.local_critics.buffers(), strict=True))


def test_rollouts_chain_the_dynamics_along_the_data(tmp_path):
    run = trainer(tmp_path)
    batch, _ = batch_of(run)
    latents = torch.randn(len(batch.rows), 4)
    predicted, truth, valid = rollouts(run.model, latents, batch, 3)
    assert predicted.shape == (3, 9, 4)
    # rollout 4 starts in window 1 (6 frames each) at step 1
    first = run.model.step(latents[7], batch.actions[1, 1])
    torch.testing.assert_close(predicted[0, 4], first)
    torch.testing.assert_close(predicted[1, 4], run.model.step(first, batch.actions[1, 2]))
    assert truth[:, 4].tolist() == [8, 9, 10] and valid[:, 4].tolist() == batch.valid[1, 1:4].tolist()


def test_a_part_of_the_transitions_is_drawn_anew_for_every_batch(tmp_path):
    run = trainer(tmp_path)
    draw = WholeWindows(3, 5, 7, 4, 3)
    batches = [run.sampler.sample(draw, run.run.generator, 0.0) for _ in range(40)]
    for batch in batches:
        assert len(batch.now_at.unique()) == len(batch.now_at) == len(batch.weight) == len(batch.goal_at) == 7
        assert len(batch.unroll_at.unique()) == len(batch.unroll_at) == 4 and (batch.unroll_at % 6 <= 2).all()
        inside = batch.valid[batch.now_at // 6, batch.now_at % 6]
        assert torch.equal(batch.weight, inside.float())
        assert torch.equal(batch.action, batch.actions[batch.now_at // 6, batch.now_at % 6])
    assert len(torch.cat([batch.now_at for batch in batches]).unique()) == 15  # the last frame of a window starts nothing
    only_first = run.sampler.sample(FirstTransitions(3, 5), run.run.generator, 0.0)
    assert only_first.now_at.tolist() == only_first.unroll_at.tolist() == [0, 6, 12]


def test_a_window_of_one_trains_the_values_by_its_first_transition_alone(tmp_path):
    few, whole = trainer(tmp_path, joint={"window": 1}), trainer(tmp_path, joint={"windows": 2})
    few.update()
    whole.update()
    assert few.learner.draw == FirstTransitions(3, 3), "as in the paper: the k steps of Eq. 9"
    assert whole.learner.draw == WholeWindows(2, 5, 2 * TRANSITIONS_A_WINDOW, 2 * TRANSITIONS_A_WINDOW, 3)


def test_the_dynamics_loss_is_the_one_that_the_phase_names(tmp_path):
    found = {}
    for loss in ("infonce", "mse"):
        run = trainer(tmp_path / loss, joint={"dynamics_loss": loss})
        found[loss] = float(run.update()["dynamics/loss"])
        batch, latents = batch_of(run)
        ours = run.learner.dynamics_loss(latents, batch)[0].item()
        predicted, truth, valid = rollouts(run.model, latents, batch, 3)
        squares = (predicted - latents[truth]).square().sum(-1)
        mean = squares[valid].mean().item()
        assert (ours == pytest.approx(mean, rel=1e-4)) == (loss == "mse")
    assert found["infonce"] != found["mse"]


def test_latent_phase_leaves_the_encoder_alone(tmp_path):
    run = trainer(tmp_path, joint={"steps": 0})
    before = weights(run.model.encoder)
    run.update()
    assert all(torch.equal(value, before[name]) for name, value in run.model.encoder.state_dict().items())


def test_the_decoder_teaches_the_encoder_and_is_not_part_of_the_model(tmp_path):
    plain, taught = trainer(tmp_path / "plain"), trainer(tmp_path / "taught", joint={"reconstruction_side": 16})
    for a, b in zip(plain.model.parameters(), taught.model.parameters(), strict=True):
        assert torch.equal(a, b), "the decoder must not touch the model's first weights"
    assert "reconstruction/loss" in taught.update() and "reconstruction/loss" not in plain.update()
    assert not torch.equal(plain.model.encoder(FRAMES), taught.model.encoder(FRAMES))
    assert plain.model.state_dict().keys() == taught.model.state_dict().keys()
    frames = taught.sampler.frames[:5]
    assert taught.learner.decoder.shrink(frames).shape == (5, 3 * 16 * 16)
    expected = frames.permute(0, 3, 1, 2).flatten(1).float() / 255  # frames of 16 x 16 are what they are shrunk to
    assert torch.allclose(taught.learner.decoder.shrink(frames), expected)


def test_a_decoded_scene_is_learnt(tmp_path, monkeypatch):
    monkeypatch.setattr("velap.training.joint.LEARNING_RATE", 1e-2)
    monkeypatch.setattr("velap.training.joint.RECONSTRUCTION", 1.0)
    run = trainer(tmp_path, joint={"steps": 60, "reconstruction_side": 16})
    losses = [float(run.update()["reconstruction/loss"]) for _ in range(60)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])


def test_the_critics_loss_and_the_policies_gain_are_those_of_the_config(tmp_path):
    runs = {name: trainer(tmp_path / name, **changes) for name, changes in {
        "plain": {}, "entropy": {"critic_loss": "cross_entropy"},
        "floor": {"critic_loss": "cross_entropy", "critic_floor": 0.01}}.items()}
    infos = {}
    for name, run in runs.items():
        batch, latents = batch_of(run, ALL)
        learner, generator = run.run.actor_critic, torch.Generator().manual_seed(0)
        infos[name] = learner.critic_losses(latents, batch)[2] | learner.policy_losses(latents, batch, generator)[1]
    plain, entropy = infos["plain"], infos["entropy"]
    for loss in ("local/loss", "global/loss"):
        assert entropy[loss] > 1.5 * plain[loss], "at least twice the squared error, by Pinsker's inequality"
    assert torch.equal(infos["floor"]["local/loss"], entropy["local/loss"]), "the floor is that of the global critics"
    assert not torch.isclose(infos["floor"]["global/loss"], entropy["global/loss"], rtol=0.01)
    weight = runs["entropy"].config.train.c3
    expected = -1 + weight * entropy["global/imitation"].item()
    assert entropy["global/policy"].item() == pytest.approx(expected, abs=1e-5), "policies gain relative to Q"
    assert plain["global/policy"] > -0.9


@pytest.mark.parametrize(("label", "asked"), [("joint", 1.0), ("latent", 0.0), ("values", 0.5)])
def test_every_phase_has_its_own_share_of_rewards(tmp_path, monkeypatch, label, asked):
    run = trainer(tmp_path, joint={"rewarded_share": 1.0}, latent={"rewarded_share": 0.0},
                  values={"steps": 2, "rewarded_share": 0.5})
    shares, sample = [], run.sampler.sample
    monkeypatch.setattr(run.sampler, "sample", lambda draw, generator, share: shares.append(share) or sample(
        draw, generator, share))
    until(run, label)
    assert shares[-1] == asked


def test_policies_learn_in_every_second_update_whatever_the_phase(tmp_path):
    run = trainer(tmp_path, joint={"steps": 3}, latent={"steps": 3}, values={"steps": 2}, policy_every=2)
    learnt = []
    while run.step < run.total:
        before = run.model.global_policy[0].weight.clone()
        said = "global/policy" in run.update()
        assert said != torch.equal(before, run.model.global_policy[0].weight)
        learnt.append(said)
    assert learnt == [False, True] * 4


def test_the_value_phase_leaves_the_dynamics_alone(tmp_path):
    run = trainer(tmp_path, values={"steps": 2})
    until(run, "latent")
    while run.learner is None or run.learner.phase.label != "values":
        before = weights(run.model)
        run.update()
    to_end(run)
    after = run.model.state_dict()
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"local_critics", "global_critic", "local_policy", "global_policy", "action_model"}


def test_without_a_joint_phase_the_heads_begin_with_new_weights(tmp_path):
    run = make(tmp_path, config(encoder={"steps": 1}, joint={"steps": 0}))
    run.update()
    before = weights(run.model)
    run.update()
    for name, value in run.model.named_parameters():
        if name.startswith("encoder."):
            assert torch.equal(value, before[name]), name
        elif name.endswith(".0.weight"):  # new weights are as far from the old ones as they are large
            assert (value - before[name]).norm() > 0.5 * before[name].norm(), name
    learnt = run.run.actor_critic.local_target.weights[0] - run.model.local_critics.weights[0]
    assert learnt.norm() < 0.5 * run.model.local_critics.weights[0].norm(), "the targets went along"


def test_convolutions_compute_in_half_precision_only_where_a_device_has_units_for_it(monkeypatch):
    """Emulated, bfloat16 takes 13 times as long as float32."""
    for amx, avx, expected in ((False, False, torch.float32), (True, False, torch.bfloat16), (False, True, torch.bfloat16)):
        monkeypatch.setattr("torch.cpu._is_amx_tile_supported", lambda has=amx: has)
        monkeypatch.setattr("torch.cpu._is_avx512_bf16_supported", lambda has=avx: has)
        encoder = ConvEncoder(ModelConfig(), (64, 64))
        computed: list[torch.dtype] = []
        encoder.convolutions.register_forward_hook(lambda module, given, out, into=computed: into.append(out.dtype))
        encoder(torch.zeros(1, 3, 64, 64, 3, dtype=torch.uint8))
        assert computed == [expected]
    assert native_precision("cuda") is torch.bfloat16
