"""The adapter of docs/policies.md, run as its reader would run it."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from advnerf_core.policies.architecture import PilotNetConfiguration
from nodes.experiment.plan.sections import PolicyConfig

pytestmark = pytest.mark.live

REPOSITORY = Path(__file__).parents[1]
PAGE = (REPOSITORY / "docs" / "policies.md").read_text(encoding="utf-8")


def block(marker):
    """The code block of the page that contains a text."""
    (found,) = [code for code in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if marker in code]
    return found


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_policy.py").write_text(block("def factory"))
    (tmp_path / "calibration").symlink_to(REPOSITORY / "calibration")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    command = [sys.executable, "-m", "nodes.cli", *arguments]
    return subprocess.run(
        command,
        capture_output=True,
        text=True,
        env={
            "PYTHONPATH": str(REPOSITORY),
            "PATH": "/usr/bin:/bin",
            "OMP_NUM_THREADS": "1",
        },
        timeout=600,
    )


def test_the_adapter_is_as_short_as_promised_and_loads(folder):
    from advnerf_core.policies.load import load_any_policy

    code = [
        line
        for line in block("def factory").splitlines()
        if line.strip() and not line.lstrip().startswith("#")
    ]
    assert len(code) <= 20
    loaded = load_any_policy("my_policy:factory")
    assert loaded.policy.stateless
    assert (loaded.view.width, loaded.view.height) == (160, 80)


@pytest.mark.slow
def test_the_commands_of_the_page_check_export_and_describe_it(folder):
    pytest.importorskip("mujoco")
    pytest.importorskip("onnx")
    checked = run("policy", "check", "my_policy:factory")
    assert "on 48 frames of the simulated lab" in checked.stdout, checked.stderr
    rows = {line.split()[0]: line for line in checked.stdout.splitlines()[2:]}
    for name in ("mode", "input", "finite", "repeatable", "batch", "gradient", "range"):
        assert rows[name].split()[1] == "ok", checked.stdout
    # Its weights are random, so it steers like nobody: a warning, not the adapter's fault.
    assert "does not steer as the expert does" in rows["expert"]
    assert checked.returncode == 0
    exported = run("policy", "export", "my_policy:factory", "--onnx", "my_policy.onnx")
    assert exported.returncode == 0, exported.stderr
    told = run("policy", "info", "my_policy.onnx")
    assert "BGR" in told.stdout
    assert "differentiable  False" in " ".join(told.stdout.split()).replace(
        "differentiable False", "differentiable  False"
    )


def test_the_page_names_the_widths_of_pilotnet_here_and_in_experiments():
    here = PilotNetConfiguration().hidden
    there = PolicyConfig().hidden
    assert f"- `pilotnet`: `hidden` {here}; in experiments `policy.hidden` {there}" in PAGE
