"""A person with a phone: Chromium driven by Playwright, on this computer or on another host of a `tests.support.live.network.Cable`."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from hardware.mocap.vicon import free_udp_port
from tests.support.live.operator import LiveOperator
from tests.support.live.processes import REPOSITORY, end

CHROMIUM = Path("/usr/bin/chromium")
LAUNCH_FILE = REPOSITORY / "launch" / "page.launch.yaml"
NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor", "page")
PHONE = {
    "viewport": {"width": 390, "height": 844},
    "device_scale_factor": 2,
    "is_mobile": True,
    "has_touch": True,
}
LONG_MS = 60_000


def available() -> bool:
    """Whether Playwright and Chromium are installed."""
    from importlib.util import find_spec

    return CHROMIUM.exists() and find_spec("playwright") is not None


def says(page: Any, selector: str, words: str) -> None:
    """Wait until a part of the page has these words."""
    page.wait_for_function(
        "([selector, words]) => document.querySelector(selector).innerText.includes(words)",
        arg=[selector, words],
        timeout=LONG_MS,
    )


@contextlib.contextmanager
def live_page(
    *settings: str, inside: Sequence[str] = (), host: str = "127.0.0.1", port: int = 0, straight: bool = True
) -> Iterator[LiveOperator]:
    """The launch file of the page at work, with a car that stands ready.

    Args:
        settings: Further ``--set`` values.
        inside: What to put before the command, such as a network namespace.
        host: Address of the page.
        port: Its port.
        straight: Drive with a policy that always answers the same, which needs no training.
    """
    chosen = [
        f"params.page_host={host}",
        f"params.page_port={port}",
        f"params.vicon_port={free_udp_port()}",
        *(
            ("policy.module=tests.support.live.straight_policy", "params.counterfactual=false")
            if straight
            else ()
        ),
        *settings,
    ]
    with tempfile.TemporaryDirectory(prefix="advnerf-") as folder:
        overrides = [part for setting in chosen for part in ("--set", setting)]
        command = [
            sys.executable,
            "-m",
            "nodes.cli",
            "launch",
            str(LAUNCH_FILE),
            "--folder",
            folder,
            *overrides,
        ]
        environment = {**os.environ, "XDG_CONFIG_HOME": f"{folder}/config"}
        with open(Path(folder) / "supervisor.log", "wb") as log:
            supervisor = subprocess.Popen(
                [*inside, *command], cwd=REPOSITORY, stdout=log, stderr=log, env=environment
            )
        operator = LiveOperator(Path(folder), NODES)
        try:
            operator.wait_ready(timeout_s=120.0)
            yield operator
        finally:
            operator.bus.close()
            end(supervisor)


def door_of(run_dir: Path, other_than: str = "") -> dict[str, Any]:
    """Address, code and fingerprint of the page of a run, once its code is another one than that."""
    deadline = time.monotonic() + 20.0
    while True:
        with contextlib.suppress(FileNotFoundError):
            door: dict[str, Any] = read_json(run_dir / "page" / "door.json")
            if door["url"].startswith("http:") or door["code"] != other_than:
                return door
        if time.monotonic() > deadline:
            raise TimeoutError("the page shows no new code")
        time.sleep(0.05)


class Phone:
    """A browser with the page of a run.

    Args:
        playwright: A running Playwright.
        run_dir: Folder of the run.
        inside: What to put before the browser's command, such as a network namespace.
        options: Options of the browser's context; `PHONE` by default.
    """

    def __init__(
        self,
        playwright: Any,
        run_dir: Path,
        inside: Sequence[str] = (),
        options: dict[str, Any] | None = None,
    ) -> None:
        self._run_dir = run_dir
        self._folder = tempfile.TemporaryDirectory(prefix="advnerf-phone-")
        self._pid_file = Path(self._folder.name) / "pid"
        start = Path(self._folder.name) / "chromium"
        start.write_text(f'#!/bin/sh\necho $$ > {self._pid_file}\nexec {" ".join(inside)} {CHROMIUM} "$@"\n')
        start.chmod(0o700)
        self.browser = playwright.chromium.launch(executable_path=str(start), args=["--no-sandbox"])
        self.context = self.browser.new_context(
            ignore_https_errors=True, **(PHONE if options is None else options)
        )
        self.console: list[str] = []
        self.requests: list[str] = []
        self.page: Any = None
        self._code = ""

    @property
    def pid(self) -> int:
        """Process of the browser."""
        return int(self._pid_file.read_text())

    def open(self, name: str = "") -> Any:
        """Open the page, with the one-time code and a name where it asks for them. Returns it."""
        door = door_of(self._run_dir)
        self.page = self.context.new_page()
        self.page.on("console", lambda said: self.console.append(f"{said.type}: {said.text}"))
        self.page.on("pageerror", lambda error: self.console.append(f"error: {error}"))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(door["url"])
        self.page.wait_for_selector("#enter:not([hidden]), #main:not([hidden])")
        if self.page.is_visible("#enter"):
            door = door_of(self._run_dir, self._code)
            self._code = door["code"]
            self.page.fill("#code", door["code"])
            self.page.fill("#who", name)
            self.page.click("#enter-form button")
        self.page.wait_for_selector("#main:not([hidden])")
        self.page.wait_for_selector("#picture-1[data-stamp]")
        return self.page

    def take(self, name: str = "Ann") -> None:
        """Take control."""
        self.page.fill("#name", name)
        self.page.click("#take-form button")
        self.page.wait_for_selector("#hold:not([disabled])")

    def hold(self) -> None:
        """Put the mouse on the button and press."""
        box = self.page.locator("#hold").bounding_box()
        self.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        self.page.mouse.down()

    def let_go(self) -> None:
        """Release the mouse."""
        self.page.mouse.up()

    def kill(self) -> None:
        """Kill the browser with all its processes, as a phone's system does."""
        import psutil

        main = psutil.Process(self.pid)
        for process in [main, *main.children(recursive=True)]:
            with contextlib.suppress(psutil.NoSuchProcess):
                process.send_signal(signal.SIGKILL)

    def close(self) -> None:
        """Close the browser."""
        with contextlib.suppress(Exception):  # a killed browser cannot be closed
            self.browser.close()
        self._folder.cleanup()
