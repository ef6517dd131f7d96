"""The web server of the page, in a separate thread.

Every request must name this computer as its host. Acts come over one WebSocket, which is accepted only with a session and from the
page's own origin. All pages and scripts come from this package: the content policy of the browser forbids anything else.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import math
import socket
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from nodes.linking.keys import is_loopback
from nodes.operator_page.certificate import Certificate, certificate
from nodes.operator_page.client import Client, ClientAct, Gone, Misuse
from nodes.operator_page.config import PageConfig
from nodes.operator_page.doors import COOKIE, Sessions, origin_is_ours, peer_is_same_user
from nodes.operator_page.listening import bound_socket, require_packages
from nodes.operator_page.pictures import Picture
from nodes.operator_page.responses import Guard, body_of, web_file
from nodes.operator_page.said import LONGEST_BYTES, STOPS, Stop, Take, read_entry
from nodes.runtime.errors import BusError
from nodes.runtime.inbox import Inbox

_PACKAGES = ("starlette", "uvicorn", "websockets", "cryptography")
_MOST_CLIENTS = 16
_MOST_CONNECTIONS = 96
_WRONG_CODE_S = 1.0
_CONFIRM_S, _LOOK_S = 0.9, 0.02
_START_S = 10.0


@dataclass
class RefusalCounts:
    """Counts of refused and closed requests.

    Attributes:
        refused: Refused requests and connections: wrong host or origin, no session, wrong code.
        malformed: Refused messages of connected browsers.
        closed: Connections that were closed for misuse.
    """

    refused: int = 0
    malformed: int = 0
    closed: int = 0


@dataclass
class PageServer:
    """Serves the page.

    Attributes:
        inbox: Receives the acts of browsers, and `Gone`.
        png_of: Returns the picture of an attack by its id; None without one.
        welcome: Returns the first message for a new browser.
        stops: Returns the number of requests to stop, and the number up to which they are confirmed.
    """

    settings: PageConfig
    inbox: Inbox[Any]
    png_of: Callable[[str], bytes | None]
    welcome: Callable[[], Mapping[str, Any]]
    stops: Callable[[], tuple[int, int]] = lambda: (0, 0)
    counts: RefusalCounts = field(default_factory=RefusalCounts)

    def __post_init__(self) -> None:
        require_packages(_PACKAGES)
        self.tls: Certificate | None = None if is_loopback(self.settings.host) else certificate()
        self.doors = Sessions(self.settings.code_s)
        self._door_lock = threading.Lock()
        self._socket = bound_socket(self.settings.host, self.settings.port)
        self.port = int(self._socket.getsockname()[1])
        self._cookie = f"{COOKIE}_{self.port}"
        self._clients: dict[int, Client] = {}
        self._numbers = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: Any = None
        self._started = threading.Event()
        self._thread = threading.Thread(target=self._run, name="page", daemon=True)

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self.settings.host
        if host in ("0.0.0.0", "::"):
            host = socket.gethostname()
        return f"{'https' if self.tls else 'http'}://{f'[{host}]' if ':' in host else host}:{self.port}/"

    @property
    def viewers(self) -> int:
        """Number of connected browsers."""
        return len(self._clients)

    def wanted(self) -> frozenset[int]:
        """Channels that some browser shows (any thread)."""
        return frozenset().union(*(client.wants for client in list(self._clients.values())))

    def renew_code(self, mono_ns: int) -> bool:
        """Make a new one-time code if the last one was used or has expired. Returns whether it is new."""
        with self._door_lock:
            return self.doors.renew(mono_ns)

    def start(self) -> None:
        """Start the thread, and wait until the page is served."""
        self._thread.start()
        if not self._started.wait(_START_S):
            raise BusError(f"the page was not served within {_START_S:g} s; see the log of the node")

    def close(self) -> None:
        """Stop the server and close all connections."""
        if self._server is not None:
            self._server.should_exit = self._server.force_exit = True
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._socket.close()

    def send_state(self, state: str) -> None:
        """Send the state to all browsers (any thread)."""
        self._each(lambda client: client.offer_state(state))

    def send_picture(self, picture: Picture) -> None:
        """Send a picture to the browsers that show its channel (any thread)."""
        self._each(lambda client: client.offer_picture(picture))

    def send_beat(self, number: int, beat: int) -> None:
        """Send a beat to the operator's browser (any thread)."""
        self._one(number, lambda client: client.offer_beat(beat))

    def answer(self, number: int, answer: dict[str, Any]) -> None:
        """Answer an act of a browser (any thread)."""
        self._one(number, lambda client: client.answer(answer))

    def _each(self, do: Callable[[Client], None]) -> None:
        def run() -> None:
            for client in self._clients.values():
                do(client)

        self._soon(run)

    def _one(self, number: int, do: Callable[[Client], None]) -> None:
        def run() -> None:
            if client := self._clients.get(number):
                do(client)

        self._soon(run)

    def _soon(self, run: Callable[[], None]) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has just been closed
                self._loop.call_soon_threadsafe(run)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except BaseException as failure:  # raised again in the node's loop
            self.inbox.fail(failure)
        self._started.set()

    async def _serve(self) -> None:
        import uvicorn

        self._loop = asyncio.get_running_loop()
        config = uvicorn.Config(
            self._application(),
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            ws="websockets-sansio",
            ws_max_size=LONGEST_BYTES,
            ws_per_message_deflate=False,
            ws_ping_interval=2.0,
            ws_ping_timeout=4.0,
            limit_concurrency=_MOST_CONNECTIONS,
            timeout_graceful_shutdown=1,
            ssl_certfile=None if self.tls is None else str(self.tls.file),
            ssl_keyfile=None if self.tls is None else str(self.tls.key_file),
        )
        self._server = uvicorn.Server(config)
        asyncio.get_running_loop().call_later(0.05, self._note_start)
        await self._server.serve(sockets=[self._socket])

    def _note_start(self) -> None:
        if self._server.started:
            self._started.set()
        else:
            asyncio.get_running_loop().call_later(0.02, self._note_start)

    def _application(self) -> Any:
        from starlette.applications import Starlette
        from starlette.routing import Route, WebSocketRoute

        routes = [
            Route("/", self._index),
            Route("/session", self._session),
            Route("/enter", self._enter, methods=["POST"]),
            Route("/stop/{kind}", self._stop, methods=["POST"]),
            Route("/web/{name}", self._file),
            Route("/attack/{attack_id}", self._attack),
            WebSocketRoute("/live", self._live),
        ]
        return Guard(Starlette(routes=routes), self.settings.names, self._refuse)

    def _refuse(self) -> None:
        self.counts.refused += 1

    async def _index(self, request: Any) -> Any:
        return web_file("index.html")

    async def _session(self, request: Any) -> Any:
        """Say whether this browser may watch. One of the same user on the same computer gets its session here."""
        from starlette.responses import JSONResponse

        admitted = self._admitted(request)
        same_user = not admitted and self._same_user(request)
        response = JSONResponse({"open": admitted or same_user})
        if same_user:
            self._set_cookie(response, request)
        return response

    async def _enter(self, request: Any) -> Any:
        """Exchange the one-time code for a session."""
        from starlette.responses import JSONResponse

        entry = read_entry(await body_of(request))
        token, host = "", request.client.host
        if entry is None:
            self.counts.refused += 1
            return JSONResponse({"open": False}, status_code=400)
        if self._from_page(request):
            with self._door_lock:
                wait_s = self.doors.wait_s(host, time.monotonic_ns())
                turn_s = 0.0 if wait_s else self.doors.turn_s(host, time.monotonic_ns())
            if wait_s:
                self.counts.refused += 1
                headers = {"Retry-After": str(math.ceil(wait_s))}
                return JSONResponse({"open": False, "wait_s": math.ceil(wait_s)}, 429, headers)
            await asyncio.sleep(turn_s)
            with self._door_lock:
                token = self.doors.enter(entry.code, host, time.monotonic_ns(), entry.name)
        if not token:
            self.counts.refused += 1
            await asyncio.sleep(_WRONG_CODE_S)
            return JSONResponse({"open": False}, status_code=403)
        response = JSONResponse({"open": True})
        self._put_cookie(response, token)
        return response

    async def _stop(self, request: Any) -> Any:
        """Stop the car for an admitted browser that has no WebSocket, for example because all places are taken."""
        from starlette.responses import JSONResponse

        kind = request.path_params["kind"]
        if not (self._from_page(request) and self._admitted(request) and kind in STOPS):
            self.counts.refused += 1
            return JSONResponse({"confirmed": False}, status_code=403)
        before, _ = self.stops()
        session, name = self._public(request), self._name(request)
        self.inbox.put(ClientAct(0, request.client.host, Stop(t=kind), 0, 0, session, name), urgent=True)
        deadline = time.monotonic() + _CONFIRM_S
        while not before < self.stops()[1] and time.monotonic() < deadline:
            await asyncio.sleep(_LOOK_S)
        return JSONResponse({"confirmed": before < self.stops()[1]})

    async def _file(self, request: Any) -> Any:
        return web_file(request.path_params["name"])

    async def _attack(self, request: Any) -> Any:
        from starlette.responses import Response

        png = self.png_of(request.path_params["attack_id"]) if self._admitted(request) else None
        return Response(status_code=404) if png is None else Response(png, media_type="image/png")

    async def _live(self, websocket: Any) -> None:
        """Serve one browser until it goes."""
        if not (self._from_page(websocket) and self._admitted(websocket)):
            self.counts.refused += 1
            await websocket.close(1008)
            return
        if len(self._clients) >= _MOST_CLIENTS:
            await websocket.close(1013)
            return
        await websocket.accept()
        self._numbers += 1
        session = self._public(websocket)
        client = Client(self._numbers, websocket.client.host, websocket, session, self._name(websocket))
        self._clients[client.number] = client
        client.answer(
            {"t": "welcome", "client": client.number, "session": session, "key": client.key, **self.welcome()}
        )
        sending = asyncio.create_task(client.send_for_ever())
        try:
            await self._listen(websocket, client)
        finally:
            sending.cancel()
            del self._clients[client.number]
            self.inbox.put(Gone(client.number))
            with contextlib.suppress(asyncio.CancelledError, Exception):
                await sending  # it may have failed with its connection

    async def _listen(self, websocket: Any, client: Client) -> None:
        while True:
            event = await websocket.receive()
            if event["type"] == "websocket.disconnect":
                return
            before = client.malformed
            try:
                data = event.get("text")
                asked = client.hear(event.get("bytes") or b"" if data is None else data)
            except Misuse as misuse:
                self.counts.closed += 1
                await websocket.close(1008, str(misuse)[:100])
                return
            finally:
                self.counts.malformed += client.malformed - before
            if asked is not None and isinstance(asked.act, Take):
                with self._door_lock:
                    self.doors.rename(websocket.cookies[self._cookie], asked.name)
            if asked is not None:
                self.inbox.put(asked, urgent=isinstance(asked.act, Stop))

    def _from_page(self, connection: Any) -> bool:
        headers = connection.headers
        return origin_is_ours(headers.get("origin"), headers.get("host", ""), self.tls is not None)

    def _public(self, connection: Any) -> str:
        """Public name of a session."""
        return hashlib.sha256(connection.cookies[self._cookie].encode()).hexdigest()[:12]

    def _name(self, connection: Any) -> str:
        """Name of the person of a session."""
        with self._door_lock:
            return self.doors.name(connection.cookies[self._cookie])

    def _admitted(self, connection: Any) -> bool:
        token = connection.cookies.get(self._cookie, "")
        with self._door_lock:
            return self.doors.knows(token, connection.client.host, time.monotonic_ns())

    def _same_user(self, connection: Any) -> bool:
        """Whether the browser runs on this computer as the user of the node, and the page is only served here."""
        if self.tls is not None:
            return False
        peer, ours = connection.client, connection.scope["server"]
        return is_loopback(peer.host) and peer_is_same_user((peer.host, peer.port), (ours[0], ours[1]))

    def _set_cookie(self, response: Any, request: Any) -> None:
        with self._door_lock:
            token = self.doors.admit(request.client.host, time.monotonic_ns())
        self._put_cookie(response, token)

    def _put_cookie(self, response: Any, token: str) -> None:
        response.set_cookie(
            self._cookie, token, httponly=True, samesite="strict", secure=self.tls is not None
        )
