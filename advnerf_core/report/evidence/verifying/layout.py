"""Locations of the files of published sets."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.report.evidence.registration import FILE

SET, DIGESTS, PAGE, FORMAT = "set/set.json", "sets.json", "transfer.md", "advnerf-set-1"
# Digests of all other published files: pictures, films, the reference build, sets without a registration.
BESIDE = "files.json"


def sets_in(published: Path) -> list[str]:
    """Names of the registered sets in the folder of published results."""
    return sorted(file.parents[1].name for file in published.glob(f"*/{FILE}"))


def complete_sets(published: Path) -> list[str]:
    """Names of the sets of which all cells are published; the others are under way, and no number is read from them."""
    return [name for name in sets_in(published) if (published / name / SET).exists()]


def cell_files(folder: Path) -> list[Path]:
    """Files of the cells of a set, by name."""
    return sorted(folder.glob("*.json"))
