"""The command ``advnerf experiment init``: files to edit, for a first day with an installed package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def init(
    folder: Annotated[Path, typer.Argument(help="Folder to work in.", file_okay=False)],
) -> None:
    """Copy launch and experiment files, the examples and the simulated lab's calibration into a folder, to edit. Existing files are kept."""
    from advnerf_core.files import write_atomically
    from nodes.runtime.paths import shipped

    copied = kept = 0
    for name in ("launch", "examples", "calibration/twin"):
        source = shipped(name)
        for file in sorted(path for path in source.rglob("*") if path.is_file() and path.suffix != ".pyc"):
            target = folder / name / file.relative_to(source)
            if target.exists():
                kept += 1
            else:
                write_atomically(target, file.read_bytes())
                copied += 1
    stay = f", {kept} were there and stay as they are" if kept else ""
    print(
        f"{copied} files copied to {folder}{stay}; work in that folder, as in: cd {folder}; advnerf launch green_screen --check"
    )
