"""Environments of foreign worlds: made from a lock file, refused when they do not fit it, and listed."""

import json
import subprocess
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from advnerf_core.documents import Document
from advnerf_core.files import sha256_of
from hardware.worlds import WORLDS
from hardware.worlds.environments import ENVIRONMENTS, FOLDER_VARIABLE, MADE, Environment
from hardware.worlds.remote_errors import ServerLost, SimulatorError, WorldNotInstalled
from nodes.cli.main import app
from nodes.lab.plugin_tables import TABLES, rows_of
from nodes.lab.worlds.install import InstallError, find_python, install
from nodes.lab.worlds.named import read_world

HERE = f"{sys.version_info[0]}.{sys.version_info[1]}"


@dataclass(frozen=True)
class Small(Environment):
    """An environment with a lock file of the test's own."""

    lock_file: Path = Path()

    @property
    def lock(self) -> Path:
        return self.lock_file


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Small:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path / "worlds"))
    wheel = tmp_path / "told-1.0-py3-none-any.whl"
    _write_wheel(wheel)
    lock = tmp_path / "small.lock.txt"
    lock.write_text(f"# one package\ntold @ file://{wheel}\n")
    return Small("small", "A small world", "Free.", (HERE,), 1, lock_file=lock)


def _write_wheel(file: Path) -> None:
    with zipfile.ZipFile(file, "w") as wheel:
        wheel.writestr("told.py", "TEXT = 'of its own'\n")
        wheel.writestr("told-1.0.dist-info/METADATA", "Metadata-Version: 2.1\nName: told\nVersion: 1.0\n")
        wheel.writestr(
            "told-1.0.dist-info/WHEEL",
            "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        )
        wheel.writestr("told-1.0.dist-info/RECORD", "told.py,,\ntold-1.0.dist-info/METADATA,,\n")


def test_an_environment_is_made_once_and_has_what_its_lock_file_says(small: Small) -> None:
    said: list[str] = []
    with pytest.raises(WorldNotInstalled, match="advnerf scene world install small"):
        small.python()
    assert install(small, said.append)
    assert "the 1 packages of small.lock.txt" in said[1]
    assert not install(small, said.append)
    asked = "import told, sys; print(told.TEXT, sys.prefix)"
    told = subprocess.run([small.python(), "-I", "-c", asked], capture_output=True, text=True, check=True)
    assert told.stdout.split() == ["of", "its", "own", str(small.folder)]
    small.lock.write_text(small.lock.read_text() + "# changed\n")
    with pytest.raises(WorldNotInstalled, match="installed from another lock file"):
        small.python()


def test_an_environment_that_was_interrupted_does_not_count(small: Small, tmp_path: Path) -> None:
    # Its environments have no pip, which takes most of the time of making one.
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} "$@" --without-pip\n')
    python.chmod(0o755)
    with pytest.raises(InstallError, match=r"install its packages.* No module named pip"):
        install(small, lambda text: None, python)
    assert small.interpreter.exists()
    assert small.state == "not installed"


def test_a_python_of_another_version_is_refused(small: Small, tmp_path: Path) -> None:
    old = Environment("old", "Old", "Free.", ("2.7",), 1)
    with pytest.raises(InstallError, match=r"expected Python 2\.7 .*--python"):
        find_python(old)
    with pytest.raises(InstallError, match=f"of version {HERE}"):
        find_python(old, Path(sys.executable))
    with pytest.raises(InstallError, match="of version unknown"):
        find_python(small, tmp_path / "nowhere")


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_foreign_world_has_its_simulator_and_a_lock_of_pinned_versions(name: str) -> None:
    environment = ENVIRONMENTS[name]
    assert name in WORLDS
    assert environment.simulator.is_file()
    lines = [line for line in environment.lock.read_text().splitlines() if line and not line.startswith("#")]
    assert all(line.count("==") == 1 for line in lines)
    assert {"pyzmq", "numpy"} <= {line.split("==")[0].lower() for line in lines}


def test_the_list_says_what_is_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    environment = ENVIRONMENTS["metadrive"]

    def line() -> str:
        return next(row.line for row in rows_of(TABLES["worlds"]) if row.name == "metadrive")

    assert line().endswith(" (not installed)")
    environment.interpreter.parent.mkdir(parents=True)
    environment.interpreter.touch()
    (environment.folder / MADE).write_text(json.dumps({"lock_sha256": sha256_of(environment.lock)}))
    assert "installed" not in line()


@pytest.mark.parametrize("dies", ["os._exit(7)", "raise RuntimeError('no driver')"])
def test_a_simulator_that_does_not_open_is_told_with_the_packages_that_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, dies: str
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    environment = ENVIRONMENTS["filament"]
    environment.interpreter.parent.mkdir(parents=True)
    environment.interpreter.write_text(f'#!/bin/sh\nexec "{sys.executable}" "$@"\n')
    environment.interpreter.chmod(0o755)
    (environment.folder / MADE).write_text(json.dumps({"lock_sha256": sha256_of(environment.lock)}))
    broken = tmp_path / "broken.py"
    broken.write_text(f"import os\ndef open_simulator(config, cameras, **files):\n    {dies}\n")
    monkeypatch.setattr(Environment, "simulator", broken)
    world = read_world(Document({"kind": "filament"}, "test"), Path.cwd()).make()
    with (
        pytest.raises(
            (ServerLost, SimulatorError), match="libvulkan1 mesa-vulkan-drivers; install them"
        ) as told,
        world,
    ):
        raise AssertionError("it was opened")
    assert "run it again" not in str(told.value)


def test_nothing_is_installed_before_its_licence_is_accepted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    refused = CliRunner().invoke(app, ["scene", "world", "install", "metadrive"], input="n\n")
    assert refused.exit_code == 1
    assert "Apache License" in refused.output
    assert list(tmp_path.iterdir()) == []
    unknown = CliRunner().invoke(app, ["scene", "world", "install", "metadrivee"])
    assert "did you mean metadrive?" in str(unknown.exception)


def test_a_world_that_is_not_installed_says_how(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(FOLDER_VARIABLE, str(tmp_path))
    checked = CliRunner().invoke(app, ["scene", "world", "check", "metadrive"])
    assert "advnerf scene world install metadrive" in str(checked.exception)
