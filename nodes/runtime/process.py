"""Run a node as a process: build it, run its loop, and close it in order, also after an error."""

from __future__ import annotations

import argparse
import gc
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TypeVar

from pydantic import BaseModel

from advnerf_core.errors import AdvnerfError
from nodes.runtime.bus import Bus
from nodes.runtime.clock import SystemClock
from nodes.runtime.config import load_node_config
from nodes.runtime.errors import BagError, ConfigError, NodeFinished, TakenError, TopicError
from nodes.runtime.loop import NodeLoop
from nodes.runtime.node import FAULT, STARTING, Node, NodeContext
from nodes.runtime.prepare import prepare_process
from nodes.runtime.termination import ending_signals
from nodes.runtime.topics import status_topic

C = TypeVar("C", bound=BaseModel)
WRONG_REQUEST = 2
"""Exit code of a node that cannot be built with its configuration."""
# Errors of a node's `build` that the user can fix. They are printed without a traceback.
_WRONG_REQUEST = (BagError, ConfigError, TopicError)


class _Signals:
    """Handler of SIGINT and of `ending_signals`, which end the loop or, before the loop exists, the process."""

    def __init__(self) -> None:
        self._loop: NodeLoop | None = None
        self._previous = {
            number: signal.signal(number, self._handle) for number in (signal.SIGINT, *ending_signals())
        }

    def attach(self, loop: NodeLoop) -> None:
        self._loop = loop
        signal.set_wakeup_fd(loop.wakeup_fd, warn_on_full_buffer=False)

    def restore(self) -> None:
        signal.set_wakeup_fd(-1)
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del number, frame  # all signals have the same effect
        if self._loop is None:
            raise SystemExit(0)
        self._loop.stop()


def run_node(
    build: Callable[[NodeContext], Node],
    name: str,
    run_dir: Path,
    on_loop: Callable[[NodeLoop], None] | None = None,
) -> int:
    """Run a node until SIGINT, one of `ending_signals`, `NodeFinished` or an exception.

    Args:
        build: Makes the node and opens its devices.
        name: Name of the node, whose status is published on ``/status/<name>``.
        run_dir: Folder of the run.
        on_loop: Called with the loop before it runs, so that a test can stop it.

    Returns:
        Exit code: 0 after a regular end, 1 after a fault (one line on stderr, traceback in ``<run_dir>/logs`` unless a topic is
        taken), 2 if the node cannot be built with this configuration (one line on stderr).
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    signals = _Signals() if in_main_thread else None
    runner = _Runner(name, Path(run_dir))
    try:
        runner.start(build)
        if signals is not None and runner.loop is not None:
            signals.attach(runner.loop)
        if on_loop is not None and runner.loop is not None:
            on_loop(runner.loop)
        runner.run()
    except NodeFinished:
        pass
    except Exception as error:  # any error: make the device safe, print one line, return an error code
        runner.close_node()
        runner.fail(error)
    finally:
        runner.close_node()  # signals are still ignored: a second Ctrl-C must not interrupt making the device safe
        if signals is not None:
            signals.restore()
        runner.close()
    return runner.exit_code


class _Runner:
    """Builds, runs and takes down one node in the right order."""

    def __init__(self, name: str, run_dir: Path) -> None:
        self._name, self._run_dir, self._clock = name, run_dir, SystemClock()
        self._bus: Bus | None = None
        self._node: Node | None = None
        self.loop: NodeLoop | None = None
        self.exit_code = 0

    def start(self, build: Callable[[NodeContext], Node]) -> None:
        self._bus = Bus(self._run_dir, self._clock)
        # Opened before any device: a second node with this name in this run folder fails here.
        self._bus.publisher(status_topic(self._name))
        self._node = build(NodeContext(self._name, self._run_dir, self._clock, self._bus.subscribers))
        # Freeze the existing objects, so that the garbage collector skips them while the car drives. This takes time, so it
        # is done before the subscriptions open.
        gc.collect()
        gc.freeze()
        self.loop = NodeLoop(self._name, self._node, self._bus, self._clock)
        self.loop.publish_status(self._clock.now(), STARTING, "")

    def run(self) -> None:
        assert self.loop is not None
        self.loop.run()

    def fail(self, error: Exception) -> None:
        if self.loop is None and isinstance(error, _WRONG_REQUEST):
            self.exit_code = WRONG_REQUEST
            print(f"{self._name}: {_one_line(error)}", file=sys.stderr, flush=True)
            return
        self.exit_code = 1
        line = f"{self._name}: {_one_line(error)}"
        if self.loop is None and isinstance(error, TakenError):  # it says everything
            print(line, file=sys.stderr, flush=True)
            return
        log = self._run_dir / "logs" / f"{self._name}.traceback.txt"
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.write_text("".join(traceback.format_exception(error)), encoding="utf-8")
            line += f" (traceback in {log})"
        except OSError as second:
            line += f" (no traceback written: {second.strerror})"
        print(line, file=sys.stderr, flush=True)
        if self.loop is not None:
            try:
                self.loop.publish_status(self._clock.now(), FAULT, _one_line(error))
            except Exception as second:  # the node must still be closed
                print(f"{self._name}: could not report the fault: {second}", file=sys.stderr, flush=True)

    def close_node(self) -> None:
        """Close the node once. This happens before anything is logged, so that a slow disk cannot keep the car moving."""
        node, self._node = self._node, None
        if node is None:
            return
        try:
            node.close()
        except Exception as error:  # the sockets must still be closed
            self.fail(error)
        if node.inbox is not None:
            node.inbox.close()

    def close(self) -> None:
        self.close_node()
        if self._bus is not None:
            self._bus.close(farewell=self.loop is not None)
        if self.loop is not None:
            self.loop.close()


def run_node_main(config_type: type[C], build: Callable[[C, NodeContext], Node]) -> int:
    """Run the command line of a node process, which the launch supervisor starts.

    Args:
        config_type: Schema of the node's configuration.
        build: Makes the node from its configuration and context.

    Returns:
        Exit code: 0 after a regular end, 1 after a fault, 2 if the configuration is wrong.
    """
    module = sys.modules["__main__"].__spec__
    role = module.name.rsplit(".", 1)[-1] if module is not None else Path(sys.argv[0]).stem
    parser = argparse.ArgumentParser(prog=f"python -m nodes.{role}", description=f"The {role} node.")
    parser.add_argument(
        "--config",
        type=Path,
        help="YAML or JSON file with the configuration of the node (default: default values)",
    )
    parser.add_argument("--folder", type=Path, required=True, help="folder of the run, for sockets and logs")
    parser.add_argument("--name", default=role, help="name of the node (default: %(default)s)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="overrides", help="override a key"
    )
    parser.add_argument("--check", action="store_true", help="check the configuration, print errors and exit")
    options = parser.parse_args()
    if not options.check:  # several nodes are checked in one process
        prepare_process(role)
    try:
        config = load_node_config(config_type, options.name, options.config, options.overrides)
    except (ValueError, OSError) as error:
        print(f"{options.name}: {_one_line(error)}", file=sys.stderr, flush=True)
        return 2
    if options.check:
        return 0
    return run_node(lambda context: build(config, context), options.name, options.folder)


def _one_line(error: BaseException) -> str:
    text = " ".join(str(error).split()) or "no message"
    # Messages of advnerf's own exceptions are complete. Other exceptions need the type to be understood.
    return text if isinstance(error, AdvnerfError) else f"{type(error).__name__}: {text}"
