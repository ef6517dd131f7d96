"""The files of a run folder that the page shows. Nothing else is served: a request is looked up here and never becomes a path."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nodes.lab import recorded_victim

REPORT = "report/report.html"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".csv": "text/csv; charset=utf-8",
    ".md": "text/plain; charset=utf-8",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".mp4": "video/mp4",
}
# Pictures of stages, in the order of the stages; only the first few of many views.
_PICTURES = (("scene", "views/*.png", 6), ("policy", "*.png", 8), ("retrain", "*.png", 2))


def type_of(file: Path) -> str:
    """Media type of a shown file."""
    return _TYPES[file.suffix]


def pictures(folder: Path) -> dict[str, Path]:
    """Pictures that stages have written, by their path in the run folder."""
    found = [
        file for stage, pattern, most in _PICTURES for file in sorted((folder / stage).glob(pattern))[:most]
    ]
    return _named(folder, found)


def films(folder: Path, cells: Sequence[str]) -> dict[str, Path]:
    """Existing films of cells, by their path in the run folder."""
    return _named(folder, [folder / "cells" / name / "clip.mp4" for name in cells])


def recorded_files(folder: Path) -> dict[str, Path]:
    """Picture and film of the recorded victim, by their path in the run folder."""
    return _named(
        folder,
        [
            folder / recorded_victim.FOLDER / recorded_victim.NOW,
            *sorted((folder / recorded_victim.FOLDER).glob(f"{recorded_victim.FILM}.*")),
        ],
    )


def report_files(folder: Path) -> dict[str, Path]:
    """The report and its pictures, by their path in the run folder."""
    return _named(folder, sorted((folder / "report").rglob("*")))


def _named(folder: Path, files: Sequence[Path]) -> dict[str, Path]:
    whole = folder.resolve()
    return {
        file.relative_to(folder).as_posix(): file
        for file in files
        if file.suffix in _TYPES and file.is_file() and file.resolve().is_relative_to(whole)
    }
