"""A resolved experiment in its run folder, and the manifest there."""

from __future__ import annotations

import platform
import sys
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from nodes.experiment.plan.config import ExperimentConfig
from nodes.lab.located import READ_AGAIN
from nodes.runtime.errors import ConfigError

# Folder of the cells in a run folder.
CELLS = "cells"
_MANIFEST = "manifest.json"
# Libraries whose versions the manifest notes.
_LIBRARIES = (
    "torch",
    "numpy",
    "numba",
    "opencv-contrib-python-headless",
    "mujoco",
    "pyzmq",
    "rosbags",
    "mcap",
)


@dataclass(frozen=True)
class RunFolder:
    """One resolved experiment.

    Attributes:
        setting: Name of the setting, e.g. ``demo``; empty for a file without settings.
    """

    config: ExperimentConfig
    file: Path
    folder: Path
    setting: str

    def stage_folder(self, stage: str) -> Path:
        """Folder of a stage."""
        return self.folder / stage


def require_own_folder(experiment: RunFolder) -> None:
    """Raise for a run folder of another experiment: stages with the same names and other keys would empty each other's folders.

    Raises:
        ConfigError: The folder belongs to another experiment.
    """
    manifest = experiment.folder / _MANIFEST
    try:
        there = read_json(manifest)["experiment"]
    except (OSError, ValueError, KeyError, TypeError):
        return
    if there != experiment.config.name:
        raise ConfigError(
            f"expected a run folder of experiment {experiment.config.name!r} or a new one, got {experiment.folder} of {there!r}; name another one "
            f"with --folder (for a variant: run_folder), or remove {manifest} to have its stages replaced where they differ"
        )


def _installed(library: str) -> str:
    """Version of a library; empty if it is not installed, such as MuJoCo for a world that does not need it."""
    try:
        return version(library)
    except PackageNotFoundError:
        return ""


def write_manifest(experiment: RunFolder) -> None:
    """Write the resolved experiment, the command, and the versions of the software into its run folder."""
    manifest = {
        "experiment": experiment.config.name,
        "setting": experiment.setting,
        "file": str(experiment.file),
        "command": " ".join(["advnerf", *sys.argv[1:]]),
        "config": experiment.config.model_dump(mode="json", context=READ_AGAIN),
        "versions": {"advnerf": version("advnerf"), "python": platform.python_version()}
        | {name: found for name in _LIBRARIES if (found := _installed(name))},
    }
    write_json(experiment.folder / _MANIFEST, manifest)
