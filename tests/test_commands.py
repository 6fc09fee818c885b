"""The memory of past actions: its values, that training and acting agree on them, and that Eq. 9 does not see them."""

import dataclasses
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

from tiny_training import SMALL, config, make, make_store
from velap.config import ModelConfig
from velap.data.commands import past_commands
from velap.data.sampling import WindowSampler
from velap.errors import ConfigError
from velap.methods.base import get_method, make_agent
from velap.methods.states import StateEncoder
from velap.models.encoders.base import latent_width
from velap.models.velap import COMMAND_MEMORY, COMMAND_SCALE, LatentModel, Spaces
from velap.registry import METHODS
from velap.training.encoder import actions_before
from velap.training.encoding import encode_all

MEMORY = COMMAND_MEMORY
REMEMBERING = dataclasses.replace(SMALL, command_dims=3)


def make_model(settings: ModelConfig = REMEMBERING) -> LatentModel:
    torch.manual_seed(0)
    return LatentModel(settings, Spaces(16, 16, (-2.0,) * 3, (2.0,) * 3), 0.96).eval().requires_grad_(False)


def test_the_mean_leaks_and_starts_anew_with_every_episode():
    actions = torch.tensor([[1.0], [0.0], [-1.0], [1.0], [1.0]])
    first = torch.tensor([0, 0, 0, 3, 3])
    torch.testing.assert_close(past_commands(actions, first, 0.5), torch.tensor([[0.0], [0.5], [0.25], [0.0], [0.5]]))


def test_no_rows_have_no_memory():
    assert past_commands(torch.zeros(0, 2), torch.zeros(0, dtype=torch.long), 0.5).shape == (0, 2)


def test_an_agent_that_takes_the_actions_of_the_data_sees_the_latents_that_were_learnt_on():
    model, store = make_model(), make_store()
    sampler = WindowSampler(store, config().train, 2, torch.device("cpu"), np.zeros(0, np.int64))
    learnt = encode_all(model, sampler)
    assert learnt.shape == (len(store.frames), REMEMBERING.latent_dim + 3)
    assert learnt[:, -3:].abs().amax() > 0.5
    states, starts = StateEncoder(model), np.array([0, 7])
    states.forget(np.ones(2, bool))
    for step in range(7):
        rows = torch.from_numpy(starts + step)
        torch.testing.assert_close(states(sampler.stacks(rows).numpy()), learnt[rows])
        if step < 6:
            states.act(sampler.actions[rows])
    states.forget(np.array([True, False]))
    rows = torch.tensor([0, 13])
    torch.testing.assert_close(states(sampler.stacks(rows).numpy()), learnt[rows])


def test_actions_out_of_bounds_are_remembered_as_the_environment_gets_them():
    states = StateEncoder(make_model())
    states.forget(np.ones(1, bool))
    taken = states.act(torch.tensor([[5.0, -5.0, 0.5]]))
    np.testing.assert_allclose(taken, [[2.0, -2.0, 1.0]])
    seen = states(np.zeros((1, 2, 16, 16, 3), np.uint8))[0, -3:]
    torch.testing.assert_close(seen, COMMAND_SCALE * (1 - MEMORY) * torch.tensor([1.0, -1.0, 0.5]))


@pytest.mark.parametrize("method", [name for name in METHODS if name != "random"])
def test_every_method_sees_its_own_past_actions(method):
    model = make_model(dataclasses.replace(REMEMBERING, bank_size=0))
    seen: list[torch.Tensor] = []
    encode = model.encode

    def watched(frames: torch.Tensor, commands: torch.Tensor | None = None,
                state: torch.Tensor | None = None) -> torch.Tensor:
        assert commands is not None
        seen.append(commands.clone())
        return encode(frames, commands)

    model.encode = watched  # type: ignore[method-assign]
    head = None
    kind = get_method(method)
    if kind.head is not None:
        head = kind.head(model.config, 3)
        head.method = method
        if hasattr(head, "steps_ahead"):
            head.steps_ahead.fill_(2)
    space = gym.spaces.Box(-2.0, 2.0, (3,))
    quick = {"samples": 24, "horizon": 6, "elites": 4} if method in ("mppi", "mbop") else {}
    agent = make_agent(method, model, config(model.config), space, head, settings=kind.settings_of("default", quick))
    agent.reset(np.ones(2, bool))
    frames = np.zeros((2, 2, 16, 16, 3), np.uint8)
    first = agent.act(frames)
    agent.act(frames)
    agent.reset(np.array([False, True]))
    agent.act(frames)
    assert not seen[0].any()
    np.testing.assert_allclose(seen[1].numpy(), (1 - MEMORY) * first / 2, rtol=1e-5, atol=1e-6)
    assert seen[2][0].any() and not seen[2][1].any()


def test_the_contrastive_loss_does_not_learn_what_commands_tell(tmp_path: Path):
    run = make(tmp_path, config(REMEMBERING))
    run.update()
    batch = run.sampler.sample(run.learner.draw, run.run.generator, 0.0)
    latents = torch.randn(len(batch.rows), 7, requires_grad=True)
    loss, _ = run.learner.dynamics_loss(latents, batch)
    told = latents.detach().clone()
    told[batch.unroll_at.max() + 3 :, 4:] += 5  # commands of frames that nothing is unrolled from
    assert torch.equal(run.learner.dynamics_loss(told, batch)[0], loss.detach())


def test_latents_without_memory_are_what_the_encoder_says():
    model, frames = make_model(SMALL), torch.zeros(2, 2, 16, 16, 3, dtype=torch.uint8)
    torch.testing.assert_close(model.encode(frames, torch.ones(2, 3)), model.encoder(frames))


def test_a_memory_without_sense_is_refused():
    with pytest.raises(ConfigError, match="command_dims"):
        ModelConfig(command_dims=-1)


def test_the_first_actions_alone_are_remembered():
    model = make_model(dataclasses.replace(REMEMBERING, command_dims=2))
    sampler = WindowSampler(make_store(), config().train, 2, torch.device("cpu"), np.zeros(0, np.int64))
    latents = encode_all(model, sampler)
    assert latents.shape[1] == REMEMBERING.latent_dim + 2 == latent_width(model.config, 3)
    expected = COMMAND_SCALE * sampler.commands(torch.arange(len(latents)), MEMORY)[:, :2]
    torch.testing.assert_close(latents[:, -2:], expected)
    states = StateEncoder(model)
    states.forget(np.ones(1, bool))
    states.act(torch.tensor([[1.0, -1.0, 0.5]]))
    seen = states(np.zeros((1, 2, 16, 16, 3), np.uint8))[0, REMEMBERING.latent_dim :]
    torch.testing.assert_close(seen, COMMAND_SCALE * (1 - MEMORY) * torch.tensor([1.0, -1.0]))


def test_the_inverse_model_tells_how_far_a_lagging_hand_went():
    sampler = WindowSampler(make_store(), config().train, 2, torch.device("cpu"), np.zeros(0, np.int64))
    told = actions_before(make_model(), sampler)
    row, mean, way = 3, torch.zeros(3), torch.zeros(3)
    for action in sampler.actions[:row]:
        mean = MEMORY * mean + (1 - MEMORY) * action
        way = way + mean
    torch.testing.assert_close(told[row], way.double())
    plain = actions_before(make_model(SMALL), sampler)
    torch.testing.assert_close(plain[row], sampler.actions[:row].double().sum(0))
