"""The commands of ``advnerf attack`` about paper: ``print`` and ``measure``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from nodes.runtime.terminal import pose_of, print_table, table

if TYPE_CHECKING:
    from advnerf_core.attack.artifact import AttackFile
    from advnerf_core.attack.printing.record import PrintRecord
    from nodes.experiment.node.print_effect import PrintEffect
    from nodes.lab.wizards.prints import MeasuredPrint


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
            min=8.0,
            max=500.0,
            help="Side of a marker.",
            show_default="that of the search, or 12 % of the texture, 20 to 150",
        ),
    ] = None,
) -> None:
    """Write a face's or panel's texture at its true size: a PDF in tiles with marks to cut and glue, or one PNG."""
    from advnerf_core.attack.artifact import load_attack
    from advnerf_core.attack.printing.poster import poster_of
    from advnerf_core.attack.printing.record import save_record
    from advnerf_core.files import refuse_overwriting
    from nodes.experiment.node.printed import record_beside, stem_of, write_poster

    poster = poster_of(load_attack(file), name, size_m)
    if markers:
        poster = poster.with_markers(None if marker_mm is None else marker_mm / 1000.0)
    target = output or file.with_name(f"{stem_of(file)}.poster.pdf")
    refuse_overwriting((file,), (target,))
    beside = record_beside(poster, file, target, dpi) if markers else None
    print(write_poster(poster, target, paper, dpi, margin_mm, overlap_mm))
    if beside is not None:
        save_record(*beside)
        print(f"written: {beside[1]}, the sizes for 'advnerf attack measure'")


def attack_measure(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="PHOTO|BAG", help="Photograph of the print, or bag of a drive past it.", exists=True
        ),
    ],
    printed: Annotated[
        Path,
        typer.Option(
            "--print", help="The .print.json file beside what was printed.", exists=True, dir_okay=False
        ),
    ],
    camera: Annotated[
        Path,
        typer.Option(help="Lens or camera file of the photograph; camera file of the bag.", exists=True),
    ],
    card: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="Gives the size: the .print.json of a chart of true size that hangs flat beside the print, in the same photograph.",
        ),
    ] = None,
    distance_m: Annotated[
        float | None,
        typer.Option("--distance", min=0.01, help="Gives the size: from the lens to the print's middle [m]."),
    ] = None,
    width_m: Annotated[
        float | None,
        typer.Option("--width", min=0.01, help="Gives the size: width of the texture, by ruler [m]."),
    ] = None,
    car: Annotated[
        str | None,
        typer.Option(
            metavar="X,Y,YAW",
            help="Pose of the car that took the photograph, m and rad: gives the pose in the world, and colours as the policy sees them.",
        ),
    ] = None,
    attack_file: Annotated[
        Path | None,
        typer.Option(
            "--attack",
            exists=True,
            dir_okay=False,
            help="The attack file that was printed.",
            show_default="the one that --print names",
        ),
    ] = None,
    request: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="The attack's *.experiment.yaml: predicts the print's effect."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="JSON file to write; the print's picture goes beside it.",
            show_default="beside PHOTO or BAG",
        ),
    ] = None,
) -> None:
    """Measure a print where it hangs: true size, pose, flatness, colours, and what it does to the victim."""
    from advnerf_core.attack.artifact import load_attack
    from advnerf_core.attack.printing.record import load_record
    from advnerf_core.files import refuse_overwriting
    from nodes.lab.wizards.prints import KnownLength, measure, measured_files, write_measured

    target = output or source.with_name(f"{source.stem}.measured.json")
    record = load_record(printed, "poster")
    attack_file = attack_file or printed.parent / record.attack_file
    refuse_overwriting((source, printed, camera, card, attack_file, request), measured_files(target))
    attack = load_attack(attack_file)
    known = KnownLength(
        None if card is None else load_record(card, "chart"),
        distance_m,
        width_m,
        pose_of("--car", car, "1.2,-0.4,3.1"),
    )
    found = measure(source, record, attack, camera, known)
    rows = table("of the print", "measured")
    for name, text in found.measurement.lines:
        rows.add_row(name, text)
    print_table(rows)
    effect = None
    if request is not None:
        effect = _effect(request, attack, record, found)
        print(effect.text)
    print(f"written: {', '.join(map(str, write_measured(found, effect, target)))}")


def _effect(request: Path, attack: AttackFile, record: PrintRecord, found: MeasuredPrint) -> PrintEffect:
    from nodes.experiment.node.prepare import load_request
    from nodes.experiment.node.print_effect import print_effect
    from nodes.lab.plugin_tables import say_code

    experiment = load_request(request)
    say_code(experiment.config.model_dump(mode="json"), request.parent)
    measurement = found.measurement
    (width_m, height_m), (w, h) = record.sheet_m, record.picture_m
    scale = measurement.scale * (width_m * height_m / (w * h)) ** 0.5  # it hangs with its border
    return print_effect(
        experiment, attack, record.object, found.texture, scale, measurement.T_world_from_face
    )
