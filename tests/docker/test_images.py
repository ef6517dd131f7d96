"""What the images install: a test can resolve the car's dependencies for arm64 and read the compose file; it cannot build an image."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

pytestmark = pytest.mark.live

REPOSITORY = Path(__file__).parents[2]
DOCKER = REPOSITORY / "docker"
# glibc 2.35 of JetPack 6 and 2.36 of python:3.11-slim take all of these; an older one would be a thin client only.
PLATFORMS = (
    "manylinux_2_28_aarch64",
    "manylinux_2_27_aarch64",
    "manylinux_2_17_aarch64",
    "manylinux2014_aarch64",
)
FOREIGN = ("torch", "scipy", "numba", "mujoco", "nvidia", "triton", "matplotlib")


def requirements(*extras):
    project = pytest.importorskip("tomllib").loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    return project["dependencies"] + [r for extra in extras for r in project["optional-dependencies"][extra]]


def resolve(tmp_path, wanted, python, constraints):
    (tmp_path / "wanted.txt").write_text("\n".join(wanted))
    report = tmp_path / "report.json"
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--dry-run",
        "--ignore-installed",
        "--quiet",
        "--report",
        str(report),
    ]
    command += ["--target", str(tmp_path / "target"), "--only-binary=:all:", "--python-version", python]
    command += [part for platform in PLATFORMS for part in ("--platform", platform)]
    command += ["-c", str(REPOSITORY / "constraints.txt")] if constraints else []
    done = subprocess.run(
        [*command, "-r", str(tmp_path / "wanted.txt")], capture_output=True, text=True, timeout=600
    )
    if "Temporary failure in name resolution" in done.stderr or "Connection refused" in done.stderr:
        pytest.skip("no package index")
    assert done.returncode == 0, done.stderr[-2000:]
    return [Path(item["download_info"]["url"]).name for item in json.loads(report.read_text())["install"]]


@pytest.mark.slow
@pytest.mark.parametrize("extras", [(), ("onnx",), ("oak",)])
def test_the_car_installs_on_arm64(tmp_path, extras):
    # pip reads the markers of the constraints with its own Python, so they are used for that one only.
    own = f"{sys.version_info.major}.{sys.version_info.minor}"
    for python in {own, "3.10"}:
        wheels = resolve(tmp_path, requirements(*extras), python, constraints=python == own)
        assert all(name.endswith(("aarch64.whl", "any.whl")) for name in wheels)
        assert not [name for name in wheels if name.lower().startswith(FOREIGN)]
        assert [name for name in wheels if name.startswith("opencv_contrib_python_headless-4.")]


@pytest.mark.parametrize("name", ["robot", "twin", "workstation"])
def test_images_install_what_the_project_offers(name):
    text = (DOCKER / f"Dockerfile.{name}").read_text()
    known = pytest.importorskip("tomllib").loads((REPOSITORY / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    for line in text.splitlines():
        if line.startswith("ARG EXTRAS="):
            assert set(line.partition("=")[2].strip("[]").split(",")) <= {*known, ""}
    assert "constraints.txt" in text or "make setup" in text
    assert (DOCKER / f"Dockerfile.{name}.dockerignore").exists()


def test_compose_names_files_and_settings_that_exist():
    from nodes.launching.launch_file import load_launch

    services = yaml.safe_load((DOCKER / "compose.yaml").read_text())["services"]
    for service in services.values():
        assert (DOCKER / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
    command = services["green_screen"]["command"]
    settings = [command[i + 1] for i, part in enumerate(command) if part == "--set"]
    settings = [
        s.replace("${POLICY:-", "").replace("${ATTACK:-", "").rstrip("}") if "${" in s else s
        for s in settings
    ]
    assert load_launch(REPOSITORY / command[2], settings).nodes["motor"].module == "nodes.motor"
