"""`velap study server`: wrong messages of every kind beside a well-behaved client, and the time of a step.

The server runs in a process of its own, so that its memory and its one core are its own.
"""

from __future__ import annotations

import contextlib
import json
import platform
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from rich.console import Console
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

import velap
from velap.runs import write_atomic
from velap.serve.messages import ARRAY, MAX_MESSAGE, pack, unpack

SPIRAL = Path("checkpoints/SpiralMaze.safetensors")
OVERSIZED_EVERY = 500
"""One message in so many is longer than the server reads: each takes 16 MiB."""
EPISODE = 40
"""Steps of the well-behaved client's episodes [steps]."""
SEED = 3
"""Its episode seed."""


@contextlib.contextmanager
def server_process(checkpoint: Path, *arguments: str, core: int | None = None) -> Iterator[tuple[psutil.Process, int]]:
    """`velap serve` on a free port in a process of its own, on one core where asked for; the process and its port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    process = subprocess.Popen([sys.executable, "-m", "velap", "serve", str(checkpoint), "--port", str(port), *arguments],
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


@contextlib.contextmanager
def client_of(port: int) -> Iterator[ClientConnection]:
    """A connection that has read the server's greeting."""
    with connect(f"ws://127.0.0.1:{port}", compression=None, max_size=None) as client:
        client.recv()
        yield client


def observation(noise: int = 0, **more: object) -> dict[str, Any]:
    """A picture of noise, as a client sends it."""
    return {"image": np.random.default_rng(noise).integers(0, 256, (64, 64, 3), np.uint8), **more}


_BOMBS = (b"\x81" * 50_000, b"\x91" * 50_000, b"\x80" * 50_000, b"\xdd\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff",
          b"\xdc\xff\xff" + b"\x80" * 65_535)
"""Maps and lists in each other, or of more entries than the message holds."""
_PICKLE = {ARRAY: True, b"data": b"cos\nsystem\n(S'exit'\ntR.", b"dtype": "|O", b"shape": [1]}
_PICTURES = [np.zeros((64, 64, 3), np.float32), *(np.zeros(shape, np.uint8) for shape in (
    (64, 48, 3), (2, 64, 64, 3), (64, 64, 4), (0, 64, 3), 3))]
_VALUES: list[Any] = [None, [], {}, {"reset": "yes"}, observation(reset=2), observation(seed=-1), observation(seed=1.5),
                      {"image": "text"}]


def _flipped(rng: np.random.Generator, right: bytes) -> bytes:
    """Three bits flipped among the names and sizes at the beginning."""
    spoilt = bytearray(right)
    for place in rng.integers(0, 60, 3):
        spoilt[place] ^= 1 << int(rng.integers(0, 8))
    return bytes(spoilt)


WRONG: dict[str, Callable[[np.random.Generator, bytes], Any]] = {
    "noise": lambda rng, right: rng.bytes(int(rng.integers(0, 300))),
    "truncated": lambda rng, right: right[: int(rng.integers(0, len(right)))],
    "bits flipped": _flipped,
    "text": lambda rng, right: "reset",
    "many entries": lambda rng, right: _BOMBS[rng.integers(len(_BOMBS))],
    "Python objects": lambda rng, right: pack({"image": _PICKLE}),
    "wrong pictures": lambda rng, right: pack({"image": _PICTURES[rng.integers(len(_PICTURES))]}),
    "wrong values": lambda rng, right: pack(_VALUES[rng.integers(len(_VALUES))]),
    "half in fragments": lambda rng, right: (right[i : i + 700] for i in range(0, len(right) // 2, 700)),
}
"""What is sent of each kind, bytes, text or fragments, by randomness and a right message."""


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
    seconds: float = 0.0
    good_steps: int = 0
    """Steps of the well-behaved client."""
    good_wrong: int = 0
    """Those of them whose action was not that of an undisturbed agent."""

    @property
    def total(self) -> int:
        """All messages."""
        return sum(self.sent.values())

    @property
    def growth(self) -> float:
        """Memory at the end, less the most of the first fifth [MiB]."""
        return self.memory[-1] - max(self.memory[: len(self.memory) // 5 + 1])


class Attacker:
    """Sends wrong messages over one connection, and opens a new one when the server closes it."""

    def __init__(self, port: int, storm: Storm) -> None:
        self._port, self._storm, self._rng = port, storm, np.random.default_rng(0)
        self._right, self._number = pack(observation()), 0

    def send(self, count: int, oversized_every: int) -> None:
        """`count` messages, the kinds in turn; now and then broken frames, oversized ones, and eight before an answer."""
        end = self._number + count
        while self._number < end:
            with client_of(self._port) as client:
                try:
                    while self._number < end:
                        self._number += 1
                        self._send_one(client, self._number, oversized_every)
                except (ConnectionClosed, OSError):
                    self._storm.closed += 1

    def _send_one(self, client: ClientConnection, number: int, oversized_every: int) -> None:
        if number % oversized_every == 0:
            self._break(client, number // oversized_every)
        elif number % 97 == 0:
            self._storm.sent["before the answer"] += 8
            for part in range(8):
                client.send(self._right if part % 2 else b"\xc1")
            for _ in range(8):
                self._read(client)
        else:
            kind = list(WRONG)[number % len(WRONG)]
            self._storm.sent[kind] += 1
            client.send(WRONG[kind](self._rng, self._right))
            self._read(client)

    def _read(self, client: ClientConnection) -> None:
        answer = client.recv(30)
        if isinstance(answer, bytes):
            self._storm.answered += 1
        else:
            self._storm.refused += 1
            self._storm.traceback += "Traceback" in answer

    def _break(self, client: ClientConnection, number: int) -> None:
        """An oversized message, bytes that are no websocket frame, or an end in the middle of a frame."""
        kind = ("oversized", "broken frame", "cut off")[number % 3]
        self._storm.sent[kind] += 1
        if kind == "oversized":
            client.send(bytes(MAX_MESSAGE + 1))
        elif kind == "broken frame":
            client.socket.sendall(b"\xff\xff" + self._rng.bytes(50))
        else:
            client.socket.sendall(b"\x82\xfe\xff\xff0000" + self._rng.bytes(50))
            client.socket.shutdown(socket.SHUT_RDWR)
        client.recv(30)
        raise RuntimeError(f"the server answered a message of kind {kind!r}")


@dataclass
class Played:
    """What a well-behaved client got."""

    actions: list[np.ndarray] = field(default_factory=list)
    """[A] a step."""
    milliseconds: list[float] = field(default_factory=list)
    """Round trips of the steps without planning [ms]."""
    computing: list[float] = field(default_factory=list)
    """What the server computed in each of these [ms]."""


def play(port: int, done: Callable[[Played], bool], server: int | None = None) -> Played:
    """Play episodes of noise until `done`; `server` is the process whose computing is measured."""
    played = Played()
    with client_of(port) as client:
        while not done(played):
            step = len(played.actions) % EPISODE
            message = pack(observation(noise=step, reset=step == 0, seed=SEED))
            computed, began = computing_time(server), time.perf_counter()
            client.send(message)
            answer = client.recv(60)
            took = (time.perf_counter() - began) * 1e3
            if isinstance(answer, str):
                raise RuntimeError(answer)
            read = unpack(answer)
            if "plan_ms" not in read["server_timing"]:
                played.milliseconds.append(took)
                played.computing.append(computing_time(server) - computed)
            played.actions.append(read["actions"][0])
    return played


def computing_time(process: int | None) -> float:
    """What all threads of a process have computed until now [ms], on Linux; 0 without a process."""
    threads = [] if process is None else Path(f"/proc/{process}/task").iterdir()
    return sum(int((thread / "schedstat").read_text().split()[0]) for thread in threads) / 1e6


def expected_actions(checkpoint: Path, method: str) -> np.ndarray:
    """[EPISODE, A] actions of an agent of this process in the client's episode."""
    agent = velap.load(checkpoint, method, device="cpu")
    agent.reset(np.ones(1, bool), np.array([SEED]))
    frames = np.stack([observation(noise=step)["image"] for step in range(EPISODE)])
    stacks = (frames[np.maximum(np.arange(step - agent.frame_stack + 1, step + 1), 0)] for step in range(EPISODE))
    return np.concatenate([agent.act(stack[None]) for stack in stacks])


def endure(checkpoint: Path, messages: int, method: str = "td3bc", oversized_every: int = OVERSIZED_EVERY) -> Storm:
    """Run a server, a well-behaved client and `messages` wrong messages beside it."""
    storm, stop, began = Storm(), threading.Event(), time.perf_counter()
    with (server_process(checkpoint, "--method", method, "--device", "cpu") as (process, port),
          ThreadPoolExecutor(1) as pool):
        good = pool.submit(play, port, lambda played: stop.is_set())
        try:
            attacker = Attacker(port, storm)
            storm.memory.append(process.memory_info().rss / 2**20)
            while storm.total < messages:
                attacker.send(max(messages // 20, 1), oversized_every)
                storm.memory.append(process.memory_info().rss / 2**20)
        finally:
            stop.set()
        actions = np.stack(good.result().actions)
        storm.seconds = time.perf_counter() - began
    right = np.resize(expected_actions(checkpoint, method), actions.shape)
    storm.good_steps, storm.good_wrong = len(actions), int((~np.isclose(actions, right, atol=1e-4)).any(1).sum())
    return storm


def step_times(checkpoint: Path, steps: int, method: str = "velap") -> tuple[np.ndarray, np.ndarray]:
    """Steps without planning, the server on one core: round trips, and the server's own computing of each [ms].

    Other work on the machine lengthens the round trips alone.
    """
    core = psutil.Process().cpu_affinity()[0]
    with server_process(checkpoint, "--method", method, "--device", "cpu", core=core) as (process, port):
        played = play(port, lambda played: len(played.milliseconds) >= steps, process.pid)
    return np.array(played.milliseconds), np.array(played.computing)


def study_server(console: Console, quick: bool, path: Path | None, checkpoint: Path = SPIRAL) -> None:
    """100,000 wrong messages (3,000 if `quick`) beside a well-behaved client, and the time of steps on one core; the figures
    are printed, and written to `path` as JSON."""
    storm = endure(checkpoint, 3_000 if quick else 100_000, oversized_every=100 if quick else OVERSIZED_EVERY)
    step, own = (np.percentile(times, [50, 95, 99]).round(2).tolist()
                 for times in step_times(checkpoint, 200 if quick else 2_000))
    load = round(psutil.getloadavg()[0], 1)
    kinds = ", ".join(f"{kind} {count}" for kind, count in storm.sent.items())
    console.print(
        f"{storm.total} wrong messages in {storm.seconds:.0f} s: {storm.refused} refused in words, {storm.answered} still "
        f"an observation, {storm.closed} connections closed, {storm.traceback} tracebacks\nby kind: {kinds}\n"
        f"resident memory from {storm.memory[0]:.0f} to {storm.memory[-1]:.0f} MiB, {storm.growth:+.1f} MiB after the "
        f"first fifth\nthe client beside: {storm.good_steps} steps, {storm.good_wrong} of them with a wrong action\n"
        f"a step without a plan, the server on one core: computing {own[0]} ms, 95 of 100 within {own[1]} ms; round trip "
        f"{step[0]} ms, 95 of 100 within {step[1]} ms (load average {load})",
        markup=False, soft_wrap=True)
    if path is not None:
        figures = {
            "messages": storm.total, "kinds": dict(storm.sent), "refused": storm.refused, "tracebacks": storm.traceback,
            "observations": storm.answered, "closed": storm.closed, "seconds": round(storm.seconds, 1),
            "memory_mib": [round(value, 1) for value in storm.memory], "growth_mib": round(storm.growth, 2),
            "good_steps": storm.good_steps, "good_wrong": storm.good_wrong,
            "step_computing_ms_p50_p95_p99": own,
            "step_round_trip_ms_p50_p95_p99": step,
            "load_average": load, "machine": f"{platform.machine()}, {psutil.cpu_count()} cores",
            "checkpoint": checkpoint.name,
        }
        write_atomic(path, (json.dumps(figures, indent=2) + "\n").encode())
        console.print(f"figures in {path}", markup=False)
