"""A browser without a browser: speaks the protocol of the operator page on real sockets. For benchmarks and tests."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import ssl
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Origin


def request(
    port: int,
    path: str = "/",
    headers: dict[str, str] | None = None,
    method: str = "GET",
    body: str | None = None,
    tls: bool = False,
    source: tuple[str, int] | None = None,
) -> tuple[int, Any, bytes]:
    """One HTTP request: status, headers, body. The certificate of a ``tls`` connection is not checked here."""
    connection: http.client.HTTPConnection
    if tls:
        context = unchecked()
        connection = http.client.HTTPSConnection(
            "127.0.0.1", port, timeout=60, context=context, source_address=source
        )
    else:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60, source_address=source)
    try:
        connection.request(method, path, body, headers or {})
        response = connection.getresponse()
        return response.status, response.headers, response.read()
    finally:
        connection.close()


def unchecked() -> ssl.SSLContext:
    """TLS to a self-signed certificate that is not checked."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    return context


def cookie_of(port: int) -> str:
    """The session that a browser of this user gets."""
    _, headers, _ = request(port, "/session")
    return str(headers["set-cookie"]).partition(";")[0]


class Browser:
    """A browser, as far as the node can tell: answers beats while it holds, and draws every picture."""

    def __init__(
        self,
        port: int,
        cookie: str | None = None,
        origin: str | None = None,
        tls: bool = False,
        answers: bool = True,
    ) -> None:
        scheme = "https" if tls else "http"
        opening = connect(
            f"{'wss' if tls else 'ws'}://127.0.0.1:{port}/live",
            origin=Origin(f"{scheme}://127.0.0.1:{port}" if origin is None else origin),
            additional_headers={"Cookie": cookie_of(port) if cookie is None else cookie},
            ssl=unchecked() if tls else None,
            compression=None,
            max_size=2**22,
        )
        self.welcome: dict[str, Any] = {}
        self.state: dict[str, Any] = {}
        self.answers: list[dict[str, Any]] = []
        self.pictures: list[tuple[int, str, bytes]] = []
        self.beats: list[int] = []
        self.press, self.held, self.responsive = 0, False, answers
        self.frame, self.closed, self._n, self._lock = "0", False, 0, threading.Lock()
        self._loop: asyncio.AbstractEventLoop
        self._outbox: asyncio.Queue[str | None]
        self._transport: Any
        # One thread reads and writes: a TLS socket that two threads use loses a message now and then.
        opened: Future[None] = Future()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._live(opening, opened)), daemon=True)
        self._thread.start()
        opened.result()
        self.wait(lambda: self.welcome and self.state, "the welcome")
        self.tell({"t": "wants", "c": [0, 1]})

    async def _live(self, opening: connect, opened: Future[None]) -> None:
        try:
            socket = await opening
        except BaseException as refusal:  # raised in the thread that opens
            opened.set_exception(refusal)
            return
        self._loop, self._outbox, self._transport = (
            asyncio.get_running_loop(),
            asyncio.Queue(),
            socket.transport,
        )
        sending = asyncio.create_task(self._send(socket))
        opened.set_result(None)
        try:
            async for data in socket:
                if isinstance(data, bytes):
                    self._draw(data)
                else:
                    self._hear(json.loads(data))
        except ConnectionClosed:
            pass
        finally:
            self.closed = True
            sending.cancel()

    async def _send(self, socket: ClientConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            while (text := await self._outbox.get()) is not None:
                await socket.send(text)
            await socket.close()

    def _draw(self, data: bytes) -> None:
        stamp = str(int.from_bytes(data[1:9], "big"))
        self.pictures.append((data[0], stamp, data[9:]))
        self.frame = stamp
        if self.responsive:
            self.tell({"t": "seen", "c": data[0], "s": stamp})

    def _hear(self, message: dict[str, Any]) -> None:
        kind = message["t"]
        if kind == "welcome":
            self.welcome = message
        elif kind == "state":
            self.state = message
        elif kind == "beat":
            self.beats.append(message["beat"])
            if self.held and self.responsive:
                self.act("hold", beat=message["beat"], press=self.press)
        else:
            self.answers.append(message)

    def tell(self, message: dict[str, Any]) -> None:
        self.send_text(json.dumps(message))

    def send_text(self, text: str | None) -> None:
        """Send ``text``, well-formed or not; None closes the connection after what was sent before."""
        self._soon(self._outbox.put_nowait, text)

    def cut(self) -> None:
        """End the connection without a word, as a browser that crashed."""
        self._soon(self._transport.abort)

    def _soon(self, run: Callable[..., object], *arguments: object) -> None:
        with contextlib.suppress(RuntimeError):  # the connection has ended, and its loop with it
            self._loop.call_soon_threadsafe(run, *arguments)

    def act(self, kind: str, **more: Any) -> int:
        with self._lock:
            self._n += 1
            self.tell({"t": kind, "key": self.welcome["key"], "n": self._n, "frame": self.frame, **more})
            return self._n

    def do(self, kind: str, **more: Any) -> str:
        """An act and why it was refused; empty if it was done."""
        number = self.act(kind, **more)
        found = lambda: [a for a in self.answers if a.get("n") == number]  # noqa: E731
        self.wait(found, f"an answer to {kind}")
        return found()[0]["refused"]

    def take(self, name: str = "Ann") -> str:
        self.wait(lambda: self.frame != "0", "a picture")
        return self.do("take", name=name)

    def hold(self) -> None:
        self.press, self.held = self.press + 1, True

    def release(self) -> str:
        self.held = False
        return self.do("release", press=self.press)

    def wait(self, condition: Callable[[], Any], what: str, timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"gave up waiting for {what}; {self.answers[-3:]}"
            time.sleep(0.005)

    def close(self) -> None:
        self.send_text(None)
        self._thread.join()
