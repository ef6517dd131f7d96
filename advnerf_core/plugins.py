"""Code that users name: what is built in, an entry point of an installed package, or ``file.py:Name`` of their own.

Worlds, attack methods and policies are found this way, in experiments, in the worker processes of many cells, and on clusters.
"""

from __future__ import annotations

import difflib
import hashlib
import importlib.util
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, TypeVar

from advnerf_core.errors import AdvnerfError

T = TypeVar("T")


class PluginError(AdvnerfError):
    """A name stands for nothing, or for code that cannot be loaded."""


def resolve(name: str, what: str, built_in: Mapping[str, Callable[[], T]], group: str, folder: Path | None = None) -> T:
    """The object that a name stands for.

    Args:
        name: A built-in name, an entry point's name, or ``file.py:Name``.
        what: What is being named, for messages: ``attack method``.
        built_in: Loaders of what this project brings; called only for the name that is asked for.
        group: Entry point group, such as ``advnerf.methods``.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: There is no such name, or what it names fails to load. Other plug-ins are not loaded, so they cannot fail.
    """
    if name in built_in:
        return built_in[name]()
    if is_file_reference(name):
        return load_from_file(name, what, folder)  # type: ignore[no-any-return]
    found = {each.name: each for each in entry_points(group=group)}
    if name in found:
        return _load_entry_point(found[name], what)  # type: ignore[no-any-return]
    raise PluginError(
        unknown(name, what, [*built_in, *sorted(found)])
        + f"; one of your own is file.py:Name, or an entry point of {group}"
    )


def known_names(built_in: Iterable[str], group: str) -> tuple[str, ...]:
    """Built-in names, then those of installed packages; nothing is loaded."""
    own = tuple(built_in)
    return (*own, *sorted({each.name for each in entry_points(group=group)} - set(own)))


def is_file_reference(name: str) -> bool:
    """Whether a name is ``file.py:Name``."""
    file, separator, attribute = name.rpartition(":")
    return bool(separator) and file.endswith(".py") and attribute.isidentifier()


def absolute_reference(name: str, folder: Path) -> str:
    """``file.py:Name`` with the file's absolute path, so that a worker finds it from any working folder; other names as they are."""
    if not is_file_reference(name):
        return name
    file, _, attribute = name.rpartition(":")
    return f"{(folder / Path(file).expanduser()).resolve()}:{attribute}"


def load_from_file(reference: str, what: str, folder: Path | None = None) -> Any:
    """The attribute that ``file.py:Name`` names.

    A file is loaded once per process and content, under a name of its own: two files of one name do not meet.

    Raises:
        PluginError: There is no such file or attribute, or the file raises an error.
    """
    file_text, _, attribute = absolute_reference(reference, folder or Path.cwd()).rpartition(":")
    file = Path(file_text)
    if not file.is_file():
        raise PluginError(f"{what} {reference}: expected a Python file at {file}, found none; correct the path")
    digest = hashlib.sha256(str(file).encode() + b"\0" + file.read_bytes()).hexdigest()[:16]
    module = sys.modules.get(name := f"advnerf_plugin_{file.stem}_{digest}")
    if module is None:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None, "a file with the ending .py has a specification"
        assert spec.loader is not None, "a file with the ending .py has a loader"
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up while it is being loaded
        try:
            spec.loader.exec_module(module)
        except Exception as error:
            del sys.modules[name]
            raise PluginError(f"{what} {reference}: {file} cannot be loaded: {_in_one_line(error)}") from error
    if not hasattr(module, attribute):
        public = [each for each in vars(module) if not each.startswith("_")]
        raise PluginError(f"{what} {reference}: " + unknown(attribute, f"name in {file.name}", public))
    return getattr(module, attribute)


def unknown(name: str, what: str, known: Iterable[str]) -> str:
    """Message about a name that is not known: the valid ones, and the nearest of them."""
    names = list(dict.fromkeys(known))
    near = difflib.get_close_matches(name, names, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"expected {_article(what)} {what} of {', '.join(names) or 'none'}; got {name!r}{hint}"


def _load_entry_point(entry: EntryPoint, what: str) -> Any:
    try:
        return entry.load()
    except Exception as error:
        package = entry.dist.name if entry.dist is not None else "an installed package"
        raise PluginError(
            f"{what} {entry.name}: {entry.value} of {package} cannot be loaded: {_in_one_line(error)}; update or remove that package"
        ) from error


def _in_one_line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _article(what: str) -> str:
    return "an" if what[:1].lower() in "aeiou" else "a"
