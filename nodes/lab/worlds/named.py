"""Worlds by name: the class, its checked configuration, and the settings that results depend on."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from pydantic import BaseModel, TypeAdapter

from advnerf_core.documents import Document
from advnerf_core.plugins import (
    PluginError,
    absolute_reference,
    code_sha256,
    is_file_reference,
    require_known,
    resolve,
)
from advnerf_core.strict import is_of_settings, validate
from hardware.worlds import ENTRY_POINTS
from hardware.worlds import WORLDS as DRIVEN
from hardware.worlds.world import Traits, World, WorldClass, WorldDescription, members_of_a_world, traits_of
from nodes.lab.worlds.held import held_to_its_word
from nodes.runtime.errors import ConfigError

_PAGE = "docs/worlds.md"


def _photographs() -> WorldClass:
    from nodes.lab.worlds.photographs.world import Photographs

    return Photographs


def _own_scene() -> WorldClass:
    from nodes.lab.worlds.own_scene import OwnScene

    return OwnScene


WORLDS: Mapping[str, Callable[[], WorldClass]] = {
    **DRIVEN,
    "photographs": _photographs,
    "scene": _own_scene,
}
"""Loaders of the worlds' classes by name: those that can be driven, a place of photographs alone, and a learned scene alone."""


@dataclass(frozen=True)
class NamedWorld:
    """A world named by a file or a user. It is not open, and can be constructed repeatedly.

    Attributes:
        kind: Name of the world: built in, an entry point, or ``file.py:Class`` with the file's name alone.
        source_sha256: Hash of the code of a ``file.py:Class`` or an entry point; empty for a built-in name.
    """

    kind: str
    world_class: WorldClass
    config: Any
    source_sha256: str

    def make(self) -> World:
        """Construct the world, without opening it. One of a user's own is checked at each call, see `held_to_its_word`.

        Raises:
            ConfigError: The class lacks a member that every world must have.
            OwnWorldError: A world of a user's own has failed.
        """
        made = held_to_its_word(self.world_class, self.kind) if self.source_sha256 else self.world_class
        world = made(self.config)
        # For a property only the class is checked: a world that is not open may not know its value.
        known = (set(dir(type(world))), set(vars(world)) if hasattr(world, "__dict__") else set())
        missing = [name for name in members_of_a_world() if not any(name in names for names in known)]
        if missing:
            raise ConfigError(
                f"world {self.kind}: expected {', '.join(missing)}, which it lacks; {_PAGE} says what a world must have"
            )
        return world

    @property
    def traits(self) -> Traits:
        """Properties that are known before it is opened."""
        return traits_of(self.make())

    def describe(self) -> WorldDescription:
        """The description before it is opened.

        Raises:
            NotOpenError: The world is not open.
        """
        return self.make().describe()

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that results depend on, as JSON data: the configuration without excluded fields, and a hash of a user's code."""
        dumped = (
            self.config.model_dump(mode="json")
            if isinstance(self.config, BaseModel)
            else TypeAdapter(type(self.config)).dump_python(self.config, mode="json")
        )
        source = {"source_sha256": self.source_sha256} if self.source_sha256 else {}
        return {"kind": self.kind, **source, **dumped}


def read_world(document: Document, folder: Path) -> NamedWorld:
    """The world of a section ``{kind: ..., key: value, ...}``.

    Args:
        document: The section: ``kind``, and changes of the configuration of that world's class.
        folder: Folder that a relative ``file.py:Class`` is relative to.

    Raises:
        ConfigError: The world is unknown, or its configuration is wrong; with file, line and the valid keys.
    """
    kind = known_kind(document, folder)
    try:
        world_class = find_world(kind, folder)
    except PluginError as error:
        raise ConfigError(f"{document.place(('kind',))}: {error}") from None
    changes = {key: value for key, value in document.data.items() if key != "kind"}
    config = validate(world_class.Config, Document(changes, document.source, document.places), folder)
    code = code_sha256(kind, WORLDS, ENTRY_POINTS, folder)
    if is_file_reference(kind):
        kind = Path(absolute_reference(kind, folder)).name
    return NamedWorld(kind, world_class, config, code)


def known_kind(document: Document, folder: Path) -> str:
    """The name of the world of a section, as in `read_world`; nothing is loaded.

    Raises:
        ConfigError: The section has no name, or it stands for nothing; with file and line.
    """
    if not isinstance(document.data, dict) or not isinstance(document.data.get("kind"), str):
        raise ConfigError(
            f"{document.place(('kind',))}: expected kind: NAME, the world's name ({', '.join(WORLDS)}, or file.py:Class); got {document.data!r:.80}"
        )
    kind: str = document.data["kind"]
    try:
        require_known(kind, "world", WORLDS, ENTRY_POINTS, folder)
    except PluginError as error:
        raise ConfigError(f"{document.place(('kind',))}: {error}") from None
    return kind


def find_world(name: str, folder: Path) -> WorldClass:
    """The class behind a world's name.

    Raises:
        PluginError: The world is unknown, cannot be loaded, or is not a class with a ``Config``.
    """
    found: Any = resolve(name, "world", WORLDS, ENTRY_POINTS, folder)
    if not (isinstance(found, type) and is_of_settings(getattr(found, "Config", None))):
        raise PluginError(
            f"world {name}: expected a class with an attribute Config, a pydantic model or a dataclass; got {found!r:.80}; see {_PAGE}"
        )
    return cast("WorldClass", found)


def without(settings: Mapping[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Settings without the given dotted keys, such as ``car.turn_rate_lag_s``."""
    left = dict(settings)
    for key in keys:
        head, _, rest = key.partition(".")
        if rest and isinstance(left.get(head), Mapping):
            left[head] = without(left[head], (rest,))
        elif not rest:
            left.pop(head, None)
    return left
