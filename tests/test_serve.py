"""The server: openpi-client drives a task through it; episodes, keys, errors, speed, and wrong messages by the thousand."""

from __future__ import annotations

import asyncio
import dataclasses
import importlib.util
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from studies import serving
from velap import api, cli
from velap.config import Config, override
from velap.data.frames import Reading
from velap.errors import ConfigError, ObservationError
from velap.evaluation.evaluate import Evaluation, load_player
from velap.models.checkpoint import load_checkpoint, save_checkpoint
from velap.models.velap import LatentModel, Spaces
from velap.serve.messages import pack, unpack
from velap.serve.server import Server
from velap.serve.session import PictureReader, Policy, Session, load_policy

ROOT = Path(__file__).resolve().parents[1]
SIDE, STACK = 64, 3
LOW, HIGH = (-1.0, 0.0, 2.0), (1.0, 4.0, 2.5)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Random weights, three frames of 16 pixels a state, a plan every four steps, a memory of past commands."""
    model = {"frame_stack": STACK, "latent_dim": 5, "bank_size": 8, "command_dims": 3}
    config = override(Config(task="toy", preset="default"), model=model, controller={"n_replan": 4},
                      planner={"n_iter": 12, "candidates": 4, "n_sim": 2, "discard_low_exponent": 1e4,
                               "discard_high_exponent": 1e-6})
    torch.manual_seed(0)
    network = LatentModel(config.model, Spaces(SIDE, SIDE, LOW, HIGH), 0.96)
    network.step_distance.fill_(0.5)
    path = tmp_path_factory.mktemp("run") / "model.safetensors"
    save_checkpoint(path, network, config, {"seed": "3"})
    return path


@pytest.fixture(scope="module")
def policy(checkpoint: Path) -> Policy:
    return load_policy(checkpoint, device="cpu")


@contextmanager
def served(policy: Policy, **settings: Any) -> Iterator[int]:
    """The port of a server that runs on a thread of this process."""
    server, started, port = Server(policy, port=0, **settings), threading.Event(), []

    def on_start(at: int) -> None:
        port.append(at)
        started.set()

    thread = threading.Thread(target=lambda: asyncio.run(server.run(on_start)))
    thread.start()
    assert started.wait(20)
    try:
        yield port[0]
    finally:
        server.stop()
        thread.join(20)
        assert not thread.is_alive()


@contextmanager
def client_of(port: int, **options: Any) -> Iterator[ClientConnection]:
    """A connection whose first message is read."""
    with connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None, **options) as client:
        client.recv()
        yield client


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (SIDE, SIDE, 3), np.uint8)


def ask(client: ClientConnection, message: Any) -> np.ndarray:
    """The action that answers an observation."""
    client.send(pack(message))
    answer = client.recv(30)
    assert isinstance(answer, bytes), answer
    return unpack(answer)["actions"]


def expected_actions(checkpoint: Path, numbers: list[int], seed: int = 0, method: str = "velap") -> np.ndarray:
    """[T, A] actions of an agent that acts alone, on stacks made by hand."""
    agent = api.load(checkpoint, method, device="cpu")
    agent.reset(np.ones(1, bool), np.array([seed]))
    frames = [picture(number) for number in numbers]
    stacks = [[frames[max(step - back, 0)] for back in (2, 1, 0)] for step in range(len(frames))]
    return np.concatenate([agent.act(np.stack(stack)[None]) for stack in stacks])


def test_openpi_client_drives_a_task_to_the_goal_as_the_agent_itself_would() -> None:
    pytest.importorskip("openpi_client")
    spec = importlib.util.spec_from_file_location("drive_task", ROOT / "examples" / "drive_task.py")
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    released = ROOT / "checkpoints" / "SpiralMaze.safetensors"
    with served(load_policy(released, device="cpu"), api_key="secret") as port:
        driven = example.drive("SpiralMaze", 1000, "127.0.0.1", port, "secret")
    alone = next(load_player(Evaluation("SpiralMaze", checkpoint=released, device="cpu")).episodes([1000]))
    assert driven == (alone.success, alone.steps)
    assert alone.success


def test_openpi_client_meets_the_protocol(policy: Policy) -> None:
    openpi = pytest.importorskip("openpi_client.websocket_client_policy")
    with served(policy) as port:
        client = openpi.WebsocketClientPolicy("127.0.0.1", port)
        about = client.get_server_metadata()
        assert (about["task"], about["method"], about["image_shape"]) == ("toy", "velap", [SIDE, SIDE, 3])
        assert about["action_low"] == list(LOW) and about["action_high"] == list(HIGH)
        answer = client.infer({"observation/image": picture(0), "observation/state": np.zeros(7), "prompt": "close it"})
        assert answer["actions"].shape == (1, 3) and answer["actions"].dtype == np.float32
        assert 0 < answer["server_timing"]["plan_ms"] < answer["server_timing"]["infer_ms"]
        assert "plan_ms" not in client.infer({"observation/image": picture(1)})["server_timing"]
        with pytest.raises(RuntimeError, match="2 pictures; expected one") as caught:
            client.infer({"left": picture(0), "right": picture(0)})
        assert "Traceback" not in str(caught.value)
        client.infer({"observation/image": picture(2)})  # the connection goes on


def test_the_code_of_the_how_to_moves_a_robot(checkpoint: Path, policy: Policy) -> None:
    pytest.importorskip("openpi_client")
    page = (ROOT / "docs" / "how-to" / "real-robot.md").read_text()
    code = page.split("```python\n")[1].split("```")[0]
    taken: list[np.ndarray] = []
    camera, robot = SimpleNamespace(read=lambda: picture(len(taken))), SimpleNamespace(move=taken.append)
    with served(policy) as port:
        assert "8000" in code and "range(200)" in code
        exec(code.replace("8000", str(port)).replace("range(200)", "range(6)"), {"camera": camera, "robot": robot})
    np.testing.assert_allclose(taken, expected_actions(checkpoint, list(range(6))), atol=1e-6)


@pytest.mark.parametrize("method", ["velap", "td3bc", "random"])
def test_frames_are_stacked_and_episodes_begin_by_reset(checkpoint: Path, method: str) -> None:
    with served(load_policy(checkpoint, method, device="cpu")) as port, client_of(port) as client:
        first = [ask(client, {"image": picture(number), "seed": 5})[0] for number in range(7)]
        again = [ask(client, {"image": picture(number), "reset": number == 20, "seed": 6})[0] for number in range(20, 26)]
        once_more = [ask(client, {"image": picture(number), "reset": np.array([number == 0]), "seed": np.int64(5)})[0]
                     for number in range(7)]
    np.testing.assert_allclose(first, expected_actions(checkpoint, list(range(7)), 5, method), atol=1e-6)
    np.testing.assert_allclose(again, expected_actions(checkpoint, list(range(20, 26)), 6, method), atol=1e-6)
    np.testing.assert_array_equal(first, once_more)


def test_every_connection_has_an_episode_of_its_own(checkpoint: Path, policy: Policy) -> None:
    with served(policy) as port, client_of(port) as one, client_of(port) as other, client_of(port) as late:
        taken: dict[str, list[np.ndarray]] = {"one": [], "other": [], "late": []}
        for step in range(9):
            taken["one"].append(ask(one, {"image": picture(step), "seed": 1})[0])
            taken["other"].append(ask(other, {"image": picture(100 + step), "seed": 2})[0])
            if step > 3:
                taken["late"].append(ask(late, {"image": picture(200 + step), "seed": 1})[0])
    np.testing.assert_allclose(taken["one"], expected_actions(checkpoint, list(range(9)), 1), atol=1e-6)
    np.testing.assert_allclose(taken["other"], expected_actions(checkpoint, list(range(100, 109)), 2), atol=1e-6)
    np.testing.assert_allclose(taken["late"], expected_actions(checkpoint, list(range(204, 209)), 1), atol=1e-6)


@pytest.mark.parametrize("wrong", [
    {"image": picture(9) / 255}, {"image": picture(9)[:, :9], "reset": True}, {"image": picture(9), "reset": "yes"},
    {"image": picture(9), "reset": True, "seed": -1}, {"reset": True}, [], None,
], ids=["floats", "not square", "reset in words", "negative seed", "no picture", "list", "nothing"])
def test_a_refused_observation_leaves_the_episode_as_it_is(checkpoint: Path, policy: Policy, wrong: Any) -> None:
    session, actions = Session(policy), []
    for step in range(6):
        actions.append(session.step({"image": picture(step)})["actions"][0])
        with pytest.raises(ObservationError):
            session.step(wrong)
    np.testing.assert_allclose(actions, expected_actions(checkpoint, list(range(6))), atol=1e-6)


def test_an_endless_episode_keeps_no_more_than_a_stack(checkpoint: Path) -> None:
    session = Session(load_policy(checkpoint, "td3bc", device="cpu"))
    actions = [session.step({"image": picture(number % 5)})["actions"][0] for number in range(200)]
    np.testing.assert_allclose(actions[-1], expected_actions(checkpoint, [n % 5 for n in range(200)], 0, "td3bc")[-1])
    kept = [value for value in vars(session).values() if hasattr(value, "__len__") and not isinstance(value, str)]
    assert [len(value) for value in kept] == [STACK]


SQUARE = Spaces(SIDE, SIDE, LOW, HIGH)


@pytest.mark.parametrize(("sent", "key"), [
    ({"image": picture(0)}, None),
    ({"image": picture(0), "state": np.zeros(7, np.float32), "depth": np.zeros((SIDE, SIDE), np.float32)}, None),
    ({"left": picture(1), "right": picture(0)}, "right"),
    ({"observation/image": picture(0), "other": picture(1)}, "observation/image"),
    ({"observation": {"image": picture(0), "other": picture(1)}}, "observation/image"),
    ({"image": np.moveaxis(picture(0), -1, 0)}, None),
    ({"image": picture(0)[:, ::-1][:, ::-1]}, None),
    ({"image": picture(0).repeat(4, 0).repeat(4, 1)}, None),
], ids=["one", "with a state", "named", "slash", "nested", "channel first", "strides", "four times as large"])
def test_pictures_are_read(sent: dict[str, Any], key: str | None) -> None:
    np.testing.assert_array_equal(PictureReader(SQUARE, key)(sent), picture(0))


@pytest.mark.parametrize(("fit", "wanted"), [
    ("crop", lambda wide: wide[:, 8:-8]), ("pad", lambda wide: np.pad(wide, ((8, 8), (0, 0), (0, 0)))),
    ("squash", lambda wide: wide.reshape(16, 16, 2, 3).mean(2)),
])
def test_oblong_pictures_become_square_as_those_of_the_training_data(fit: Any, wanted: Callable[[Any], Any]) -> None:
    wide = np.random.default_rng(0).integers(0, 256, (16, 32, 3), np.uint8)
    side = 32 if fit == "pad" else 16
    read = PictureReader(Spaces(side, side, LOW, HIGH), None, Reading(fit=fit))
    np.testing.assert_allclose(read({"image": wide}), wanted(wide), atol=1)


def test_among_several_pictures_the_name_of_the_training_datas_counts() -> None:
    sent = {"left": picture(1), "front": picture(0)}
    np.testing.assert_array_equal(PictureReader(SQUARE, None, Reading(image_key="front"))(sent), picture(0))
    np.testing.assert_array_equal(PictureReader(SQUARE, "left", Reading(image_key="front"))(sent), picture(1))


def test_the_checkpoint_says_how_pictures_become_square(checkpoint: Path, tmp_path: Path) -> None:
    model, config, _ = load_checkpoint(checkpoint)
    path = tmp_path / "model.safetensors"
    save_checkpoint(path, model, config, {"seed": "3", "reading": Reading("front", SIDE, "crop").to_json()})
    wide = np.pad(picture(0), ((0, 0), (8, 8), (0, 0)), constant_values=77)
    actions = Session(load_policy(path, "td3bc", device="cpu")).step({"front": wide, "left": picture(1)})["actions"]
    np.testing.assert_allclose(actions, expected_actions(checkpoint, [0], 0, "td3bc"), atol=1e-6)


def test_grey_pictures_are_repeated() -> None:
    grey = picture(0)[..., 0]
    for sent in (grey, grey[..., None], grey[None]):
        np.testing.assert_array_equal(PictureReader(SQUARE)({"image": sent}), np.repeat(grey[..., None], 3, -1))


@pytest.mark.parametrize(("sent", "key", "text"), [
    ({"image": picture(0) / 255}, None, r"'image' is float64\[64, 64, 3\]; expected uint8\[64, 64, 3\].*255 \* picture"),
    ({"image": picture(0).astype(np.int32)}, None, "int32"),
    ({"image": picture(0)[:, :12]}, None, "square of another size"),
    ({"image": np.zeros((SIDE, SIDE, 4), np.uint8)}, None, "without alpha"),
    ({"image": np.zeros((SIDE, SIDE, 9), np.uint8)}, None, "stacks frames itself"),
    ({"image": picture(0)[None]}, "image", "one picture at a time"),
    ({"image": picture(0)[None]}, None, r"0 pictures.*'image': uint8\[1, 64, 64, 3\]"),
    ({"image": np.zeros((4, 4, 3), np.uint8)}, None, r"uint8\[4, 4, 3\]"),
    ({}, None, "no array"),
    ({"left": picture(0), "right": picture(1)}, None, r"2 pictures.*--image-key"),
    ({"left": picture(0)}, "image", r"no array 'image'; it has 'left'"),
    ({"image": [[1]]}, None, "no array"),
    ({f"name{n}" * 50: np.zeros(1) for n in range(50)}, None, "…"),
])
def test_other_pictures_are_named(sent: dict[str, Any], key: str | None, text: str) -> None:
    with pytest.raises(ObservationError, match=text) as caught:
        PictureReader(SQUARE, key)(sent)
    assert len(str(caught.value)) < 900


def get(port: int, path: str, **headers: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)) as reply:
            return reply.status, reply.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def test_only_the_key_opens_the_server_and_health_needs_none(policy: Policy) -> None:
    with served(policy, api_key="secret") as port:
        assert get(port, "/healthz") == (200, "OK\n")
        for sent in (None, "Api-Key wrong", "Api-Key secre", "secret", "Api-Key sécret", "Bearer secret"):
            headers = {} if sent is None else {"Authorization": sent}
            with pytest.raises(InvalidStatus) as caught, client_of(port, additional_headers=headers):
                pass
            assert caught.value.response.status_code == 401
            assert "secret" not in str(caught.value.response.body)
        with client_of(port, additional_headers={"Authorization": "Api-Key secret"}) as client:
            assert ask(client, {"image": picture(0)}).shape == (1, 3)


def test_web_pages_get_in_nowhere(policy: Policy) -> None:
    with served(policy) as port, pytest.raises(InvalidStatus) as caught, client_of(port, origin="http://evil.example"):
        pass
    assert caught.value.response.status_code == 403


def test_other_machines_get_in_by_a_key_only(policy: Policy) -> None:
    for host in ("0.0.0.0", "::", "robot.local", ""):
        with pytest.raises(ConfigError, match="without a key"):
            Server(policy, host=host)
        Server(policy, host=host, api_key="secret")
    for host in ("127.0.0.1", "127.0.0.2", "localhost", "::1"):
        Server(policy, host=host)
    with pytest.raises(ConfigError, match="empty"):
        Server(policy, api_key="")


def test_more_clients_than_allowed_are_turned_away_until_one_leaves(policy: Policy) -> None:
    with served(policy, max_clients=2) as port:
        with client_of(port), client_of(port):
            with pytest.raises(InvalidStatus) as caught, client_of(port):
                pass
            assert caught.value.response.status_code == 503
        until(lambda: _connects(port))


def _connects(port: int) -> bool:
    try:
        with client_of(port) as client:
            return ask(client, {"image": picture(0)}).shape == (1, 3)
    except InvalidStatus:
        return False


def until(condition: Callable[[], bool], limit: float = 20.0) -> None:
    end = time.monotonic() + limit
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_a_message_beyond_the_limit_ends_its_connection_alone(policy: Policy) -> None:
    with served(policy, max_message=20_000) as port, client_of(port) as good:
        with client_of(port) as client:
            client.send(bytes(20_001))
            with pytest.raises(ConnectionClosed) as caught:
                client.recv(10)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1009
        assert ask(good, {"image": picture(0)}).shape == (1, 3)


def test_a_message_in_endless_pieces_ends_its_connection_alone(policy: Policy) -> None:
    with served(policy) as port, client_of(port) as good:
        with client_of(port) as client, pytest.raises(ConnectionClosed):
            client.send(b"" for _ in range(1_000_000))
        assert ask(good, {"image": picture(0)}).shape == (1, 3)


def test_an_error_of_the_servers_own_is_logged_and_ends_its_connection_alone(
        policy: Policy, caplog: pytest.LogCaptureFixture) -> None:
    broken = dataclasses.replace(policy)
    agents = [policy.make_agent(), policy.make_agent()]
    agents[0].act = lambda frames: 1 / 0  # type: ignore[method-assign, assignment, return-value]
    object.__setattr__(broken, "make_agent", lambda: agents.pop(0))
    with served(broken) as port, client_of(port) as first, client_of(port) as second:
        first.send(pack({"image": picture(0)}))
        assert first.recv(10) == "an error of the server's own; its log says more"
        with pytest.raises(ConnectionClosed):
            first.recv(10)
        assert ask(second, {"image": picture(0)}).shape == (1, 3)
    assert "ZeroDivisionError" in caplog.text


def test_wrong_messages_leave_memory_and_good_clients_as_they_are(checkpoint: Path) -> None:
    storm = serving.endure(ROOT / "checkpoints" / "SpiralMaze.safetensors", 2000, oversized_every=60)
    assert set(storm.sent) >= {*serving.WRONG, "before the answer", "oversized", "broken frame", "cut off"}
    assert min(storm.sent.values()) >= 9 and storm.total >= 2000
    assert storm.refused > 1500 and storm.traceback == 0
    assert storm.closed == storm.sent["oversized"] + storm.sent["broken frame"] + storm.sent["cut off"]
    assert storm.good_steps > 50 and storm.good_wrong == 0
    assert storm.growth < 16


@pytest.mark.skipif(sys.platform != "linux", reason="reads the time that threads computed from /proc")
def test_a_step_without_a_plan_takes_ten_milliseconds_of_one_core_at_most() -> None:
    trips, computing = serving.step_times(ROOT / "checkpoints" / "ButtonWall.safetensors", 200)
    assert 0.1 < np.percentile(computing, 95) <= 10.0
    assert np.percentile(trips, 50) >= np.percentile(computing, 5)


def test_the_command_serves_until_it_is_told_to_stop(checkpoint: Path) -> None:
    with serving.server_process(checkpoint, "--method", "td3bc", "--device", "cpu") as (process, port):
        with client_of(port) as client:
            assert ask(client, {"image": picture(0)}).shape == (1, 3)
            process.send_signal(signal.SIGTERM)
            with pytest.raises(ConnectionClosed) as caught:
                client.recv(20)
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 1001
        until(lambda: not process.is_running() or process.status() == psutil.STATUS_ZOMBIE)


def test_the_command_names_what_is_wrong(checkpoint: Path, policy: Policy, capsys: pytest.CaptureFixture[str],
                                         monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("VELAP_API_KEY", raising=False)
    with served(policy) as taken:
        for arguments, text in [(["gone.safetensors"], "no checkpoint at gone.safetensors"),
                                ([str(checkpoint), "--method", "mcts"], "unknown method 'mcts'"),
                                ([str(checkpoint), "--method", "bc"], "no head at"),
                                ([str(checkpoint), "--host", "0.0.0.0"], "Set VELAP_API_KEY"),
                                ([str(checkpoint), "--port", "70000"], "expected 0 to 65535"),
                                ([str(checkpoint), "--port", str(taken)], f"cannot listen on 127.0.0.1, port {taken}")]:
            assert cli.main(["serve", *arguments]) == 2
            printed = capsys.readouterr().err
            assert text in printed and "Traceback" not in printed


@pytest.mark.parametrize("package", ["websockets", "msgpack"])
def test_missing_packages_are_named(package: str, checkpoint: Path) -> None:
    code = f"import sys; sys.modules[{package!r}] = None; from velap.cli import main; sys.exit(main(sys.argv[1:]))"
    done = subprocess.run([sys.executable, "-c", code, "serve", str(checkpoint)], capture_output=True, text=True)
    assert done.returncode == 2 and "pip install 'velap[serve]'" in done.stderr and "Traceback" not in done.stderr
