"""The server: openpi's websocket protocol, so that robots with openpi-client need no code of velap.

The server sends one message about itself first. Every message of the client is an observation, every binary answer a dict
with `actions`, every text answer an error in words; the connection and its episode go on after an error. `GET /healthz`
answers `OK`. Networks run on one thread; the connections' observations are taken in turn.
"""

from __future__ import annotations

import asyncio
import hmac
import ipaddress
import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from typing import Any, TypeVar

import torch
from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from velap.errors import ConfigError, VelapError
from velap.serve.messages import MAX_MESSAGE, MessageError, pack, unpack
from velap.serve.session import PictureReader, Policy, Session
from velap.signals import stop_signals
from velap.threads import one_thread

HOST, PORT = "127.0.0.1", 8000
"""This machine alone, and the port of openpi."""
MAX_CLIENTS = 16
"""Connections at once; each holds an agent and at most three messages. ours."""
INTERNAL_ERROR = 1011
"""Close code of RFC 6455 for an error of the server's own."""
LOG = logging.getLogger("velap.serve")
_QUIET = logging.getLogger("velap.serve.websockets")
"""websockets logs a traceback for every stranger whose opening request is wrong."""
_QUIET.setLevel(logging.CRITICAL)
Answer = TypeVar("Answer")


class Server:
    """Serves a policy to several clients, each with an episode of its own."""

    def __init__(self, policy: Policy, *, host: str = HOST, port: int = PORT, api_key: str | None = None,
                 image_key: str | None = None, max_clients: int = MAX_CLIENTS, max_message: int = MAX_MESSAGE) -> None:
        """Settings of the server; nothing is opened before `run`.

        Args:
            policy: what acts.
            host: address to listen on; other than this machine's own only with an `api_key`.
            port: 0 takes a free one.
            api_key: what clients must send as `Authorization: Api-Key KEY`; None lets every client of this machine in.
            image_key: key of the picture in observations, or `a,b` of several; None takes the only picture there is, or
                those named as in the training data.
            max_clients: connections at once.
            max_message: longest message that is read [bytes].
        """
        if api_key is None and not _is_local(host):
            raise ConfigError(f"the server would listen on {host} without a key; expected one, for whoever reaches that "
                              "address moves the robot. Set VELAP_API_KEY, or leave --host at 127.0.0.1.")
        if not 0 <= port <= 65_535:
            raise ConfigError(f"the port is {port}; expected 0 to 65535, 0 for a free one. Name another with --port.")
        if api_key == "":
            raise ConfigError("the API key is empty; expected some text. Set VELAP_API_KEY to it, or leave it unset.")
        PictureReader(policy.spaces, image_key, policy.reading)  # other cameras than the model's are an error of the start
        self._policy, self._host, self._port, self._image_key = policy, host, port, image_key
        self._authorization = None if api_key is None else f"Api-Key {api_key}".encode()
        self._max_clients, self._max_message = max_clients, max_message
        self._clients = 0
        self._worker = ThreadPoolExecutor(1, "velap-serve")
        self._stop: Callable[[], object] = lambda: None

    async def run(self, on_start: Callable[[int], object] = lambda port: None) -> None:
        """Serve until `stop` or a signal of `velap.signals`; `on_start` is called with the port once clients can connect."""
        loop, stopped = asyncio.get_running_loop(), asyncio.Event()
        self._stop = lambda: loop.call_soon_threadsafe(stopped.set)
        for number in stop_signals():
            with suppress(NotImplementedError, RuntimeError, ValueError):  # Windows, and threads other than the main one
                loop.add_signal_handler(number, stopped.set)
        try:
            # Without compression a message has the length that it says. Browsers send an Origin: no web page gets in.
            server = await serve(self._handle, self._host, self._port, process_request=self._admit, compression=None,
                                 max_size=self._max_message, max_queue=1, origins=[None], logger=_QUIET)
        except OSError as error:
            raise ConfigError(f"cannot listen on {self._host}, port {self._port}: {error.strerror or error}. Stop what "
                              "listens there, or name another --host or --port.") from error
        try:
            on_start(next(iter(server.sockets)).getsockname()[1])
            await stopped.wait()
        finally:
            server.close()
            await server.wait_closed()
            self._worker.shutdown()

    def stop(self) -> None:
        """End `run`, from any thread."""
        self._stop()

    def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """The answer to an HTTP request; None lets a client in."""
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if self._authorization is not None:
            sent = "".join(request.headers.get_all("Authorization")).encode()
            if not hmac.compare_digest(sent, self._authorization):
                refused = "wrong or missing API key; expected the header `Authorization: Api-Key KEY`\n"
                return connection.respond(HTTPStatus.UNAUTHORIZED, refused)
        if self._clients >= self._max_clients:
            full = f"{self._clients} clients are connected, the most that are served; close one\n"
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, full)
        return None

    async def _handle(self, connection: ServerConnection) -> None:
        """Answer one client until it leaves."""
        self._clients += 1
        name, steps, refused = str(connection.remote_address), 0, 0
        try:
            LOG.info("%s connected", name)
            session = await self._in_worker(partial(Session, self._policy, self._image_key))
            await connection.send(pack(dict(self._policy.about)))
            async for message in connection:
                answer = await self._in_worker(partial(_answer, session, message))
                if isinstance(answer, bytes):
                    steps += 1
                else:
                    refused += 1
                    if refused == 1:
                        LOG.warning("%s: refused, and its further ones are only counted: %s", name, answer)
                await connection.send(answer)
        except ConnectionClosed as closed:
            LOG.info("%s: %s", name, closed)
        except Exception:
            LOG.exception("%s: an error of the server's own; its connection is closed", name)
            with suppress(ConnectionClosed):
                await connection.send("an error of the server's own; its log says more")
                await connection.close(INTERNAL_ERROR, "server error")
        finally:
            self._clients -= 1
            LOG.info("%s left after %d steps; %d observations refused", name, steps, refused)

    async def _in_worker(self, work: Callable[[], Answer]) -> Answer:
        """Run `work` on the thread of the networks."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, work)


def _answer(session: Session, message: str | bytes) -> str | bytes:
    """The answer to a message: packed actions, or in text what is wrong with the message."""
    began = time.perf_counter()
    try:
        if isinstance(message, str):
            raise MessageError("got text; expected a binary msgpack message.")
        with one_thread(torch.device("cpu"), small=True):
            answer = session.step(unpack(message))
    except VelapError as error:
        return str(error)
    timing: dict[str, Any] = {"infer_ms": (time.perf_counter() - began) * 1e3}
    if "plan_ms" in answer:
        timing["plan_ms"] = answer.pop("plan_ms")
    return pack({**answer, "server_timing": timing})


def _is_local(host: str) -> bool:
    """Whether only this machine reaches an address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
