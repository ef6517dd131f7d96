"""What a person says about each published set: exploration or confirmation, what changed since the sets before, and where its object stands."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from advnerf_core.documents import Document, read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.strict import StrictModel, parse_value

# Beside the folders of the sets; written by hand.
ABOUT = "sets_about.json"
Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]


class AboutError(AdvnerfError, ValueError):
    """A published set has no usable entry in `ABOUT`."""


class ObjectPlace(StrictModel):
    """Where the face of the object stands, as seen from above.

    Attributes:
        x_m: Its middle [m], in the axes of the kept drives.
        y_m: The same [m].
        yaw_rad: Direction that it faces [rad].
        width_m: Its width [m].
        source: Where these numbers come from.
        estimated: Whether they were estimated from pictures; else they were kept.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    width_m: Positive
    source: Text
    estimated: bool = False


class SetAbout(StrictModel):
    """What is said about one set.

    Attributes:
        world: Where it was driven, for readers.
        role: Exploration tries something for the first time; confirmation repeats an earlier result with other searches and starts.
        after: What was known when it was registered: earlier sets or cells; empty for nothing.
        changed: What changed since then.
        object: Where the object stands; None where that was not kept.
    """

    world: Text
    role: Literal["exploration", "confirmation"]
    after: str = ""
    changed: Text
    object: ObjectPlace | None = None


def read_about(published: Path) -> dict[str, SetAbout]:
    """The entries by name of the set; empty without a file.

    Args:
        published: Folder of all published sets.

    Raises:
        ConfigError: The file is not of this form; the message names the line.
    """
    file = published / ABOUT
    if not file.exists():
        return {}
    found: dict[str, SetAbout] = parse_value(dict[str, SetAbout], Document(read_json(file), str(file)))
    return found


def check_about(published: Path, sets: Collection[str]) -> None:
    """Check that the file, if it is there, has one entry for each set.

    Raises:
        AboutError: An entry is missing, or names no set.
    """
    if not (published / ABOUT).exists():
        return
    entries = read_about(published).keys()
    for name in sorted(set(sets) - entries):
        raise AboutError(
            f"{published / ABOUT}: expected an entry for {name}, got none; add world, role, after and changed"
        )
    for name in sorted(entries - set(sets)):
        raise AboutError(
            f"{published / ABOUT}: expected entries of sets in {published}, got {name}; remove it"
        )
