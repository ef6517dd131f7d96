"""Serves one simulator to advnerf: ``python -I serve.py SIMULATOR.py ENDPOINT``.

This file runs in the simulator's own environment. It needs Python 3.10, pyzmq and numpy, and nothing of advnerf, so that the two
environments never meet. ``SIMULATOR.py`` defines ``open_simulator(config, cameras)``, which also takes arrays where its world sends some;
docs/worlds.md says what it returns.

A message is a header of JSON and one frame of raw bytes for each array, C-contiguous, little-endian, in the header's order:

    request   {"protocol": 1, "sequence": 7, "call": "render", "arguments": {...}, "arrays": [["name", "<f8", [4, 4]]]}
    answer    {"protocol": 1, "sequence": 7, "result": {...}, "arrays": [...]}
    refusal   {"protocol": 1, "sequence": 7, "error": "ValueError: ...", "arrays": []}

The client asks, the server answers, one at a time. The server ends when its standard input is closed, or with the client's process.
"""

from __future__ import annotations

import ctypes
import importlib.util
import json
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np
import zmq

PROTOCOL = 1
_PR_SET_PDEATHSIG = 1


class Server:
    """Answers calls with the methods of a simulator, which the call ``open`` makes.

    Args:
        open_simulator: Called with the configuration, the cameras and the arrays of ``open``.
    """

    def __init__(self, open_simulator: Callable[..., Any], socket: zmq.Socket[bytes]) -> None:
        self._open_simulator, self._socket = open_simulator, socket
        self._simulator: Any = None

    def run(self) -> None:
        """Answer until the process ends."""
        while True:
            self.send(*self.answer(*self.receive()))

    def receive(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The next request: header and arrays by name."""
        head, *frames = self._socket.recv_multipart()
        header = json.loads(head)
        listed = zip(header["arrays"], frames, strict=True)
        return header, {
            name: np.frombuffer(frame, dtype).reshape(shape) for (name, dtype, shape), frame in listed
        }

    def answer(self, header: dict[str, Any], arrays: dict[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
        """Header and arrays of the answer. What the simulator raises becomes a refusal; the client decides what follows."""
        kept = {"protocol": PROTOCOL, "sequence": header["sequence"]}
        if header["protocol"] != PROTOCOL:
            return {**kept, "error": f"protocol {header['protocol']} is not served here"}, {}
        try:
            result, given = self._call(header["call"], header["arguments"], arrays)
        except Exception as error:
            traceback.print_exc()
            return {**kept, "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}, {}
        return {**kept, "result": result}, given

    def _call(self, name: str, arguments: dict[str, Any], arrays: dict[str, Any]) -> Any:
        if name == "hello":
            return {"python": sys.version.split()[0], "numpy": np.__version__}, {}
        if name == "open":
            self._simulator = self._open_simulator(**arguments, **arrays)
            return self._simulator.describe()
        if name not in ("render", "reset", "step", "add_panel", "add_mesh"):
            raise ValueError(f"expected a call of the protocol, got {name!r}")
        return getattr(self._simulator, name)(**arguments, **arrays)

    def send(self, header: dict[str, Any], arrays: dict[str, Any]) -> None:
        """Send an answer."""
        frames = [np.ascontiguousarray(array) for array in arrays.values()]
        header["arrays"] = [
            [name, frame.dtype.str, list(frame.shape)] for name, frame in zip(arrays, frames, strict=True)
        ]
        self._socket.send_multipart([json.dumps(header).encode()] + [frame.tobytes() for frame in frames])


def end_with_client() -> None:
    """Die with the client, also if the client is killed or the simulator hangs."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.read(0, 1):
            pass
        os._exit(0)

    threading.Thread(target=watch, daemon=True).start()


def load(file: str) -> Any:
    """Import a file as a module; its imports search its environment first, then its folder."""
    sys.path.append(os.path.dirname(os.path.abspath(file)))
    spec = importlib.util.spec_from_file_location("simulator", file)
    if spec is None or spec.loader is None:
        raise ValueError(f"expected a simulator in a file NAME.py, got {file}")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def main(server: type[Server] = Server) -> None:
    """Serve the simulator and the endpoint of the command line."""
    end_with_client()
    file, endpoint = sys.argv[1:]
    socket = zmq.Context().socket(zmq.PAIR)
    socket.connect(endpoint)
    # A simulator is imported when it is opened: what its import prints, or breaks, comes after the first answer.
    server(lambda **arguments: load(file).open_simulator(**arguments), socket).run()


if __name__ == "__main__":
    main()
