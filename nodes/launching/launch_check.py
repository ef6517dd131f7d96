"""Check the configuration of the nodes of a launch file, by asking the nodes themselves. No node is started."""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from advnerf_core.documents import dump_yaml
from advnerf_core.run_module import module_command
from nodes.launching.launch_file import Plan
from nodes.runtime.config import node_document

_TIMEOUT_S = 60.0


def check_nodes(plan: Plan) -> dict[str, str]:
    """Return the configuration errors by node; empty if every node accepts its configuration.

    Each node's module is run with ``--check``: it reads its configuration, prints errors and exits. Files that a node reads when it
    starts, such as a policy or an attack, are not opened.
    """
    with (
        tempfile.TemporaryDirectory(prefix="advnerf-check-") as folder,
        _processes(plan, Path(folder)) as processes,
    ):
        problems: dict[str, str] = {}
        for name, process in processes.items():
            try:
                _, errors = process.communicate(timeout=_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                problems[name] = (
                    f"{name}: expected the check to end within {_TIMEOUT_S:g} s, but it is still running"
                )
                continue
            if process.returncode:
                lines = errors.strip().splitlines()
                problems[name] = lines[-1] if lines else f"{name}: ended with exit code {process.returncode}"
        return problems


@contextmanager
def _processes(plan: Plan, folder: Path) -> Iterator[dict[str, subprocess.Popen[str]]]:
    processes: dict[str, subprocess.Popen[str]] = {}
    try:
        for name, entry in plan.nodes.items():
            config = folder / f"{name}.yaml"
            config.write_text(dump_yaml(node_document(plan.documents[name])), encoding="utf-8")
            command = module_command(entry.module, "--check", "--config", str(config))
            processes[name] = subprocess.Popen(
                [*command, "--folder", str(folder), "--name", name],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        yield processes
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stderr is not None:
                process.stderr.close()
