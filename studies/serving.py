"""The robot server under fire and under a stopwatch: wrong messages of every kind beside a well-behaved client.

    velap study server --json results/serving.json

The server runs in a process of its own, so that its memory and its one core are its own.
"""

from __future__ import annotations

import contextlib
import platform
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from json import dumps
from pathlib import Path

import msgpack
import numpy as np
import psutil
from rich.console import Console
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

import velap
from velap.runs import write_atomic
from velap.serve.messages import MAX_MESSAGE, pack, unpack

SPIRAL = Path("checkpoints/SpiralMaze.safetensors")
OVERSIZED_EVERY = 500
"""One message in so many is longer than the server reads: each takes 16 MiB."""


@contextlib.contextmanager
def server_process(checkpoint: Path, *arguments: str, core: int | None = None) -> Iterator[tuple[psutil.Process, int]]:
    """`velap serve` on a free port in a process of its own, on one core where asked for; the process and its port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    code = "import sys; from velap.cli import main; sys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen([sys.executable, "-c", code, "serve", str(checkpoint), "--port", str(port), *arguments],
                               stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        if core is not None:
            psutil.Process(process.pid).cpu_affinity([core])
        _wait_for(port, process)
        yield psutil.Process(process.pid), port
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)


def _wait_for(port: int, process: subprocess.Popen[bytes], limit: float = 60.0) -> None:
    """Return once the port takes connections."""
    for _ in range(int(limit / 0.05)):
        if process.poll() is not None:
            raise RuntimeError(f"the server ended with exit code {process.returncode}")
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1):
            return
        time.sleep(0.05)
    raise RuntimeError(f"the server did not answer on port {port} within {limit:.0f} s")


def observation(side: int = 64, noise: int = 0, **more: object) -> dict[str, object]:
    """A picture of noise, as a client sends it."""
    return {"image": np.random.default_rng(noise).integers(0, 256, (side, side, 3), np.uint8), **more}


Wrong = Callable[[ClientConnection, np.random.Generator, bytes], None]
"""Sends something wrong over a connection: the connection, randomness, a right message to spoil."""


def _noise(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send(rng.bytes(int(rng.integers(0, 300))))


def _truncated(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send(right[: int(rng.integers(0, len(right)))])


def _flipped(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    spoilt = bytearray(right)
    for place in rng.integers(0, 60, 3):
        spoilt[place] ^= 1 << int(rng.integers(0, 8))
    client.send(bytes(spoilt))


def _text(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send("reset")


def _bomb(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send([b"\x81" * 50_000, b"\x91" * 50_000, b"\x80" * 50_000, b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff",
                 b"\xdc\xff\xff" + b"\x80" * 65_535][int(rng.integers(0, 6))])


def _pickled(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    objects = {b"__ndarray__": True, b"data": b"cos\nsystem\n(S'exit'\ntR.", b"dtype": "|O", b"shape": [1]}
    client.send(msgpack.packb({"image": objects}))


def _wrong_picture(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    picture = [np.zeros((64, 64, 3), np.float32), np.zeros((64, 48, 3), np.uint8), np.zeros((2, 64, 64, 3), np.uint8),
               np.zeros((64, 64, 4), np.uint8), np.zeros((0, 64, 3), np.uint8), np.zeros(3, np.uint8)][rng.integers(0, 6)]
    client.send(pack({"image": picture}))


def _wrong_values(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send(pack([None, [], {}, {"reset": "yes"}, observation(reset=2), observation(seed=-1), observation(seed=1.5),
                      {"image": "text"}][int(rng.integers(0, 8))]))


def _fragments(client: ClientConnection, rng: np.random.Generator, right: bytes) -> None:
    client.send(right[i : i + 700] for i in range(0, len(right) // 2, 700))


WRONG: dict[str, Wrong] = {
    "noise": _noise, "truncated": _truncated, "bits flipped": _flipped, "text": _text, "many entries": _bomb,
    "Python objects": _pickled, "wrong pictures": _wrong_picture, "wrong values": _wrong_values,
    "half in fragments": _fragments,
}


@dataclass
class Storm:
    """What happened under wrong messages."""

    sent: Counter[str] = field(default_factory=Counter)
    """Messages by kind."""
    refused: int = 0
    """Answers in words."""
    answered: int = 0
    """Answers with actions, of flipped bits that hit a picture or its name."""
    traceback: int = 0
    """Answers with a traceback: a fault of the server."""
    closed: int = 0
    """Connections that the server closed: oversized messages and broken frames."""
    memory: list[float] = field(default_factory=list)
    """Resident memory of the server, at the start and after every twentieth of the messages [MiB]."""

    @property
    def total(self) -> int:
        return sum(self.sent.values())


class Attacker:
    """Sends wrong messages over one connection, and takes a new one when the server closes it."""

    def __init__(self, port: int, seed: int) -> None:
        self._port, self._rng = port, np.random.default_rng(seed)
        self._right = pack(observation())
        self._next = 0
        self._open = contextlib.ExitStack()
        self._client = self._connect()
        self.storm = Storm()

    def _connect(self) -> ClientConnection:
        client = connect(f"ws://127.0.0.1:{self._port}", compression=None, max_size=None)
        client = self._open.enter_context(client)
        client.recv()
        return client

    def send(self, count: int, oversized_every: int = OVERSIZED_EVERY) -> None:
        """`count` messages, kinds in turn; now and then broken frames, too long ones, and eight before the first answer."""
        kinds = list(WRONG)
        for number in range(self._next, self._next + count):
            self._next = number + 1
            if number % oversized_every == oversized_every - 1:
                self._break(number // oversized_every)
            elif number % 97 == 96:
                self._ahead()
            else:
                kind = kinds[number % len(kinds)]
                self.storm.sent[kind] += 1
                try:
                    WRONG[kind](self._client, self._rng, self._right)
                    self._read()
                except ConnectionClosed:
                    self._reconnect()

    def _read(self) -> None:
        answer = self._client.recv(30)
        if isinstance(answer, bytes):
            self.storm.answered += 1
        else:
            self.storm.refused += 1
            self.storm.traceback += "Traceback" in answer

    def _reconnect(self) -> None:
        self.storm.closed += 1
        self.close()
        self._client = self._connect()

    def _ahead(self) -> None:
        """Out of order: eight messages before the first answer is read."""
        self.storm.sent["before the answer"] += 8
        try:
            for number in range(8):
                self._client.send(self._right if number % 2 else b"\xc1")
            for _ in range(8):
                self._read()
        except ConnectionClosed:
            self._reconnect()

    def _break(self, number: int) -> None:
        """A message that is too long, bytes that are no websocket frame, or an end in the middle of a frame."""
        kind = ("oversized", "broken frame", "cut off")[number % 3]
        self.storm.sent[kind] += 1
        try:
            if kind == "oversized":
                self._client.send(bytes(MAX_MESSAGE + 1))
                self._client.recv(30)
            elif kind == "broken frame":
                self._client.socket.sendall(b"\xff\xff" + self._rng.bytes(50))
                self._client.recv(30)
            else:
                self._client.socket.sendall(b"\x82\xfe\xff\xff0000" + self._rng.bytes(50))
                self._client.socket.shutdown(socket.SHUT_RDWR)
                self._client.recv(30)
        except (ConnectionClosed, OSError):
            self._reconnect()
        else:
            raise RuntimeError(f"the server answered a message of kind {kind!r}")

    def close(self) -> None:
        """Leave the server."""
        self._open.close()


class GoodClient(threading.Thread):
    """Plays episodes of noise beside a storm and keeps the server's actions; they are those of an agent of this process."""

    def __init__(self, port: int, seed: int, steps_an_episode: int = 40, server: int | None = None) -> None:
        super().__init__(daemon=True)
        self._port, self._seed, self._length, self._server = port, seed, steps_an_episode, server
        self._stop_asked = threading.Event()
        self.actions: list[np.ndarray] = []
        """[A] a step."""
        self.milliseconds: list[float] = []
        """Round trips of steps without planning."""
        self.computing: list[float] = []
        """What the process `server` computed in each of these [ms]."""
        self.error: Exception | None = None

    def run(self) -> None:
        try:
            with connect(f"ws://127.0.0.1:{self._port}", compression=None, max_size=None) as client:
                client.recv()
                while not self._stop_asked.is_set():
                    self._step(client)
        except Exception as error:
            self.error = error

    def _step(self, client: ClientConnection) -> None:
        step = len(self.actions)
        message = pack(observation(noise=step % self._length, reset=step % self._length == 0, seed=self._seed))
        computed = 0.0 if self._server is None else computing_time(self._server)
        began = time.perf_counter()
        client.send(message)
        answer = client.recv(60)
        took = (time.perf_counter() - began) * 1e3
        if isinstance(answer, str):
            raise RuntimeError(answer)
        read = unpack(answer)
        if "plan_ms" not in read["server_timing"]:
            self.milliseconds.append(took)
            self.computing.append(0.0 if self._server is None else computing_time(self._server) - computed)
        self.actions.append(read["actions"][0])

    def stop(self) -> None:
        """End after the step at hand."""
        self._stop_asked.set()
        self.join(60)

    def wrong_actions(self, checkpoint: Path, method: str) -> int:
        """Steps whose action is not that of a local agent in an undisturbed episode."""
        agent = velap.load(checkpoint, method, device="cpu")
        expected = []
        frames = [observation(noise=step)["image"] for step in range(self._length)]
        for step in range(min(len(self.actions), self._length)):
            if step == 0:
                agent.reset(np.ones(1, bool), np.array([self._seed]))
            rows = np.maximum(np.arange(step - agent.frame_stack + 1, step + 1), 0)
            expected.append(agent.act(np.stack([frames[row] for row in rows])[None])[0])
        pairs = ((action, expected[step % self._length]) for step, action in enumerate(self.actions))
        return sum(not np.allclose(action, right, atol=1e-4) for action, right in pairs)


@dataclass(frozen=True)
class Report:
    """A storm and the good client beside it."""

    storm: Storm
    seconds: float
    good_steps: int
    good_wrong: int
    """Steps of the good client that got another action than an undisturbed agent's."""
    growth: float
    """Resident memory at the end, less that after the first fifth of the messages [MiB]."""


def endure(checkpoint: Path, messages: int, method: str = "td3bc", oversized_every: int = OVERSIZED_EVERY) -> Report:
    """Run a server, a good client and `messages` wrong messages beside it."""
    with server_process(checkpoint, "--method", method, "--device", "cpu") as (process, port):
        good, attacker, began = GoodClient(port, seed=3), Attacker(port, seed=0), time.perf_counter()
        good.start()
        storm = attacker.storm
        storm.memory.append(process.memory_info().rss / 2**20)
        while storm.total < messages:
            attacker.send(max(messages // 20, 1), oversized_every)
            storm.memory.append(process.memory_info().rss / 2**20)
        attacker.close()
        good.stop()
        if good.error is not None:
            raise good.error
        seconds = time.perf_counter() - began
    fifth = len(storm.memory) // 5
    return Report(storm, seconds, len(good.actions), good.wrong_actions(checkpoint, method),
                  storm.memory[-1] - max(storm.memory[: fifth + 1]))


def step_times(checkpoint: Path, steps: int, method: str = "velap") -> tuple[np.ndarray, np.ndarray]:
    """Steps without planning, the server on one core: round trips, and the server's own computing of each [ms].

    Other work on the machine lengthens the round trips alone.
    """
    core = psutil.Process().cpu_affinity()[0]
    with server_process(checkpoint, "--method", method, "--device", "cpu", core=core) as (process, port):
        good = GoodClient(port, seed=3, server=process.pid)
        good.start()
        while len(good.milliseconds) < steps and good.is_alive():
            time.sleep(0.05)
        good.stop()
        if good.error is not None:
            raise good.error
    return np.array(good.milliseconds), np.array(good.computing)


def computing_time(process: int) -> float:
    """What all threads of a process have computed until now [ms]; Linux."""
    threads = Path(f"/proc/{process}/task").iterdir()
    return sum(int((thread / "schedstat").read_text().split()[0]) for thread in threads) / 1e6


def study_server(console: Console, quick: bool, json: Path | None, checkpoint: Path = SPIRAL) -> None:
    """100,000 wrong messages (3,000 if `quick`) beside a well-behaved client, and the time of steps on one core; the figures
    are printed, and written to `json`."""
    report = endure(checkpoint, 3_000 if quick else 100_000, oversized_every=100 if quick else OVERSIZED_EVERY)
    trips, computing = step_times(checkpoint, 200 if quick else 2_000)
    step, own = (np.percentile(times, [50, 95, 99]).round(2).tolist() for times in (trips, computing))
    load = round(psutil.getloadavg()[0], 1)
    storm, kinds = report.storm, ", ".join(f"{kind} {count}" for kind, count in report.storm.sent.items())
    console.print(
        f"{storm.total} wrong messages in {report.seconds:.0f} s: {storm.refused} refused in words, {storm.answered} still "
        f"an observation, {storm.closed} connections closed, {storm.traceback} tracebacks\nby kind: {kinds}\n"
        f"resident memory from {storm.memory[0]:.0f} to {storm.memory[-1]:.0f} MiB, {report.growth:+.1f} MiB after the "
        f"first fifth\nthe client beside: {report.good_steps} steps, {report.good_wrong} of them with a wrong action\n"
        f"a step without a plan, the server on one core: computing {own[0]} ms, 95 of 100 within {own[1]} ms; round trip "
        f"{step[0]} ms, 95 of 100 within {step[1]} ms (load average {load})",
        markup=False, soft_wrap=True)
    if json is not None:
        figures = {
            "messages": storm.total, "kinds": dict(storm.sent), "refused": storm.refused, "tracebacks": storm.traceback,
            "observations": storm.answered, "closed": storm.closed, "seconds": round(report.seconds, 1),
            "memory_mib": [round(value, 1) for value in storm.memory], "growth_mib": round(report.growth, 2),
            "good_steps": report.good_steps, "good_wrong": report.good_wrong,
            "step_computing_ms_p50_p95_p99": own,
            "step_round_trip_ms_p50_p95_p99": step,
            "load_average": load, "machine": f"{platform.machine()}, {psutil.cpu_count()} cores",
            "checkpoint": checkpoint.name,
        }
        write_atomic(json, (dumps(figures, indent=2) + "\n").encode())
        console.print(f"figures in {json}", markup=False)
