"""Makes the pictures of the experiment page for the documentation: ``python -m benchmarks.experiment_page_pictures`` (six minutes)."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

from benchmarks.page_pictures import save
from benchmarks.results import REPOSITORY
from tests.support.live.page_browser import CHROMIUM, PHONE, available
from tests.support.live.processes import end

EXPERIMENT = REPOSITORY / "launch" / "room.experiment.yaml"
# The demo with a third method, and without what the pictures do not show.
_SETTINGS = [
    "over.method=[none,random,cem,gradient]",
    "policy.naive_steps=0",
    "deploy.through=world",
    "deploy.starts=null",
]
_DESK = {"viewport": {"width": 1400, "height": 1000}, "color_scheme": "light"}
_PHONE = {**PHONE, "color_scheme": "dark"}
# The command imports for a few seconds, beside busy neighbours for a minute.
_START_S, _LONGEST_S = 600.0, 1800.0
# The last of three searches, when more than half of it is done.
_WORTH_A_LOOK = """() => document.querySelectorAll('#searches .card').length >= 3
  && /^[67]\\d %/.test(document.querySelector('tr.running .quiet')?.textContent)"""


@contextlib.contextmanager
def watched_experiment(
    folder: Path, settings: Sequence[str]
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """An experiment in the simulated lab with its page, on a free port.

    Args:
        folder: Gets the run folder ``run`` and the log.
        settings: ``key=value`` texts.

    Yields:
        The command's process, and the page's address.
    """
    changes = [part for each in settings for part in ("--set", each)]
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "experiment",
        "run",
        str(EXPERIMENT),
        "--setting",
        "demo",
        "--anew",
    ]
    command += ["--folder", str(folder / "run"), "--page", "--page-port", "0", *changes]
    file = folder / "experiment.log"
    with file.open("wb") as log:
        process = subprocess.Popen(
            command, cwd=REPOSITORY, stdout=log, stderr=log, env={"MUJOCO_GL": "egl", **os.environ}
        )
    try:
        yield process, _address(process, file)
    finally:
        end(process)


def _address(process: subprocess.Popen[bytes], log: Path) -> str:
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline and process.poll() is None:
        if found := re.search(r"page: (http://\S+)", log.read_text()):
            return found.group(1)
        time.sleep(0.1)
    raise TimeoutError(f"the experiment served no page: {log.read_text()[-2000:]}")


def main() -> None:
    if not available():
        raise SystemExit("needs chromium and playwright")
    from playwright.sync_api import sync_playwright

    with (
        tempfile.TemporaryDirectory(prefix="advnerf-") as folder,
        watched_experiment(Path(folder), _SETTINGS) as (_, url),
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=str(CHROMIUM), args=["--no-sandbox"])
        pages = {
            name: browser.new_context(**options).new_page()
            for name, options in (("desk", _DESK), ("phone", _PHONE))
        }
        for page in pages.values():
            page.goto(f"{url}run")
        pages["desk"].wait_for_function(_WORTH_A_LOOK, timeout=1000 * _LONGEST_S)
        for name, page in pages.items():
            save("experiment_page", name, page.screenshot())
        browser.close()


if __name__ == "__main__":
    main()
