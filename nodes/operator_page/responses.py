"""Answers of the web server: the page's own files, and headers that keep the browser from loading anything else."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from typing import Any

from advnerf_core.report.palette import look_css
from nodes.operator_page.doors import host_is_ours
from nodes.operator_page.said import LONGEST_BYTES

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
}
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; media-src 'self'; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = {
    "content-security-policy": _POLICY,
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), microphone=(), geolocation=()",
    "cache-control": "no-store",
}


class Guard:
    """Refuses requests for another host, and adds to every response the security headers that it does not set itself.

    Args:
        names: Further names of this computer.
        refused: Called for every refused request.
    """

    def __init__(self, application: Any, names: tuple[str, ...], refused: Callable[[], None]) -> None:
        self._application, self._names, self._refused = application, names, refused

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        """Pass a request on, or refuse it."""
        host = next((value.decode("latin-1") for name, value in scope["headers"] if name == b"host"), "")
        if not host_is_ours(host, self._names):
            self._refused()
            await _refuse(scope, send)
            return
        if scope["type"] == "websocket":
            await self._application(scope, receive, send)
            return

        async def send_with_headers(event: Any) -> None:
            if event["type"] == "http.response.start":
                given = list(event.get("headers", []))
                own = {name for name, _ in given}
                ours = [(name.encode(), value.encode()) for name, value in _HEADERS.items()]
                event = {**event, "headers": [*given, *(each for each in ours if each[0] not in own)]}
            await send(event)

        await self._application(scope, receive, send_with_headers)


async def _refuse(scope: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})
        return
    await send({"type": "http.response.start", "status": 421, "headers": [(b"content-type", b"text/plain")]})
    await send({"type": "http.response.body", "body": b"this computer has no such name\n"})


async def body_of(request: Any) -> bytes:
    """Read a small body; of a larger one, a beginning that is longer than any small one."""
    body = b""
    async for part in request.stream():
        body += part
        if len(body) > LONGEST_BYTES:
            break
    return body


def web_file(name: str, package: str = "nodes.operator_page") -> Any:
    """Response with a file of the package's ``web/``, or with the shared style sheet; status 404 for any other name."""
    from starlette.responses import Response

    if name == "look.css":
        return Response(look_css(), headers={"content-type": _TYPES[".css"]})
    folder = files(package) / "web"
    found = {file.name: file for file in folder.iterdir()}.get(name)
    suffix = f".{name.rpartition('.')[2]}"
    if found is None or suffix not in _TYPES:
        return Response(status_code=404)
    return Response(found.read_bytes(), headers={"content-type": _TYPES[suffix]})
