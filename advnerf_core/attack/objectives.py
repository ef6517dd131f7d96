"""The objectives of attacks: one table of the built-in ones, and those that users bring as an entry point or a file.

An objective is a class that derives from `advnerf_core.attack.objective.Objective` and is constructed without arguments. A user's is an entry
point of the group ``advnerf.objectives`` or ``file.py:Class``, see docs/methods.md. Names are known without torch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from advnerf_core.plugins import (
    PluginError,
    code_sha256,
    name_in_results,
    require_known,
    resolve,
)

if TYPE_CHECKING:
    from advnerf_core.attack.objective import Objective

GROUP, CTE = "advnerf.objectives", "cte"
_WHAT, _MODULE = "objective", "advnerf_core.attack.objective"

# Names of classes in `objective.py`, in the order of tables.
OBJECTIVES: Mapping[str, str] = MappingProxyType(
    {
        CTE: "CrossTrackError",
        "run_wide": "RunWide",
        "drift_left": "DriftLeft",
        "drift_right": "DriftRight",
        "peak": "Peak",
        "time_off_track": "TimeOffTrack",
        "collision": "Collision",
    }
)
# These depend on states and the path alone, not on obstacles.
ON_THE_PATH = (CTE, "run_wide", "drift_left", "drift_right", "peak", "time_off_track")


def load_objective(reference: str, folder: Path | None = None) -> Objective:
    """The objective that a reference names.

    Args:
        reference: A built-in name, an entry point's name, or ``file.py:Class``.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: The objective is unknown, its code cannot be loaded, or it is not an `Objective`.
    """
    base: type[Objective] = import_module(_MODULE).Objective
    require_objective(reference, folder)
    found: Any = resolve(reference, _WHAT, {name: _row(name) for name in OBJECTIVES}, GROUP, folder)
    if not (isinstance(found, type) and issubclass(found, base)):
        got = f"the class {found.__name__}" if isinstance(found, type) else f"a {type(found).__name__}"
        raise PluginError(
            f"{_WHAT} {reference}: expected a class that derives from Objective ({_MODULE}), got {got}; see docs/methods.md"
        )
    if found.value is base.value:
        raise PluginError(f"{_WHAT} {reference}: expected a class with a method value, got none; define it")
    if not isinstance(found.unit, str):
        raise PluginError(f"{_WHAT} {reference}: expected a unit such as 'm' or 's', got {found.unit!r}")
    try:
        return found()
    except TypeError as error:
        raise PluginError(
            f"{_WHAT} {reference}: expected a class that is made without arguments, got {error}; give its arguments defaults"
        ) from error


def require_objective(reference: str, folder: Path | None = None) -> None:
    """Raise unless a reference names an objective; nothing is loaded.

    Raises:
        PluginError: The objective is unknown, or it has the name of a built-in one.
    """
    require_known(reference, _WHAT, OBJECTIVES, GROUP, folder)
    name = name_in_results(reference)
    if name in OBJECTIVES and reference != name:
        raise PluginError(
            f"{_WHAT} {reference}: expected a name that no built-in objective has, got {name}; rename it"
        )


def objective_key(reference: str) -> str | list[str]:
    """Key of a result: the name of a built-in objective; name and digest of a user's, independent of its file's folder."""
    code = code_sha256(reference, OBJECTIVES, GROUP)[:16]
    return [name_in_results(reference), code] if code else reference


def objective_entry(reference: str, objective: Objective, value: float, clean_value: float) -> dict[str, Any]:
    """Entry of the objective in an attack file: name, unit, value, and the value without an attack. Empty for ``cte``, whose values are total CTE."""
    if reference == CTE:
        return {}
    values = {"value": value, "clean_value": clean_value}
    return {"objective": {"name": name_in_results(reference), "unit": objective.unit, **values}}


def _row(name: str) -> Callable[[], Any]:
    return lambda: getattr(import_module(_MODULE), OBJECTIVES[name])
