"""Kinds of cells by name: the project's own, those of entry points, and a user's class in a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from advnerf_core.plugins import PluginError, absolute_reference, code_sha256, resolve
from nodes.experiment.run.cell_kind import CellKind
from nodes.runtime.errors import ConfigError

ENTRY_POINTS = "advnerf.cells"


def _experiment() -> CellKind:
    from nodes.experiment.run.cells import ExperimentCells

    return ExperimentCells()


KINDS: Mapping[str, Callable[[], CellKind]] = {"experiment": _experiment}


def load_kind(name: str, folder: Path | None = None) -> CellKind:
    """The kind that a name stands for: ``experiment``, an entry point of ``advnerf.cells``, or ``file.py:Class``.

    Raises:
        ConfigError: There is none, or it is no `CellKind`.
    """
    try:
        found: Any = resolve(name, "kind of cells", KINDS, ENTRY_POINTS, folder)
    except PluginError as error:
        raise ConfigError(str(error)) from None
    made = found() if isinstance(found, type) else found
    if not isinstance(made, CellKind):
        raise ConfigError(
            f"expected a subclass of nodes.experiment.run.cell_kind.CellKind, got {name} = {found!r:.80}"
        )
    made.code = code_sha256(name, KINDS, ENTRY_POINTS, folder)
    return made


def absolute_kind(name: str, folder: Path) -> str:
    """The name as another process understands it."""
    return absolute_reference(name, folder)
