"""The web server of the experiment page, run as a separate process: ``python -m nodes.experiment_page.server RUN_FOLDER SOCKET``.

It only reads, has the lowest priority, and ends when its standard input closes, that is with its parent process. All
requests are answered from a run folder; the two processes share nothing but the files that the experiment writes there.
"""

from __future__ import annotations

import hashlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

from nodes.experiment.engine.progress_record import read_progress
from nodes.experiment_page import shown_files
from nodes.experiment_page.searches import has_texture, read_search, texture_png
from nodes.experiment_page.state import cell_names, read_state, report_is_shown
from nodes.operator_page.responses import Guard, web_file
from nodes.runtime.priority import HELPER, take_share

HOST = "127.0.0.1"
PACKAGES = ("starlette", "uvicorn")
_PACKAGE = "nodes.experiment_page"
_MOST_CONNECTIONS = 64
_STATE_PERIOD_S = 0.5
# The report contains its style and pictures and runs no script.
_REPORT_POLICY = (
    "default-src 'none'; img-src 'self' data:; media-src 'self' data:; style-src 'unsafe-inline'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'"
)


class RequestHandler:
    """Answers the requests of browsers; the clock says seconds since 1970."""

    def __init__(self, folder: Path, clock_s: Callable[[], float] = time.time) -> None:
        self._folder, self._clock_s = folder, clock_s
        self._lock = threading.Lock()
        self._state: tuple[float, bytes, str] = (0.0, b"", "")

    def start(self, request: Any) -> Any:
        """The report once the experiment has ended with one, else the page of the run."""
        from starlette.responses import RedirectResponse

        shown = report_is_shown(self._folder, read_progress(self._folder))
        return RedirectResponse(f"/{shown_files.REPORT}" if shown else "/run", status_code=307)

    def run(self, request: Any) -> Any:
        """The page about the running experiment."""
        return web_file("index.html", _PACKAGE)

    def web(self, request: Any) -> Any:
        """A file of the page itself."""
        return web_file(request.path_params["name"], _PACKAGE)

    def icon(self, request: Any) -> Any:
        """The icon of all pages, which browsers also ask for beside a report."""
        return web_file("icon.svg")

    def state(self, request: Any) -> Any:
        """The page's current data; without content if the browser has it already."""
        from starlette.responses import Response

        body, tag = self._state_now()
        if request.headers.get("if-none-match") == tag:
            return Response(status_code=304, headers={"etag": tag})
        return Response(body, headers={"etag": tag}, media_type="application/json")

    def texture(self, request: Any) -> Any:
        """The best texture of a cell."""
        from starlette.responses import Response

        record, name = read_progress(self._folder), request.path_params["name"]
        png = None
        if name in cell_names(record):
            folder = self._folder / "cells" / name
            search = read_search(folder)
            if search is not None and has_texture(record["space"]):
                png = _texture(folder, search.version)
        return Response(status_code=404) if png is None else Response(png, media_type="image/png")

    def file(self, request: Any) -> Any:
        """A picture, a film, or a file of the report."""
        from starlette.responses import FileResponse, Response

        name, record = request.path_params["path"], read_progress(self._folder)
        known = shown_files.pictures(self._folder) | shown_files.films(self._folder, cell_names(record))
        known |= shown_files.report_files(self._folder) | shown_files.recorded_files(self._folder)
        if name not in known:
            return Response(status_code=404)
        file = known[name]
        headers = {"content-security-policy": _REPORT_POLICY} if file.suffix == ".html" else {}
        return FileResponse(file, media_type=shown_files.type_of(file), headers=headers)

    def _state_now(self) -> tuple[bytes, str]:
        """The state as JSON and its tag, made at most twice a second for all browsers together."""
        with self._lock:
            made_s, body, tag = self._state
            if time.monotonic() - made_s > _STATE_PERIOD_S:
                body = json.dumps(read_state(self._folder, self._clock_s())).encode()
                tag = f'"{hashlib.sha256(body).hexdigest()[:16]}"'
                self._state = (time.monotonic(), body, tag)
            return body, tag


@lru_cache(maxsize=64)
def _texture(folder: Path, version: str) -> bytes | None:
    del version  # of what was found
    return texture_png(folder)


def application(answers: RequestHandler) -> Any:
    """The ASGI application: GET only."""
    from starlette.applications import Starlette
    from starlette.routing import Route

    routes = [
        Route("/", answers.start),
        Route("/run", answers.run),
        Route("/favicon.ico", answers.icon),
        Route("/web/{name}", answers.web),
        Route("/state.json", answers.state),
        Route("/texture/{name}.png", answers.texture),
        Route("/{path:path}", answers.file),
    ]
    return Guard(Starlette(routes=routes), (), lambda: None)


def main() -> None:
    """Serve until standard input ends."""
    import uvicorn

    folder, number = Path(sys.argv[1]), int(sys.argv[2])
    take_share(HELPER)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    config = uvicorn.Config(
        application(RequestHandler(folder)),
        log_config=None,
        access_log=False,
        server_header=False,
        lifespan="off",
        ws="none",
        limit_concurrency=_MOST_CONNECTIONS,
        timeout_keep_alive=10,
    )
    uvicorn.Server(config).run(sockets=[socket.socket(fileno=number)])


def _end_with_parent() -> None:
    sys.stdin.buffer.read()
    os._exit(0)


if __name__ == "__main__":
    main()
