"""Stored facts about users' worlds from the last run of an experiment, so that states and tables of a run folder execute no code."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.plain import PlainData
from advnerf_core.plugins import code_sha256
from hardware.worlds import ENTRY_POINTS
from hardware.worlds.world import NotOpenError, Traits, WorldDescription
from nodes.lab.worlds.named import WORLDS, NamedWorld
from nodes.runtime.errors import RuntimeFault

KEPT = "worlds.json"


class WorldUnknownError(RuntimeFault):
    """The experiment was not run yet with a world, or the world's code has changed since."""


@dataclass(frozen=True)
class KeptWorld(PlainData):
    """Stored facts about a world.

    Attributes:
        source_sha256: Hash of its code.
        settings: Output of `NamedWorld.settings`.
        traits: Output of `NamedWorld.traits`.
        description: Description of the world; None if it must be open for that.
    """

    section: dict[str, Any]
    source_sha256: str
    settings: dict[str, Any]
    traits: Traits
    description: WorldDescription | None

    def describe(self) -> WorldDescription:
        """Description of the world.

        Raises:
            NotOpenError: The world must be open for that.
        """
        if self.description is None:
            raise NotOpenError(f"the world {self.settings['kind']} must be open to say this")
        return self.description


def is_users(section: Mapping[str, Any]) -> bool:
    """Whether a section names a world that is not built in."""
    return section.get("kind") not in WORLDS


def keep_worlds(folder: Path, worlds: Iterable[tuple[dict[str, Any], NamedWorld]]) -> None:
    """Store the facts about users' worlds, each with the section of the experiment file that names it, in a run folder."""
    found = [
        KeptWorld(section, world.source_sha256, world.settings, world.traits, _description(world)).to_dict()
        for section, world in worlds
        if is_users(section)
    ]
    sections = [each["section"] for each in found]
    if found:
        write_json(
            folder / KEPT, [*found, *(each for each in _read(folder) if each["section"] not in sections)]
        )


def _read(folder: Path) -> list[dict[str, Any]]:
    return read_json(folder / KEPT) if (folder / KEPT).exists() else []


def _description(world: NamedWorld) -> WorldDescription | None:
    try:
        return world.describe()
    except NotOpenError:
        return None


def kept_world(folder: Path, section: Mapping[str, Any], beside: Path) -> KeptWorld:
    """Stored facts about the world of a section in a run folder; nothing of it is executed. ``file.py:Class`` is relative to ``beside``.

    Raises:
        WorldUnknownError: No facts are stored for this section with this code.
    """
    code = code_sha256(section["kind"], WORLDS, ENTRY_POINTS, beside)
    for each in _read(folder):
        if (each["section"], each["source_sha256"]) == (section, code):
            return KeptWorld.from_dict(each)
    raise WorldUnknownError(
        f"expected the world {section['kind']} as it was when the experiment in {folder} was last run, got another, or none; run the experiment"
    )
