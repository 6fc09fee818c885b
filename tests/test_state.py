"""Numbers beside the image: from every format into the latent, and the same in evaluation, server and export."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
import torch
from minari.data_collector.episode_buffer import EpisodeBuffer
from numpy.typing import NDArray

import velap
from test_readers import recorded, write_lerobot, write_robomimic
from tiny_training import QUICK, SMALL
from velap import cli
from velap.data.frames import Episode, FrameStore
from velap.data.loading import load_store
from velap.errors import ConfigError, DatasetError, ObservationError
from velap.evaluation.evaluate import Evaluation, load_player
from velap.methods.base import Agent
from velap.models.checkpoint import load_checkpoint
from velap.serve.export import export
from velap.serve.session import Session, load_policy
from velap.training.encoding import encode_all
from velap.training.loop import Trainer

SIDE = 16
SPACE = gym.spaces.Dict(camera=gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8), done=gym.spaces.Discrete(2),
                        robot=gym.spaces.Dict(joints=gym.spaces.Box(-9, 9, (2,), np.float64),
                                              grip=gym.spaces.Box(0, 1, (), np.float32)))
KEYS = "robot/grip,robot/joints"


def observations(states: np.ndarray) -> dict[str, Any]:
    """Of states [T + 1, 3], grip first, by one picture."""
    return {"camera": np.full((len(states), SIDE, SIDE, 3), 7, np.uint8), "done": np.zeros(len(states), np.int64),
            "robot": {"joints": states[:, 1:].astype(np.float64), "grip": states[:, 0].astype(np.float32)}}


@pytest.fixture(scope="module")
def states() -> list[np.ndarray]:
    """Of 12 episodes [9, 3]; the grip is 1 everywhere, joints vary about 5."""
    rng = np.random.default_rng(0)
    return [np.concatenate([np.ones((9, 1)), rng.normal(5, 2, (9, 2))], 1).astype(np.float32) for _ in range(12)]


@pytest.fixture(scope="module")
def data(states: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A Minari dataset; actions point from the joints to 5, every third episode succeeds in its sixth step and goes on."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("data")))
        buffers = []
        for number, held in enumerate(states):
            rewards = ((np.arange(8) == 5) & (number % 3 == 0)).astype(float)
            last = np.arange(8) == 7
            buffers.append(EpisodeBuffer(id=number, observations=observations(held), rewards=rewards, truncations=last,
                                         terminations=last & False, actions=np.clip((5 - held[:-1, 1:]) / 6, -1, 1)))
        minari.create_dataset_from_buffers("lab/arm-v0", buffers, observation_space=SPACE,
                                           action_space=gym.spaces.Box(-1, 1, (2,), np.float32), jpeg_encoding=False)
        yield "lab/arm-v0"


@pytest.mark.filterwarnings("ignore:.*go on after their first success")
@pytest.mark.parametrize("mapped", [False, True])
def test_states_are_read_beside_the_frames(data: str, states: list[np.ndarray], mapped: bool) -> None:
    store = load_store(data, state_key=KEYS, image_size=SIDE, mapped=mapped)
    expected = np.concatenate([held[:7] if number % 3 == 0 else held for number, held in enumerate(states)])
    np.testing.assert_array_equal(store.states, expected)
    assert store.reading.state_key == KEYS
    without = load_store(data, image_size=SIDE)
    assert without.states is None and without.content_hash != store.content_hash
    np.testing.assert_array_equal(load_store(data, state_key="robot/joints", image_size=SIDE).states, expected[:, 1:])


@pytest.mark.parametrize("key", ["camera", "robot", "done", "robot/legs"])
def test_a_key_without_numbers_is_named(data: str, key: str) -> None:
    with pytest.raises(DatasetError, match=rf"no numbers under the observation key '{key}'.*robot/joints: float64\[2\]"):
        load_store(data, state_key=key)


def test_every_format_has_states(tmp_path: Path) -> None:
    lengths = [len(episode.images) for episode in recorded()]
    rng = np.random.default_rng(0)
    held = [rng.normal(size=(length, 3)).astype(np.float32) for length in lengths]
    for next_obs in (True, False):
        with h5py.File(write_robomimic(recorded(), tmp_path / f"{next_obs}.hdf5", next_obs=next_obs), "r+") as file:
            for number, each in enumerate(held):
                demo = file[f"data/demo_{number}"]
                demo["obs/robot0_eef_pos"][:] = each[:-1] if next_obs else each
                if next_obs:
                    demo["next_obs/robot0_eef_pos"] = each[1:]
        store = load_store(tmp_path / f"{next_obs}.hdf5", state_key="robot0_eef_pos")
        np.testing.assert_array_equal(store.states, np.concatenate(held))
    with_state = [dataclasses.replace(episode, state=each) for episode, each in zip(recorded(), held, strict=True)]
    np.testing.assert_array_equal(FrameStore.from_episodes(with_state).states, np.concatenate(held))
    source = write_lerobot(recorded(), tmp_path / "lerobot", state=held)
    np.testing.assert_array_equal(load_store(source, state_key="observation.state").states, np.concatenate(held))


def test_wrong_states_of_episodes_are_named() -> None:
    def episode(state: Any) -> Episode:
        return Episode(np.zeros((4, SIDE, SIDE, 3), np.uint8), np.zeros((3, 2)), [0, 0, 1], state=state)

    for state, text in ((np.zeros((3, 2)), r"shape \(3, 2\); expected numbers of shape \[4, S\]"),
                        (np.zeros(4), r"\(4,\)"), (np.full((4, 1), np.nan), "the state of step 0 is .*nan"),
                        (np.full((4, 1), "a"), "the state is <U1")):
        with pytest.raises(DatasetError, match=text):
            FrameStore.from_episodes([episode(state)], image_size=SIDE)
    with pytest.raises(DatasetError, match=r"have .* entries; expected the same number in every episode"):
        FrameStore.from_episodes([episode(np.zeros((4, 2))), episode(None)], image_size=SIDE, action_low=-1, action_high=1)


@pytest.fixture(scope="module")
def checkpoint(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trained jointly for a few updates, with a memory of commands; BC learns on its latents until it can."""
    config = velap.Config("arm", "default", model=dataclasses.replace(SMALL, command_dims=1), train=QUICK)
    out = tmp_path_factory.mktemp("run")
    with pytest.warns(UserWarning, match="go on after their first success"):
        return velap.train(config, data, state_key=KEYS, image_size=SIDE, device="cpu", loggers=[], out=out, method="bc",
                           changes={"head": {"steps": 300, "batch": 64}})


@pytest.mark.filterwarnings("ignore:.*go on after their first success")
def test_the_latent_holds_the_standardised_state_behind_the_commands(data: str, checkpoint: Path, tmp_path: Path) -> None:
    store = load_store(data, state_key=KEYS, image_size=SIDE)
    model, config, _ = load_checkpoint(checkpoint)
    trainer = Trainer(config, store, tmp_path, 0, torch.device("cpu"))
    latents = encode_all(model, trainer.sampler)
    assert latents.shape[1] == SMALL.latent_dim + 1 + 3
    assert store.states is not None
    joints = store.states[:, 1:]
    np.testing.assert_allclose(latents[:, -2:], (joints - joints.mean(0)) / joints.std(0), atol=1e-5)
    assert (latents[:, -3] == 0).all(), "a grip that never opens tells nothing"
    assert model.encode(torch.zeros(2, 2, SIDE, SIDE, 3, dtype=torch.uint8))[:, -2:].abs().max() < 1e-6, "the mean state"


class Arm(gym.Env[Any, Any]):
    """The joints go where actions say; the picture shows nothing. Success: both are near 5."""

    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, renamed: bool = False, joints: int = 2) -> None:
        vector = gym.spaces.Box(-9, 9, (joints + 1,), np.float32)
        self.renamed, self.joints = renamed, joints
        self.observation_space = gym.spaces.Dict(camera=SPACE["camera"], agent_pos=vector) if renamed else SPACE

    def observe(self) -> Any:
        held = np.concatenate([[1], self.place]).astype(np.float32)
        if self.renamed:
            return {"camera": np.full((SIDE, SIDE, 3), 7, np.uint8), "agent_pos": np.resize(held, self.joints + 1)}
        seen = observations(held[None])
        return {"camera": seen["camera"][0], "done": 0, "robot": {name: part[0] for name, part in seen["robot"].items()}}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = self.np_random.normal(5, 2, 2)
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.place = self.place + action
        near = bool((np.abs(self.place - 5) < 0.5).all())
        return self.observe(), float(near), near, False, {}


if "Arm-v0" not in gym.registry:
    gym.register("Arm-v0", Arm, max_episode_steps=12, disable_env_checker=True)


@pytest.mark.parametrize("renamed", [False, True])
def test_a_policy_that_sees_nothing_solves_the_task_by_its_state(checkpoint: Path, renamed: bool, tmp_path: Path) -> None:
    """Also where the environment calls its only vector of that size otherwise."""
    summary = velap.evaluate("arm", checkpoint, method="bc", env="Arm-v0", env_kwargs={"renamed": renamed}, episodes=10,
                             records=tmp_path)
    assert summary.successes >= 8
    blind = velap.evaluate("arm", method="random", env="Arm-v0", episodes=10, records=tmp_path)
    assert blind.successes < 6
    agent = velap.load(checkpoint, "bc")
    assert velap.evaluate(agent, env=lambda: Arm(renamed), state_key="agent_pos" if renamed else KEYS, image_size=SIDE,
                          max_steps=12, episodes=3).successes == 3


def test_another_environment_is_refused(checkpoint: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"under the observation key 'robot/grip'; expected one vector of 3 numbers. It "
                                           r"has .*agent_pos: float32\[5\]"):
        load_player(Evaluation("arm", checkpoint=checkpoint, env="Arm-v0", env_kwargs={"renamed": True, "joints": 4}))
    with pytest.raises(ConfigError, match="the checkpoint keeps its own"):
        velap.evaluate("arm", checkpoint, env="Arm-v0", state_key="agent_pos", records=tmp_path)


@pytest.mark.parametrize("method", ["velap", "td3bc", "mppi", "bc"])
def test_agents_take_the_state_and_name_its_lack(checkpoint: Path, method: str) -> None:
    changes: Any = {"planner": {"n_iter": 8, "candidates": 2}}
    if method == "mppi":
        changes = {"mppi": {"samples": 4, "elites": 2}}
    frames = np.full((2, 2, SIDE, SIDE, 3), 7, np.uint8)

    def start() -> Agent:
        return velap.load(checkpoint, method, changes=changes, device="cpu")

    agent, here = start(), np.array([[1, 3, 8], [1, 5, 5]])
    actions = agent.act(frames, here)
    assert np.isfinite(actions).all() and (start().act(frames, here + np.array([0, 2, 2])) != actions).any()
    for state, got in ((None, "no state"), (here[0], r"\[3\]"), (here[:, :2], r"\[2, 2\]"), (here * np.nan, "a state")):
        with pytest.raises(ObservationError, match=rf"{got}.*; expected finite numbers \[2, 3\].*act\(frames, state\)"):
            agent.act(frames, state)
    other = velap.load(Path(velap.__file__).parent / "checkpoints/SpiralMaze.safetensors", "td3bc", device="cpu")
    with pytest.raises(ObservationError, match=r"a state of shape \[1, 3\]; expected none"):
        other.act(np.zeros((1, other.frame_stack, 64, 64, 3), np.uint8), here[:1])


def test_the_server_finds_the_state(checkpoint: Path) -> None:
    policy = load_policy(checkpoint, "bc", device="cpu")
    assert policy.about["state_size"] == 3
    picture = np.full((SIDE, SIDE, 3), 7, np.uint8)
    expected = velap.load(checkpoint, "bc", device="cpu").act(np.stack([picture] * 2)[None], np.array([[1, 3, 8]]))
    for sent in ({"robot": {"joints": np.array([3.0, 8.0]), "grip": np.array([1.0])}},
                 {"robot/joints": np.array([3.0, 8.0]), "robot/grip": np.array(1.0)},
                 {"state": np.array([1, 3, 8]), "other": np.zeros(2)}):
        answer = Session(policy).step({"camera": picture, **sent})
        np.testing.assert_array_equal(answer["actions"], expected)
    for wrong in ({}, {"state": np.zeros(4)}, {"state": np.full(3, np.nan)}, {"a": np.zeros(3), "b": np.zeros(3)}):
        with pytest.raises(ObservationError, match=r"no state of 3 finite numbers.*Send it under robot/grip, robot/joints"):
            Session(policy).step({"camera": picture, **wrong})


def test_the_exported_encoder_takes_the_state(checkpoint: Path, tmp_path: Path) -> None:
    programs = export(checkpoint, tmp_path / "exported")
    assert programs["encode"].inputs[-1] == "state float32 [*, S]"
    encode = torch.export.load(tmp_path / "exported" / programs["encode"].file).module()
    model, _, _ = load_checkpoint(checkpoint)
    inputs = (torch.randint(0, 256, (3, 2, SIDE, SIDE, 3), dtype=torch.uint8), torch.rand(3, 2), torch.randn(3, 3))
    torch.testing.assert_close(encode(*inputs), model.encode(*inputs), atol=1e-4, rtol=0)


def test_the_command_line_takes_the_keys(data: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
                                         capsys: pytest.CaptureFixture[str]) -> None:
    seen: dict[str, NDArray[Any] | Any] = {}
    monkeypatch.setattr("velap.api.train", lambda source, **options: seen.update(options) or tmp_path)
    assert cli.main(["train", "--dataset", data, "--state-key", "robot/grip", "--state-key", "robot/joints"]) == 0
    assert seen["state_key"] == KEYS
    assert cli.main(["inspect", data, "--state-key", "nothing", "--out", str(tmp_path)]) == 0
    assert "no numbers under the observation key 'nothing'" in capsys.readouterr().out
