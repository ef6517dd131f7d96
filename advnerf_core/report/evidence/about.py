"""Hand-written facts about each published set: exploration or confirmation, changes since earlier sets, and the position of its object."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from advnerf_core.documents import Document, read_json
from advnerf_core.report.evidence.registration import SetError
from advnerf_core.strict import StrictModel, parse_value

# Beside the folders of the sets.
ABOUT = "sets_about.json"
Text = Annotated[str, Field(min_length=1)]
Positive = Annotated[float, Field(gt=0)]


class ObjectPlace(StrictModel):
    """Position of the object's face, seen from above.

    Attributes:
        x_m: Middle of the face [m], in the axes of the published drives.
        y_m: Middle of the face [m].
        yaw_rad: Direction of its front [rad].
        width_m: Width of the face [m].
        source: Source of these numbers.
        estimated: Whether they were estimated from pictures; else they were stored.
    """

    x_m: float
    y_m: float
    yaw_rad: float
    width_m: Positive
    source: Text
    estimated: bool = False


class SetAbout(StrictModel):
    """Facts about one set.

    Attributes:
        world: Name of the world for readers.
        role: Exploration tries something for the first time; confirmation repeats an earlier result with other searches and starts.
        after: Earlier sets or cells that were known when it was registered; empty for none.
        changed: Changes since those.
        object: Position of the object; None if it was not stored.
    """

    world: Text
    role: Literal["exploration", "confirmation"]
    after: str = ""
    changed: Text
    object: ObjectPlace | None = None


def read_about(published: Path) -> dict[str, SetAbout]:
    """The entries by name of the set; empty without a file.

    Raises:
        ConfigError: The file is invalid; the message names the line.
    """
    file = published / ABOUT
    if not file.exists():
        return {}
    found: dict[str, SetAbout] = parse_value(dict[str, SetAbout], Document(read_json(file), str(file)))
    return found


def check_about(published: Path, sets: Collection[str]) -> None:
    """Check that the file, if it exists, has one entry for each set.

    Raises:
        SetError: An entry is missing, or has no set.
    """
    if not (published / ABOUT).exists():
        return
    entries = read_about(published).keys()
    for name in sorted(set(sets) - entries):
        raise SetError(
            f"{published / ABOUT}: expected an entry for {name}, got none; add world, role, after and changed"
        )
    for name in sorted(entries - set(sets)):
        raise SetError(f"{published / ABOUT}: expected entries of sets in {published}, got {name}; remove it")
