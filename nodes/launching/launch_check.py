"""Check the configuration of the nodes of a launch file, by asking the nodes themselves. No node is started."""

from __future__ import annotations

import json
import subprocess
import tempfile
from pathlib import Path

from advnerf_core.documents import dump_yaml, parse_json
from advnerf_core.run_module import module_command
from nodes.launching.launch_file import Plan
from nodes.launching.one_car import mixtures
from nodes.runtime.config import node_document

_TIMEOUT_S = 60.0


def check_nodes(plan: Plan) -> dict[str, str]:
    """Return the configuration errors by node; empty if every node accepts its configuration, and all are of one car.

    Each node's module is run with ``--check``, all in one process: it reads its configuration, prints errors and exits. Files that a
    node reads when it starts, such as a policy or an attack, are not opened.
    """
    if mixed := mixtures(plan):
        return mixed
    with tempfile.TemporaryDirectory(prefix="advnerf-check-") as folder:
        asked = []
        for name, entry in plan.nodes.items():
            config = Path(folder) / f"{name}.yaml"
            config.write_text(dump_yaml(node_document(plan.documents[name])), encoding="utf-8")
            asked.append([name, entry.module, str(config), folder])
        try:
            ended = subprocess.run(
                module_command("nodes.launching.check_together"),
                input=json.dumps(asked),
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return {
                "nodes": f"expected the check of the nodes to end within {_TIMEOUT_S:g} s, but it is still running"
            }
    if ended.returncode:
        lines = ended.stderr.strip().splitlines()
        return {
            "nodes": lines[-1] if lines else f"the check of the nodes ended with exit code {ended.returncode}"
        }
    if not ended.stdout:
        return {
            "nodes": "expected an answer of each node, got none: a module ends the process when it is loaded, as os._exit does; remove that"
        }
    return dict(parse_json(ended.stdout, "check of the nodes"))
