"""Starts plain ROS 2 programs (rclpy, zenoh_ros2_sdk), whose environment is not ours: ``make setup-ros2`` installs it."""

from __future__ import annotations

import json
import os
import subprocess
import threading
from pathlib import Path

ROOT = Path(__file__).parents[1]
PEERS = Path(__file__).parent / "rclpy_peers"


def rclpy_python() -> Path | None:
    """Python of the rclpy environment: ``ADVNERF_RCLPY_PYTHON``, or ``.venv-ros2`` in the repository; None if there is none."""
    # The link itself, as what it points to is the Python without the environment.
    python = Path(os.environ.get("ADVNERF_RCLPY_PYTHON", ROOT / ".venv-ros2" / "bin" / "python")).absolute()
    return python if python.exists() else None


def peers_have(module: str) -> bool:
    """Whether that environment has a module. rclpy has no wheels for arm64."""
    python = rclpy_python()
    command = [str(python), "-c", f"import {module}"]
    return python is not None and subprocess.run(command, capture_output=True, check=False).returncode == 0


class RclpyPeer:
    """A running program; what it prints is collected as data, one line of JSON each."""

    def __init__(self, domain_id: int, script: Path, *arguments: str) -> None:
        python = rclpy_python()
        assert python is not None
        kept = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        self.process = subprocess.Popen(
            [str(python), str(script), *arguments],
            stdout=subprocess.PIPE,
            text=True,
            env={**kept, "ROS_DOMAIN_ID": str(domain_id)},
            cwd=PEERS,
        )
        self.lines: list = []
        self._thread = threading.Thread(target=self._collect, daemon=True)
        self._thread.start()

    def _collect(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(json.loads(line))

    def close(self) -> None:
        self.process.kill()
        self.process.wait()
        self._thread.join(5.0)
