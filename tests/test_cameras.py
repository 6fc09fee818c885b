"""Several cameras side by side in one frame: the same in datasets of every format, evaluation, server and viewer."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import h5py
import minari
import numpy as np
import pytest
from minari.data_collector.episode_buffer import EpisodeBuffer

import velap
from test_readers import recorded, stored, write_lerobot, write_robomimic
from tiny_training import QUICK, SMALL
from velap import cli
from velap.data.frames import FrameStore, Reading
from velap.data.loading import load_store
from velap.data.survey import survey
from velap.errors import ConfigError, DatasetError, ObservationError
from velap.evaluation.evaluate import Evaluation, load_player
from velap.evaluation.records import read_records
from velap.methods.base import Agent
from velap.serve.server import Server
from velap.serve.session import PictureReader, Session, load_policy

SIDE = 16
CAMERAS = gym.spaces.Dict(front=gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8),
                          wrist=gym.spaces.Box(0, 255, (3, 2 * SIDE, 2 * SIDE), np.uint8),
                          joints=gym.spaces.Box(-1, 1, (4,), np.float32))


class TwoCameras(gym.Env[Any, Any]):
    """The front camera shows the time, the other one, channels first and twice as large, what is left of it."""

    observation_space = CAMERAS
    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, names: Any = ("front", "wrist")) -> None:
        self.names = names
        self.observation_space = gym.spaces.Dict({names[0]: CAMERAS["front"], names[1]: CAMERAS["wrist"]})

    def observe(self) -> dict[str, np.ndarray]:
        return {self.names[0]: np.full((SIDE, SIDE, 3), 10 * self.time, np.uint8),
                self.names[1]: np.full((3, 2 * SIDE, 2 * SIDE), 200 - 10 * self.time, np.uint8)}

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        self.time = 0
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.time += 1
        return self.observe(), float(self.time == 6), self.time == 6, False, {}


if "TwoCameras-v0" not in gym.registry:
    gym.register("TwoCameras-v0", TwoCameras, max_episode_steps=8)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A Minari dataset of noise with both cameras and joints; every third episode succeeds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("data")))
        rng, buffers = np.random.default_rng(0), []
        for episode in range(9):
            won = np.arange(6) == 5 if episode % 3 == 0 else np.zeros(6, bool)
            observations = {name: (rng.integers(0, 256, (7, *space.shape)) if name != "joints" else
                                   rng.uniform(-1, 1, (7, 4))).astype(space.dtype) for name, space in CAMERAS.items()}
            buffers.append(EpisodeBuffer(id=episode, observations=observations, rewards=won.astype(float),
                                         actions=rng.uniform(-1, 1, (6, 2)).astype(np.float32),
                                         terminations=won, truncations=(np.arange(6) == 5) & ~won))
        minari.create_dataset_from_buffers("lab/cameras-v0", buffers, observation_space=CAMERAS,
                                           action_space=gym.spaces.Box(-1, 1, (2,), np.float32), jpeg_encoding=False)
        yield "lab/cameras-v0"


def read(image_key: str | None, **options: Any) -> FrameStore:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*32×32 are resized to 16×16")
        return load_store("lab/cameras-v0", image_key, image_size=SIDE, **options)


def test_cameras_stand_side_by_side_in_the_order_asked_for(data: str) -> None:
    front, wrist = read("front"), read("wrist")
    for mapped in (False, True):
        both = read("front,wrist", mapped=mapped)
        np.testing.assert_array_equal(both.frames, np.concatenate([front.frames, wrist.frames], 2))
        assert both.frames.shape[1:] == (SIDE, 2 * SIDE, 3)
        assert both.reading == Reading("front,wrist", SIDE, success="reward>=1")
    np.testing.assert_array_equal(read("wrist,front").frames[:, :, SIDE:], front.frames)
    with pytest.raises(DatasetError, match=r"no observation key 'back'.*front"):
        load_store(data, "front,back")
    with pytest.raises(DatasetError, match="several stand side by side"):
        load_store(data)


def test_every_format_puts_cameras_side_by_side(tmp_path: Path) -> None:
    expected = stored(recorded())
    with h5py.File(write_robomimic(recorded(), tmp_path / "two.hdf5"), "r+") as file:
        for name in file["data"]:
            for group in ("obs", "next_obs"):
                file[f"data/{name}/{group}/wrist"] = 255 - file[f"data/{name}/{group}/agentview_image"][:]
    store = load_store(tmp_path / "two.hdf5", "wrist,agentview_image")
    np.testing.assert_array_equal(store.frames, np.concatenate([255 - expected.frames, expected.frames], 2))
    source = write_lerobot(recorded(), tmp_path / "two", cameras=("images.front", "images.wrist"))
    np.testing.assert_array_equal(load_store(source, "images.wrist,images.front").frames,
                                  np.concatenate([load_store(source, "images.wrist").frames] * 2, 2))


@pytest.fixture(scope="module")
def checkpoint(data: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    config = velap.Config("cameras", "default", model=SMALL, train=QUICK)
    with pytest.warns(UserWarning, match="resized"):
        return velap.train(config, data, image_key="front,wrist", image_size=SIDE, device="cpu", loggers=[],
                           out=tmp_path_factory.mktemp("run"))


def watched(agent: Agent, seen: list[np.ndarray]) -> Agent:
    act = agent.act

    def watching(frames: np.ndarray) -> np.ndarray:
        seen.append(frames.copy())
        return act(frames)

    agent.act = watching  # type: ignore[method-assign]
    return agent


def test_evaluation_and_server_show_what_the_training_data_showed(checkpoint: Path) -> None:
    player = load_player(Evaluation("cameras", method="td3bc", checkpoint=checkpoint, env="TwoCameras-v0"))
    evaluated: list[np.ndarray] = []
    watched(player.agent, evaluated)
    (episode,) = player.episodes([0])
    assert episode.success and episode.steps == 6
    assert [int(frames[0, -1, 0, SIDE - 1, 0]) for frames in evaluated] == [0, 10, 20, 30, 40, 50]
    assert [int(frames[0, -1, 0, SIDE, 0]) for frames in evaluated] == [200, 190, 180, 170, 160, 150]

    session, served, env = Session(load_policy(checkpoint, "td3bc", device="cpu")), [], TwoCameras()
    watched(session._agent, served)
    observation, _ = env.reset()
    for _ in range(6):
        action = session.step(observation)["actions"][0]
        observation, *_ = env.step(action)
    np.testing.assert_array_equal(served, evaluated)


def test_cameras_of_other_names_are_named_in_their_order(checkpoint: Path, tmp_path: Path,
                                                         capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", "cameras", "--method", "td3bc", "--checkpoint", str(checkpoint), "--env", "TwoCameras-v0",
               "--env-kwargs", "names=('top','hand')", "--episodes", "1", "--records", str(tmp_path)]
    assert cli.main(command) == 2
    assert "several images among its observations: hand, top" in capsys.readouterr().err
    assert cli.main([*command, "--image-key", "top"]) == 2
    assert "frames of 16 × 16 px (top); expected 16 × 32 (front,wrist)" in capsys.readouterr().err
    for _ in range(2):  # the second time there is nothing to do
        assert cli.main([*command, "--image-key", "top", "--image-key", "hand"]) == 0
    (path,) = tmp_path.rglob("*.jsonl")
    (record,) = read_records(path)
    assert (record.image_key, record.env_kwargs) == ("top,hand", {"names": ["top", "hand"]})
    with pytest.raises(ConfigError, match="expected numbers, text, lists and dicts, which records can name"):
        velap.evaluate("cameras", checkpoint, env="TwoCameras-v0", env_kwargs={"names": np.array(["top", "hand"])})
    assert cli.main([*command, "--image-key", "hand", "--image-key", "top"]) == 2
    assert "image_key" in capsys.readouterr().err, "the other order is another run"


def test_the_server_names_a_missing_camera(checkpoint: Path) -> None:
    policy = load_policy(checkpoint, "td3bc", device="cpu")
    sent = TwoCameras().reset() and {"front": np.zeros((SIDE, SIDE, 3), np.uint8)}
    with pytest.raises(ObservationError, match="no array 'wrist'"):
        PictureReader(policy.spaces, None, policy.reading)(sent)
    for key in ("front", "a,b,c"):
        with pytest.raises(ConfigError, match=r"expected as many as in the training data \(front, wrist\)"):
            Server(policy, image_key=key)
    with pytest.raises(ConfigError, match=r"training data \(one, without a name\)"):
        PictureReader(policy.spaces, "a,b", Reading())


def test_oblong_frames_are_surveyed_and_viewed(data: str, checkpoint: Path, tmp_path: Path) -> None:
    found = survey(read("front,wrist"))
    assert found.coverage is not None and found.frozen_frames == 0
    page = tmp_path / "page.html"
    assert cli.main(["view", str(checkpoint), "--method", "td3bc", "--env", "TwoCameras-v0", "--dataset", data, "--out",
                     str(page), "--projection", "pca"]) == 0
    assert page.stat().st_size > 10_000
