"""Installs the environment of a third-party world from its lock file: ``advnerf scene world install NAME``."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from advnerf_core.files import sha256_of, write_atomically
from hardware.worlds.environments import MADE, Environment
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.locks import HeldError, hold

_TOLD_LINES = 4
_VERSION = "import sys; print('%d.%d' % sys.version_info[:2])"


class InstallError(RuntimeFault):
    """An environment cannot be installed."""


def install(environment: Environment, say: Callable[[str], None], python: Path | None = None) -> bool:
    """Install the environment of a third-party world, unless it exists and matches its lock file.

    The last step writes the environment's marker, so that an interrupted installation is repeated.

    Args:
        say: Called with a message for each step.
        python: Interpreter to install with; None searches for one of a supported version.

    Returns:
        Whether it was installed; False if it existed.

    Raises:
        InstallError: No interpreter fits, a package cannot be installed, or another process installs it.
    """
    folder = environment.folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(folder.parent / f"{environment.name}.lock")
    except HeldError as held:
        raise InstallError(
            f"expected to install {environment.name} alone; process {held.owner} does: wait for it"
        ) from None
    with lock:
        if environment.state == "installed":
            return False
        interpreter = find_python(environment, python)
        shutil.rmtree(folder, ignore_errors=True)
        say(f"making {folder} with {interpreter}")
        _run([str(interpreter), "-I", "-m", "venv", str(folder)], "make an environment")
        say(
            f"installing the {_count(environment.lock)} packages of {environment.lock.name} (about {environment.size_mb} MB)"
        )
        pip = [
            str(environment.interpreter),
            "-I",
            "-m",
            "pip",
            "install",
            "--disable-pip-version-check",
            "--no-input",
        ]
        # No dependency resolution: these versions were tested together, and some of them declare otherwise.
        _run([*pip, "--no-deps", "-r", str(environment.lock)], "install its packages")
        write_atomically(folder / MADE, json.dumps({"lock_sha256": sha256_of(environment.lock)}) + "\n")
    return True


def find_python(environment: Environment, python: Path | None = None) -> Path:
    """An interpreter of a version that the environment supports.

    Raises:
        InstallError: None was found, or the given one has another version.
    """
    named = [python] if python is not None else [Path(sys.executable)]
    if python is None:
        named += [
            Path(found) for version in environment.pythons if (found := shutil.which(f"python{version}"))
        ]
    for each in named:
        if _version(each) in environment.pythons:
            return each
    versions = " or ".join(environment.pythons)
    got = f"{python} of version {_version(python) or 'unknown'}" if python is not None else "none on the path"
    raise InstallError(
        f"expected Python {versions} for the world {environment.name}; got {got}: install one, or name one with --python"
    )


def _version(python: Path) -> str:
    try:
        done = subprocess.run([str(python), "-I", "-c", _VERSION], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _run(command: Sequence[str], what: str) -> None:
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    )
    if done.returncode != 0:
        lines = [line for line in done.stdout.strip().splitlines() if not line.startswith("WARNING")]
        raise InstallError(
            f"expected to {what} with {Path(command[0]).name}; it failed: {' | '.join(lines[-_TOLD_LINES:])[:600]}; "
            "is the package index reachable, and are there some GB of free space?"
        )


def _count(lock: Path) -> int:
    lines = lock.read_text(encoding="utf-8").splitlines()
    return sum(bool(line.strip()) and not line.startswith("#") for line in lines)
