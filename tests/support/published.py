"""A published set as ``advnerf experiment publish`` leaves it."""

from pathlib import Path

from advnerf_core.report.evidence.publishing import write_numbers, write_page


def write_set(folder: Path) -> None:
    """Write the numbers and pictures of a set, then the page of all sets."""
    write_numbers(folder)
    write_page(folder.parent)
