"""The commands of ``advnerf attack`` about paper: ``print``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def attack_print(
    file: Annotated[Path, typer.Argument(help="An attack file.", exists=True, dir_okay=False)],
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="A .pdf or .png file.", show_default="FILE's name with .poster.pdf"
        ),
    ] = None,
    paper: Annotated[
        Literal["a4", "a3", "a2", "a1", "a0", "letter", "tabloid", "none"],
        typer.Option(help="Paper of the PDF's tiles; none: one page as large as the poster."),
    ] = "a4",
    dpi: Annotated[float, typer.Option(min=10, max=2400, help="Pixels per inch.")] = 200.0,
    margin_mm: Annotated[float, typer.Option(help="White on every side of a page.")] = 8.0,
    overlap_mm: Annotated[float, typer.Option(help="Strip that neighbouring tiles share, for glue.")] = 5.0,
    name: Annotated[str | None, typer.Option("--object", help="Name or number of the object.")] = None,
    size_m: Annotated[
        float | None,
        typer.Option(
            "--object-size", min=0.01, help="Edge of a panel [m], for attack files that do not hold it."
        ),
    ] = None,
    markers: Annotated[
        bool,
        typer.Option(
            help="A white border with markers around the texture, for 'advnerf attack measure', and a JSON file of their sizes."
        ),
    ] = True,
    marker_mm: Annotated[
        float | None,
        typer.Option(
            min=8.0, max=500.0, help="Side of a marker.", show_default="12 % of the texture, 20 to 150"
        ),
    ] = None,
) -> None:
    """Write a face's or panel's texture at its true size: a PDF in tiles with marks to cut and glue, or one PNG."""
    from advnerf_core.attack.artifact import load_attack
    from advnerf_core.attack.printing.poster import poster_of
    from nodes.experiment.node.printed import write_poster, write_record

    poster = poster_of(load_attack(file), name, size_m)
    if markers:
        poster = poster.with_markers(None if marker_mm is None else marker_mm / 1000.0)
    target = output or file.with_name(f"{file.name.partition('.')[0]}.poster.pdf")
    print(write_poster(poster, target, paper, dpi, margin_mm, overlap_mm))
    if markers:
        print(f"written: {write_record(poster, file, target, dpi)}, the sizes for 'advnerf attack measure'")


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    app.command("print")(attack_print)
