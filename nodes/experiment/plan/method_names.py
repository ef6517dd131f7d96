"""Names of methods, objectives and architectures in experiment and request files: checked in place, and made absolute for other processes.

The title of a user's method is stored beside the cells that it searched, so that pages show it without executing the method.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, ValidationInfo

from advnerf_core.attack.methods import require_method
from advnerf_core.attack.objectives import require_objective
from advnerf_core.files import write_atomically
from advnerf_core.plugins import PluginError, absolute_reference
from advnerf_core.policies.architecture import require_architecture
from advnerf_core.report.conditions import CONTROLS, know_methods
from nodes.lab.located import refusal


def _checked(require: Callable[[str, Path], None]) -> Callable[[str, ValidationInfo], str]:
    def checked(name: str, info: ValidationInfo) -> str:
        folder = (info.context or {}).get("folder") or Path.cwd()
        try:
            require(name, folder)
        except PluginError as error:
            raise refusal(str(error)) from None
        return absolute_reference(name, folder)

    return checked


def _checked_condition(name: str, info: ValidationInfo) -> str:
    return name if name in CONTROLS else _checked(require_method)(name, info)


ArchitectureReference = Annotated[str, AfterValidator(_checked(require_architecture))]
"""An architecture as `advnerf_core.policies.architecture.load_architecture` takes it; ``file.py:Class`` becomes absolute. Nothing is loaded."""

ConditionReference = Annotated[str, AfterValidator(_checked_condition)]
"""A method as `advnerf_core.attack.methods.load_method` takes it, or a control: ``none``, ``empty``."""

ObjectiveReference = Annotated[str, AfterValidator(_checked(require_objective))]
"""An objective as `advnerf_core.attack.objectives.load_objective` takes it; ``file.py:Class`` becomes absolute. Nothing is loaded."""

_TITLES = "titles"


def keep_title(cells_folder: Path, name: str, title: str) -> None:
    """Store a method's title for readers; nothing without a title."""
    if title:
        write_atomically(cells_folder / _TITLES / name, title)


def know_methods_of(cells_folder: Path, names: Iterable[str]) -> None:
    """Give the methods of one table distinct colours, and the titles stored beside its cells."""
    kept = sorted((cells_folder / _TITLES).glob("*"))
    know_methods(names, {file.name: file.read_text(encoding="utf-8") for file in kept})
