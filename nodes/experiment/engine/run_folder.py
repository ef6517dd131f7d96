"""A resolved experiment of any kind in its run folder: its manifest, and its stages run to the end."""

from __future__ import annotations

import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import Console

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from nodes.experiment.engine.artefact import Artefact, ReferenceBuild
from nodes.experiment.engine.stages import Stage, check_until, run_stages
from nodes.lab.located import READ_AGAIN
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay, StageDisplay

Config = TypeVar("Config")
# Folder of the cells in a run folder.
CELLS = "cells"
_MANIFEST = "manifest.json"


@dataclass(frozen=True)
class RunFolder(Generic[Config]):
    """One resolved experiment.

    Attributes:
        config: The resolved configuration.
        file: The experiment file.
        setting: Name of the setting, e.g. ``demo``.
    """

    config: Config
    file: Path
    folder: Path
    setting: str

    def stage_folder(self, stage: str) -> Path:
        """Folder of a stage."""
        return self.folder / stage


def run_to_end(
    experiment: RunFolder[Any],
    stages: Sequence[Stage],
    libraries: Sequence[str],
    until: str | None = None,
    console: Console | None = None,
    reference: ReferenceBuild | None = None,
    watcher: StageDisplay | None = None,
) -> dict[str, Artefact]:
    """Run the stages that are not finished yet.

    Args:
        experiment: The experiment.
        stages: The stages in order.
        libraries: Libraries whose versions the manifest names, if installed.
        until: Last stage to run; None for all.
        console: Console to print to.
        reference: Reference build that may have results of stages.
        watcher: Also receives the progress.

    Raises:
        ConfigError: The folder has the stages of another experiment, which would be replaced.
    """
    console = console or Console()
    check_until(stages, until)
    require_own_folder(experiment)
    experiment.folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(experiment, libraries)
    with ProgressDisplay(console, watcher) as display:
        return run_stages(stages, experiment.folder, display, until, reference)


def require_own_folder(experiment: RunFolder[Any]) -> None:
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


def _write_manifest(experiment: RunFolder[Any], libraries: Sequence[str]) -> None:
    manifest = {
        "experiment": experiment.config.name,
        "setting": experiment.setting,
        "file": str(experiment.file),
        "command": " ".join(["advnerf", *sys.argv[1:]]),
        "config": experiment.config.model_dump(mode="json", context=READ_AGAIN),
        "versions": {"advnerf": version("advnerf"), "python": platform.python_version()}
        | {name: found for name in libraries if (found := _installed(name))},
    }
    write_json(experiment.folder / _MANIFEST, manifest)
