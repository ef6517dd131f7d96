"""Runs an experiment with its page: the page is served from before the first stage until the user stops it."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import webbrowser
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from advnerf_core.attack.objectives import CTE, load_objective
from advnerf_core.plugins import name_in_results
from advnerf_core.run_module import module_command
from nodes.experiment.engine.progress_record import ProgressRecord
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.attack import planned_evaluations
from nodes.experiment_page.server import HOST, PACKAGES
from nodes.operator_page.listening import bound_socket, require_packages
from nodes.runtime.termination import wait_or_kill

_LOG = "page.log"
_END_S = 3.0

Result = TypeVar("Result")
Say = Callable[[str], None]


class ExperimentPage:
    """The server's process. The experiment continues even if this process fails.

    Args:
        port: TCP port; 0 selects a free one.

    Raises:
        BusError: The port is taken.
        ConfigError: A package of the extra ``page`` is not installed.
    """

    def __init__(self, folder: Path, port: int) -> None:
        require_packages(PACKAGES)
        with bound_socket(HOST, port) as listening:
            listening.listen()  # from here on no other process can take the port
            self.url = f"http://{HOST}:{listening.getsockname()[1]}/"
            folder.mkdir(parents=True, exist_ok=True)
            number = listening.fileno()
            with (folder / _LOG).open("wb") as log:
                self._process = subprocess.Popen(
                    module_command("nodes.experiment_page.server", str(folder), str(number)),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    pass_fds=[number],
                    start_new_session=True,  # Ctrl-C is for the experiment
                )

    def __enter__(self) -> ExperimentPage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def is_served(self) -> bool:
        """Whether the server still runs."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Serve until Ctrl-C, or until the server has ended."""
        with contextlib.suppress(KeyboardInterrupt):
            self._process.wait()

    def close(self) -> None:
        """End the server."""
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        wait_or_kill(self._process, _END_S)


def run_with_page(
    experiment: Experiment,
    port: int,
    run: Callable[[ProgressRecord], Result],
    say: Say,
    opens: bool = False,
    stays: bool = True,
) -> Result:
    """Run an experiment while its page is served, then serve it until Ctrl-C.

    Args:
        port: TCP port; 0 selects a free one.
        say: Callback for messages: the address, and what to do at the end.
        opens: Whether the page is opened in the user's browser, if there is one.
        stays: Whether the page is still served when the experiment has ended.

    Raises:
        BusError: The port is taken; nothing was run.
    """
    about = {
        "name": experiment.config.name,
        "setting": experiment.setting,
        "planned": planned_evaluations(experiment),
        "space": experiment.config.space.kind,
        **_maximised(experiment.config.attack.objective),
    }
    with ExperimentPage(experiment.folder, port) as page:
        say(f"page: {page.url}")
        if opens and (browser := user_browser()) is not None:
            browser.open(page.url)
        record = ProgressRecord(experiment.folder, about)
        try:
            result = run(record)
        except Exception as error:
            reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
            record.end(reason)
            if stays:
                _serve_on(page, f"failed: {reason}", say)
            raise
        record.end()
        if stays:
            _serve_on(page, "finished", say)
        return result


def user_browser() -> webbrowser.BaseBrowser | None:
    """The user's browser; None without a display to open it on."""
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return None
    with contextlib.suppress(webbrowser.Error):
        return webbrowser.get()
    return None


def _serve_on(page: ExperimentPage, how: str, say: Say) -> None:
    if not page.is_served:
        say(f"{how}; the page ended before, see {_LOG} in the run folder")
        return
    say(f"{how}; page: {page.url} (how it ran: {page.url}run); Ctrl-C ends it")
    page.wait()


def _maximised(objective: str) -> dict[str, dict[str, str]]:
    """Name and unit of what searches are watched by; empty for the total CTE.

    Raises:
        PluginError: The objective's code cannot be loaded.
    """
    if objective == CTE:
        return {}
    return {"maximised": {"name": name_in_results(objective), "unit": load_objective(objective).unit}}
