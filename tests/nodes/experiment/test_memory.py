"""The memory of a gradient, as the report of an experiment measures it."""

import json
import subprocess
import sys


def test_it_is_that_of_one_start_however_many_are_attacked(tiny_room, tmp_path):
    """In a process of its own, as the report has it."""
    manifest = json.loads((tiny_room[0] / "manifest.json").read_text())
    manifest["config"]["attack"]["starts"] = 3
    for stage in ("capture", "scene", "bake", "policy", "object"):
        (tmp_path / stage).symlink_to(tiny_room[0] / stage)
    (tmp_path / "manifest.json").write_text(json.dumps(manifest))
    command = [sys.executable, "-m", "nodes.experiment.steps.memory", str(tmp_path), "2"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ticks, mib = done.stdout.split()
    assert int(ticks) == 2
    assert 0.0 <= float(mib) < 200.0
