"""An installed wheel has everything, in an empty folder, for a user without a home who may not write where it is installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHIPPED = ("launch", "examples", "docs/results/reference")
PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")
STRANGER = 4242  # a user that no system has
POLICY = "docs/results/reference/policy_722ab9106e2fbad0/policy.safetensors"


def files_of(folder):
    return {
        file.relative_to(ROOT).as_posix(): file
        for file in folder.rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel of this checkout, which stays as it is."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        *(sys.executable, "setup.py", "-q", "egg_info", "--egg-base", folder),
        *("build", "--build-base", folder / "build"),
        *("bdist_wheel", "--bdist-dir", folder / "content", "--dist-dir", folder),
    ]
    done = subprocess.run(list(map(str, command)), cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def unpacked(wheel):
    folder = wheel.parent / "unpacked"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def test_every_file_of_the_packages_and_what_is_beside_them_rides_in_it(unpacked):
    expected = {name: file for package in PACKAGES for name, file in files_of(ROOT / package).items()}
    for folder in SHIPPED:
        found = files_of(ROOT / folder)
        assert len(found) >= 10, folder
        expected |= {f"nodes/shipped/{name}": file for name, file in found.items()}
    there = {file.relative_to(unpacked).as_posix() for file in unpacked.rglob("*") if file.is_file()}
    assert set(expected) - there == set()
    beside = {name for name in there - set(expected) if not name.startswith("advnerf-")}
    assert beside == set(), "neither tests nor leftovers"
    for name, file in expected.items():
        assert (unpacked / name).read_bytes() == file.read_bytes(), name


LOOK = """
import json
import advnerf_core, calibration, hardware, nodes
from nodes.experiment.engine.artefact import REFERENCE
from nodes.launching.launch_file import load_launch
from nodes.runtime.paths import named_file, shipped
launches = [file.name.split(".")[0] for file in shipped("launch").glob("*.launch.yaml")]
plan = load_launch(named_file("green_screen", "launch"))
print(json.dumps({
    "packages": [each.__file__ for each in (advnerf_core, calibration, hardware, nodes)],
    "launches": {name: str(named_file(name, "launch")) for name in launches},
    "room": str(named_file("room", "experiment")),
    "camera": plan.documents["camera"].data["calibration"],
    "reference": len(list(REFERENCE.shipped.iterdir())),
}))
"""


def test_names_are_found_in_it_from_an_empty_folder(unpacked, tmp_path):
    environment = {**os.environ, "PYTHONPATH": str(unpacked)}
    done = subprocess.run(
        [sys.executable, "-c", LOOK],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert all(Path(file).is_relative_to(unpacked) for file in found["packages"])
    names = {file.name.split(".")[0] for file in (ROOT / "launch").glob("*.launch.yaml")}
    launch = unpacked / "nodes" / "shipped" / "launch"
    assert found["launches"] == {name: str(launch / f"{name}.launch.yaml") for name in names}
    assert Path(found["room"]) == launch / "room.experiment.yaml"
    assert Path(found["camera"]) == unpacked / "calibration" / "twin" / "camera.yaml"
    assert found["reference"] == len(list((ROOT / "docs" / "results" / "reference").iterdir()))


def test_init_copies_what_can_be_edited_and_keeps_what_was(unpacked, tmp_path):
    def advnerf(*arguments):
        environment = {**os.environ, "PYTHONPATH": str(unpacked)}
        command = [sys.executable, "-m", "nodes.cli", *arguments]
        return subprocess.run(
            command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
        )

    (tmp_path / "car" / "launch").mkdir(parents=True)
    own = tmp_path / "car" / "launch" / "page.launch.yaml"
    own.write_text("name: mine\n")
    done = advnerf("experiment", "init", "car")
    assert done.returncode == 0, done.stderr
    expected = {
        name: file
        for folder in ("launch", "examples", "calibration/twin")
        for name, file in files_of(ROOT / folder).items()
    }
    assert f"{len(expected) - 1} files copied to car, 1 were there" in done.stdout
    assert own.read_text() == "name: mine\n"
    for name, file in expected.items():
        if tmp_path / "car" / name != own:
            assert (tmp_path / "car" / name).read_bytes() == file.read_bytes()
    done = advnerf("launch", "green_scren", "--check")
    assert done.returncode == 2
    (said,) = done.stderr.splitlines()
    assert "none at green_scren" in said
    assert "collect, green_screen, monitor" in said


class Installed:
    """The wheel in a virtual environment of its own, and an empty folder of a user without a home, who is not who installed it."""

    def __init__(self, wheel, folder):
        self.environment, self.folder = folder / "venv", folder / "empty"
        # setpriv itself may still execute anything, so that it executes env, which may not.
        self.as_stranger = ["setpriv", f"--reuid={STRANGER}", f"--regid={STRANGER}", "--clear-groups", "env"]
        if os.getuid() != 0:
            self.as_stranger = []
        python = self._python()
        command = [python, "-m", "venv", "--without-pip", str(self.environment)]
        subprocess.run(command, check=True, timeout=600)
        pip = [sys.executable, "-m", "pip", "--python", str(self.environment / "bin" / "python"), "install"]
        subprocess.run([*pip, "-q", "--no-index", "--no-deps", str(wheel)], check=True, timeout=600)
        (self.packages,) = self.environment.glob("lib/python*/site-packages")
        # A plain path: what is installed there for editing stays off.
        (self.packages / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
        self.folder.mkdir()
        if self.as_stranger:
            os.chown(self.folder, STRANGER, STRANGER)

    def _python(self):
        """An interpreter that the stranger may run; root's own may lie in root's home."""
        version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
        for each in (sys.executable, shutil.which(version, path="/usr/local/bin:/usr/bin")):
            if (
                each
                and not subprocess.run([*self.as_stranger, each, "-c", "import venv"], check=False).returncode
            ):
                return each
        pytest.skip(f"no {version} that user {STRANGER} may run")

    def __call__(self, *arguments, code=0):
        environment = {"PATH": f"{self.environment / 'bin'}:/usr/bin:/bin", "LANG": "C.UTF-8"}
        done = subprocess.run(
            [*self.as_stranger, "advnerf", *map(str, arguments)],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
            timeout=1700,
        )
        assert done.returncode == code, done.stdout + done.stderr
        assert "Traceback" not in done.stderr
        return done

    def listing(self):
        return {
            str(file): file.stat().st_mtime_ns
            for file in self.packages.rglob("*")
            if file.is_file() and file.suffix != ".pyc"
        }


@pytest.mark.slow
def test_the_commands_work_for_a_user_without_a_home_among_files_of_strange_names(wheel, open_folder):
    advnerf = Installed(wheel, open_folder)
    (advnerf.folder / "hardware.py").write_text("raise SystemExit('a stranger')\n")
    (advnerf.folder / "nodes").mkdir()
    (advnerf.folder / "nodes" / "__init__.py").write_text("raise SystemExit('a stranger')\n")
    before = advnerf.listing()
    assert "experiment" in advnerf("--help").stdout
    told = json.loads(advnerf("doctor", "--json").stdout)["findings"]
    states = {row["check"]: row["state"] for row in told}
    assert "failure" not in states.values()
    if os.getuid() == 0:
        assert (states["home"], states["cache"]) == ("warning", "warning")
    assert "files copied to x" in advnerf("experiment", "init", "x").stdout
    policy = advnerf.packages / "nodes" / "shipped" / POLICY
    plan = advnerf("launch", "green_screen", "--check", "--set", f"params.policy={policy}")
    assert "nodes.safety" in plan.stdout
    checked = advnerf("policy", "check", policy)
    assert "drives without attack" in checked.stdout
    assert str(STRANGER) in checked.stderr or os.getuid() != 0  # where the kernels are kept
    advnerf("experiment", "run", "room", "--setting", "demo", "--until", "object", "--set", "scene.steps=20")
    assert (advnerf.folder / "runs" / "demo" / "scene" / "scene.safetensors").is_file()
    assert advnerf.listing() == before


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_demo_ends_with_its_report_for_a_user_without_a_home(wheel, open_folder):
    advnerf = Installed(wheel, open_folder)
    (advnerf.folder / "hardware.py").write_text("raise SystemExit('a stranger')\n")
    shown = advnerf("demo").stdout
    assert "report: " in shown
    report = (advnerf.folder / "runs" / "demo" / "report" / "report.html").read_text()
    assert "gradient" in report
