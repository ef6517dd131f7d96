"""Finds code by name: a built-in, an entry point of an installed package, or a user's ``file.py:Name``.

Worlds, attack methods and policies are found this way, in experiments, in the worker processes of many cells, and on clusters.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import importlib.util
import os
import sys
from collections.abc import Callable, Collection, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from advnerf_core.code_files import entry_point_sha256, file_sha256, line_of_a_user, modules_beside
from advnerf_core.errors import AdvnerfError
from advnerf_core.places import expanded
from advnerf_core.strict import strict_validator, what_is_wrong

T = TypeVar("T")
# What a user's code raises when it fails; a call of sys.exit would end the command as if all were well.
FAILURES = (Exception, SystemExit)
EXITED = "expected a policy, method or other code of yours to return, it has called sys.exit"


class PluginError(AdvnerfError):
    """A name is unknown, or its code cannot be loaded."""


def resolve(
    name: str, what: str, built_in: Mapping[str, Callable[[], T]], group: str, folder: Path | None = None
) -> T:
    """The object that a name stands for.

    Args:
        name: A built-in name, an entry point's name, or ``file.py:Name``.
        what: Kind of the object, for messages: ``attack method``.
        built_in: Loaders of the built-in objects; only the requested one is called.
        group: Entry point group, such as ``advnerf.methods``.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: The name is unknown or ambiguous, or its code fails to load. Other plug-ins are not loaded, so
            they cannot fail.
    """
    require_known(name, what, built_in, group, folder)
    if name in built_in:
        return built_in[name]()
    if is_file_reference(name):
        return load_from_file(name, what, folder)
    (entry,) = entries_named(name, group)
    return _load_entry_point(entry, what)


def require_known(
    name: str, what: str, built_in: Collection[str], group: str, folder: Path | None = None
) -> None:
    """Raise for an unknown or ambiguous name. No code is loaded, so it may still be broken.

    Args:
        name: See `resolve`, also for the other arguments.
        what: Kind of the object, for messages.
        built_in: Names of the built-in objects.
        group: Entry point group.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: The name is unknown or ambiguous, or its file does not exist.
    """
    if is_file_reference(name):
        _file_of(name, what, folder)
        return
    owners = [*(["advnerf"] if name in built_in else []), *map(origin_of, entries_named(name, group))]
    if len(owners) > 1:
        raise PluginError(
            f"{what} {name}: expected one {what} of this name, got {len(owners)}: of {' and of '.join(owners)}; remove one of these "
            "packages, or ask its author for another name"
        )
    if not owners:
        raise PluginError(_stands_for_nothing(name, what, built_in, group))


def code_sha256(name: str, built_in: Container[str], group: str, folder: Path | None = None) -> str:
    """Hash of the code behind a user's name: it changes with the code's files (`advnerf_core.code_files`).

    Args:
        name: See `resolve`, also for the other arguments.
        built_in: Names of the built-in objects.
        group: Entry point group.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Returns:
        SHA-256, the same on every machine; empty for a built-in or unknown name.
    """
    if name in built_in:
        return ""
    if is_file_reference(name):
        return file_sha256(Path(absolute_reference(name, folder or Path.cwd()).rpartition(":")[0]))
    entry = next(iter(entries_named(name, group)), None)
    return "" if entry is None else entry_point_sha256(entry)


def known_names(built_in: Iterable[str], group: str) -> tuple[str, ...]:
    """Built-in names, then names from installed packages, each once; nothing is loaded."""
    own = tuple(built_in)
    return (*own, *sorted({each.name for each in _installed(group)} - set(own)))


def entries_named(name: str, group: str) -> list[EntryPoint]:
    """Entry points of a group with a name; nothing is loaded."""
    return [each for each in _installed(group) if each.name == name]


def _installed(group: str) -> tuple[EntryPoint, ...]:
    """Entry points of a group. Reading all packages takes 17 ms, which a file of many variants would spend for each variant."""
    return _read_entries(group, tuple((folder, _changed_ns(folder)) for folder in sys.path))


@lru_cache(maxsize=16)
def _read_entries(group: str, searched: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    """Read again when a package is added to a folder of the search path, or removed."""
    return tuple(entry_points(group=group))


def _changed_ns(folder: str) -> int:
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0


def origin_of(entry: EntryPoint) -> str:
    """The package of an entry point, with its version: ``package 1.0``."""
    return (
        f"{entry.dist.name} {entry.dist.version}"
        if entry.dist is not None
        else f"a package with {entry.value}"
    )


def is_file_reference(name: str) -> bool:
    """Whether a name is ``file.py:Name``."""
    file, separator, attribute = name.rpartition(":")
    return bool(separator) and file.endswith(".py") and attribute.isidentifier()


def name_in_results(reference: str) -> str:
    """Name in tables and file names: ``Name`` for ``file.py:Name``; other names are unchanged."""
    return reference.rpartition(":")[2] if is_file_reference(reference) else reference


def absolute_reference(name: str, folder: Path) -> str:
    """``file.py:Name`` with the file's absolute path, so that a worker finds it from any working folder; other names are unchanged."""
    if not is_file_reference(name):
        return name
    file, _, attribute = name.rpartition(":")
    return f"{(folder / expanded(file)).resolve()}:{attribute}"


def load_from_file(reference: str, what: str, folder: Path | None = None) -> Any:
    """The attribute that ``file.py:Name`` names.

    A file is loaded once per process and content, under a unique name, so that two files of one name do not clash. While it is loaded, it
    may import the modules beside it.

    Raises:
        PluginError: The file or attribute does not exist, or the file raises an error.
    """
    file, attribute = _file_of(reference, what, folder)
    digest = hashlib.sha256(f"{file}\0{file_sha256(file)}".encode()).hexdigest()[:16]
    module = sys.modules.get(name := f"advnerf_plugin_{file.stem}_{digest}")
    if module is None:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None, "a file with the ending .py has a loader"
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module  # dataclasses look their module up while it is being loaded
        try:
            # Not by the loader: its byte code cache compares times to the second, and a file may be saved twice in one.
            with _imports_from(file.parent, modules_beside(file)), torch_left_as_it_is():
                exec(compile(file.read_bytes(), file, "exec"), module.__dict__)
        except FAILURES as error:
            del sys.modules[name]
            raise PluginError(f"{what} {reference}: {file} cannot be loaded: {in_one_line(error)}") from error
    if not hasattr(module, attribute):
        public = [each for each in vars(module) if not each.startswith("_")]
        raise PluginError(f"{what} {reference}: " + unknown(attribute, f"name in {file.name}", public))
    return getattr(module, attribute)


class _Beside(MetaPathFinder):
    """Finds given modules in a folder, and no others: the folder may contain an unrelated `hardware.py`."""

    def __init__(self, folder: Path, names: Container[str]) -> None:
        self._folder, self._names = folder, names

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """The module's spec, if it is one of these."""
        if path is not None or fullname not in self._names:
            return None
        return PathFinder.find_spec(fullname, [str(self._folder)], target)


@contextmanager
def _imports_from(folder: Path, files: Iterable[Path]) -> Iterator[None]:
    """Imports find the current files of a folder, and these do not clash with other modules of their names, before or after."""
    names = {file.relative_to(folder).parts[0].removesuffix(".py") for file in files}

    def loaded() -> dict[str, ModuleType]:
        return {name: each for name, each in sys.modules.items() if name.partition(".")[0] in names}

    others = loaded()
    for name, each in others.items():
        # A module that the user's own program imported from this folder is the same for the plug-in.
        if not Path(getattr(each, "__file__", None) or "/").is_relative_to(folder):
            del sys.modules[name]
    writes_none, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    finder = _Beside(folder, names)
    sys.meta_path.insert(0, finder)
    importlib.invalidate_caches()
    try:
        yield
    finally:
        sys.meta_path.remove(finder)
        sys.dont_write_bytecode = writes_none
        for name in loaded():
            del sys.modules[name]
        sys.modules.update(others)


def _file_of(reference: str, what: str, folder: Path | None) -> tuple[Path, str]:
    """File and attribute of ``file.py:Name``."""
    file_text, _, attribute = absolute_reference(reference, folder or Path.cwd()).rpartition(":")
    file = Path(file_text)
    if not file.is_file():
        raise PluginError(
            f"{what} {reference}: expected a Python file at {file}, found none; correct the path"
        )
    return file, attribute


def _stands_for_nothing(name: str, what: str, built_in: Iterable[str], group: str) -> str:
    return (
        unknown(name, what, known_names(built_in, group))
        + f"; one of your own is file.py:Name, or an entry point of {group}"
    )


def options_of(
    model: type[Any] | None, written: Mapping[str, Any], what: str, key: str, error: type[AdvnerfError]
) -> Any:
    """The options of a plug-in as its own type.

    Args:
        model: The options' dataclass or pydantic model; None if it has no options.
        written: Keys and values as a user wrote them.
        what: Kind of an option, for messages: ``option of this method``.
        key: Prefix of each key in messages.
        error: Raised for an unknown key or a wrong value.

    Returns:
        An instance of the model; None without a model.
    """
    names = fields_of(model)
    for name in written:
        if name not in names:
            raise error(f"{key}.{name}: {unknown(name, what, names)}")
    if model is None:
        return None
    try:
        return strict_validator(model).validate_python(dict(written))
    except ValidationError as problem:
        first = problem.errors(include_url=False)[0]
        raise error(what_is_wrong(model, (key, *first["loc"]), first)) from None


def fields_of(model: type[Any] | None) -> tuple[str, ...]:
    """Names of the options of a plug-in, by their dataclass or pydantic model; none without one."""
    if model is None:
        return ()
    if issubclass(model, BaseModel):
        return tuple(model.model_fields)
    return tuple(each.name for each in dataclasses.fields(model))


def unknown(name: str, what: str, known: Iterable[str]) -> str:
    """Message about an unknown name: the valid ones, and the nearest of them."""
    names = list(dict.fromkeys(known))
    if not names:
        return f"expected no {what}, as there is none; got {name!r}"
    near = difflib.get_close_matches(name, names, n=1)
    hint = f" (did you mean {near[0]}?)" if near else ""
    return f"expected {_article(what)} {what} of {', '.join(names)}; got {name!r}{hint}"


def _load_entry_point(entry: EntryPoint, what: str) -> Any:
    try:
        with torch_left_as_it_is():
            return entry.load()
    except FAILURES as error:
        package = entry.dist.name if entry.dist is not None else "an installed package"
        raise PluginError(
            f"{what} {entry.name}: {entry.value} of {package} cannot be loaded: {in_one_line(error)}; update or remove that package"
        ) from error


def is_signal(code: object) -> bool:
    """Whether an exit code is that of a signal, and not one that code has asked for."""
    return isinstance(code, int) and code > 128


@contextmanager
def exit_refused() -> Iterator[None]:
    """Make an error of ``sys.exit`` in a user's code, which would end a command without a word, and with an exit code that means something else.

    Raises:
        PluginError: The code inside has called it.
    """
    try:
        yield
    except SystemExit as asked:
        if is_signal(asked.code):
            raise
        raise PluginError(EXITED) from asked


@contextmanager
def torch_left_as_it_is() -> Iterator[None]:
    """Refuse a user's code that changes torch for all code after it: the default dtype or device, or whether gradients are recorded.

    Raises:
        PluginError: The code inside has changed one of them; they are set back.
    """
    before = _settings_of_torch()
    try:
        yield
    finally:
        after = _settings_of_torch()
        if after != before:
            torch = sys.modules["torch"]
            torch.set_default_dtype(getattr(torch, before["default dtype"].removeprefix("torch.")))
            torch.set_default_device(None if before["default device"] == "cpu" else before["default device"])
            torch.set_grad_enabled(before["recording of gradients"] == "on")
    for name, value in before.items():
        if after[name] != value:
            raise PluginError(
                f"expected torch's {name} as it was, {value}, got {after[name]}, which all other code would have too; set it for tensors or blocks of your "
                "own (dtype=..., device=..., with torch.no_grad()), or set it back"
            )


def _settings_of_torch() -> dict[str, str]:
    if (torch := sys.modules.get("torch")) is None:
        return {"default dtype": "torch.float32", "default device": "cpu", "recording of gradients": "on"}
    return {
        "default dtype": str(torch.get_default_dtype()),
        "default device": str(torch.get_default_device()),
        "recording of gradients": "on" if torch.is_grad_enabled() else "off",
    }


def in_one_line(error: BaseException, longest: int | None = None) -> str:
    """Type and text of an error, without line breaks, cut after ``longest`` characters; of one that a user's code has raised also the file and line."""
    text = f"{type(error).__name__}: {' '.join(str(error).split())[:longest]}"
    where = "" if isinstance(error, AdvnerfError) else line_of_a_user(error)
    return f"{text} ({where})" if where else text


def _article(what: str) -> str:
    return "an" if what[:1].lower() in "aeiou" else "a"
