"""The commands ``advnerf car calibrate printer-chart`` and ``advnerf car calibrate printer``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from nodes.cli.calibrate_display import Output
from nodes.lab.wizards.output import keep_inputs, save_and_print

Lens = Annotated[
    Path, typer.Option("--lens", help="Lens file (car calibrate intrinsics) or camera file.", exists=True)
]


def printer_chart(
    output: Annotated[Path, typer.Option("--output", "-o", help="A .pdf or .png file.")],
    paper: Annotated[
        Literal["a4", "a3", "a2", "a1", "a0", "letter", "tabloid"], typer.Option(help="Paper of the chart.")
    ] = "a4",
    dpi: Annotated[float, typer.Option(min=50, max=2400, help="Pixels per inch.")] = 200.0,
) -> None:
    """Write a chart of colours to print, with markers and a JSON file of their sizes, for ``car calibrate printer``."""
    from advnerf_core.attack.printing.poster import PrintError, png_bytes
    from advnerf_core.attack.printing.record import SUFFIX, require_free, save_record
    from advnerf_core.files import write_atomically
    from calibration.print_chart import chart_pdf, chart_record, make_chart

    chart = make_chart(paper)
    if output.suffix.lower() not in (".pdf", ".png"):
        raise PrintError(f"expected a .pdf or .png file to write, got {output}; correct --output")
    record, beside = chart_record(chart, dpi), output.with_suffix(SUFFIX)
    require_free(beside, record)
    pdf = output.suffix.lower() == ".pdf"
    write_atomically(output, chart_pdf(chart, paper, dpi) if pdf else png_bytes(chart, dpi))
    save_record(record, beside)
    width, height = chart.sheet_mm
    print(f"written: {output}, {width:.0f} x {height:.0f} mm, and {beside}; print it as you print posters")


def printer(
    photo: Annotated[
        Path,
        typer.Argument(
            help="Photograph of the chart by the driving camera, in the light of the test.",
            exists=True,
            dir_okay=False,
        ),
    ],
    chart: Annotated[Path, typer.Option(help="The chart's .print.json file.", exists=True, dir_okay=False)],
    lens: Lens,
    output: Output,
    conditions: Annotated[
        str, typer.Option(help="Printer, paper, light and exposure, stored in the file.")
    ] = "exposure and white balance locked",
) -> None:
    """Calibrate how the camera sees printed colours under a light, from one photograph of a printed chart."""
    from advnerf_core.attack.printing.record import load_record
    from calibration.plots import display_plot
    from calibration.print_chart import fit_printer, printer_calibration
    from nodes.lab.wizards.bags import read_picture
    from nodes.lab.wizards.lens import load_lens

    keep_inputs(output, photo, chart, lens)
    fit = fit_printer(read_picture(photo), load_lens(lens), load_record(chart, "chart"))
    save_and_print(printer_calibration(fit, conditions), output, lambda figure: display_plot(figure, fit))
    print(f"a search prints within this range with\nface: {{display: {output}}}")
