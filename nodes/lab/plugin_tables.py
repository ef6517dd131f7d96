"""Named plug-ins: one row of `TABLES` for each kind, and the code that a file's names execute."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import MappingProxyType
from typing import Any

from advnerf_core.code_files import entry_point_sha256, file_sha256, module_sha256
from advnerf_core.plugins import absolute_reference, entries_named, is_file_reference, origin_of
from advnerf_core.policies.load import is_factory
from advnerf_core.run_module import search_working_folder_last

BUILT_IN = "built in"
_OURS = ("advnerf_core", "calibration", "hardware", "nodes")
_DIGITS = 12


@dataclass(frozen=True)
class PluginTable:
    """One kind of named plug-in.

    Attributes:
        built_in: Lines about the built-in ones, by name.
        group: Entry point group of installed packages; empty if there is no group.
        keys: Keys of files whose value is such a name.
    """

    built_in: Callable[[], Mapping[str, str]]
    group: str = ""
    keys: tuple[str, ...] = ()


@dataclass(frozen=True)
class PluginRow:
    """One named plug-in.

    Attributes:
        origin: ``built in``, or package and version.
    """

    name: str
    line: str
    origin: str


def _methods() -> Mapping[str, str]:
    from advnerf_core.attack.methods import METHODS
    from advnerf_core.report.conditions import style_of

    return {name: style_of(name).title for name in METHODS}


def _worlds() -> Mapping[str, str]:
    from hardware.worlds.environments import ENVIRONMENTS
    from nodes.lab.worlds.named import WORLDS

    lines = {name: one_line(load()) for name, load in WORLDS.items()}
    for name, environment in ENVIRONMENTS.items():
        if environment.state != "installed":  # also one of another lock file, which is not used
            lines[name] += " (not installed)"
    return lines


def _cameras() -> Mapping[str, str]:
    from hardware.cameras.sources import CAMERAS

    return {name: one_line(source) for name, source in CAMERAS.items()}


def _objectives() -> Mapping[str, str]:
    from advnerf_core.attack.objectives import OBJECTIVES, load_objective

    return {name: one_line(load_objective(name)) for name in OBJECTIVES}


def _architectures() -> Mapping[str, str]:
    from advnerf_core.policies.architecture import ARCHITECTURES

    return {name: row.title for name, row in ARCHITECTURES.items()}


def _policies() -> Mapping[str, str]:
    return {
        "FILE.safetensors": "A network as `advnerf policy train` writes it.",
        "FILE.onnx": "A network of any framework; it has no gradient.",
        "FILE.pt2": "A torch.export program, with its gradient.",
        "package.module:factory": "A function of an importable module that returns an adapted policy.",
    }


TABLES: Mapping[str, PluginTable] = MappingProxyType(
    {
        "methods": PluginTable(_methods, "advnerf.methods", ("method",)),
        "policies": PluginTable(_policies),
        "architectures": PluginTable(_architectures, "advnerf.architectures", ("architecture", "student")),
        "objectives": PluginTable(_objectives, "advnerf.objectives", ("objective",)),
        "worlds": PluginTable(_worlds, "advnerf.worlds", ("kind",)),
        "cameras": PluginTable(_cameras, "advnerf.cameras", ("kind",)),
    }
)
"""One row makes a list of `advnerf experiment list`, and has its entry points named before they are executed."""


def rows_of(table: PluginTable) -> list[PluginRow]:
    """The rows of a table: built-in ones, then those of installed packages, which are loaded for their title."""
    own = [PluginRow(name, line, BUILT_IN) for name, line in table.built_in().items()]
    found = sorted(entry_points(group=table.group), key=lambda each: each.name) if table.group else []
    return [*own, *(PluginRow(entry.name, _line_of_entry(entry), origin_of(entry)) for entry in found)]


def names_twice(rows: list[PluginRow]) -> list[str]:
    """A sentence for each name that occurs twice; neither plug-in can be used."""
    origins: dict[str, list[str]] = {}
    for row in rows:
        origins.setdefault(row.name, []).append(row.origin)
    return [
        f"expected one thing of the name {name}, got {len(found)} ({', '.join(found)}); remove one of these packages, or ask its"
        " author for another name"
        for name, found in origins.items()
        if len(found) > 1
    ]


def one_line(thing: Any) -> str:
    """Title of a class or object, or the first sentence of its documentation; empty if it has neither."""
    title = getattr(thing, "title", "")
    if isinstance(title, str) and title:
        return title
    of_method = getattr(thing, "search", None)
    text = inspect.getdoc(of_method if of_method is not None and not inspect.isclass(thing) else thing) or ""
    sentence = " ".join(text.partition("\n\n")[0].split()).partition(". ")[0]
    return sentence if not sentence or sentence.endswith(".") else f"{sentence}."


def _line_of_entry(entry: Any) -> str:
    try:
        return one_line(entry.load())
    except Exception as error:  # one broken package must not hide the others
        return f"cannot be loaded: {type(error).__name__}: {' '.join(str(error).split()):.120}"


def named_code(data: Any, folder: Path) -> list[str]:
    """Users' code that a file names, each with the start of its SHA-256. Nothing is loaded.

    Args:
        data: Plain data of an experiment, a request, a launch file or one of their sections.
        folder: Folder that a relative ``file.py`` is relative to.
    """
    lines = [line for key, text in _texts(data, "") if (line := _line_of_code(key, text, folder))]
    return list(dict.fromkeys(lines))


def say_code(data: Any, folder: Path) -> None:
    """Print the code that a file is about to execute, see `named_code`."""
    for line in named_code(data, folder):
        print(f"executes {line}", file=sys.stderr, flush=True)


def _texts(data: Any, key: str) -> Iterator[tuple[str, str]]:
    """All texts in plain data, each with the last key above it."""
    if isinstance(data, Mapping):
        for name, value in data.items():
            yield from _texts(value, str(name))
    elif isinstance(data, list | tuple):
        for value in data:
            yield from _texts(value, key)
    elif isinstance(data, str | Path):
        yield key, str(data)


def _line_of_code(key: str, text: str, folder: Path) -> str:
    if is_file_reference(text):
        named = absolute_reference(text, folder)
        file = Path(named.rpartition(":")[0])
        return f"{named} (sha256 {file_sha256(file)[:_DIGITS]})" if file.is_file() else ""
    module = text.partition(":")[0]
    is_module = (key == "policy" and is_factory(text)) or (
        key == "module" and text.replace(".", "_").isidentifier()
    )
    if is_module and module.partition(".")[0] not in _OURS:
        search_working_folder_last()  # as loading it does
        try:
            return f"{text} (sha256 {module_sha256(module)[:_DIGITS]})"
        except ImportError:
            return ""  # loading it reports the error
    for table in TABLES.values():
        if key in table.keys:
            for entry in entries_named(text, table.group):
                return f"{text} of {origin_of(entry)} (sha256 {entry_point_sha256(entry)[:_DIGITS]})"
    return ""
