"""A printed chart of colours, and the printer under a light, fitted to one photograph of it: a print is one more display."""

from __future__ import annotations

import datetime

import numpy as np
from numpy.typing import NDArray

from advnerf_core.attack.printing.frame import CHART_SET, frame_around
from advnerf_core.attack.printing.pdf import Page, PdfDocument
from advnerf_core.attack.printing.poster import MM_PER_M, Printable, pixels_of
from advnerf_core.attack.printing.record import PrintRecord, record_of
from advnerf_core.attack.printing.tiles import PAPERS_MM
from calibration.degeneracy import DegenerateDataError
from calibration.display_colour import DisplayCalibration, DisplayFit, colours_to_show, fit_display
from calibration.print_colour import patch_colours
from calibration.print_markers import find_markers, why_none
from calibration.print_pose import fit_print
from calibration.schema import Intrinsics

Rgb = NDArray[np.uint8]
_ROWS, _COLUMNS = 7, 13
_PICTURE_MM, _MARKER_MM, _MARGIN_MM = (208.0, 140.0), 20.0, 8.0  # on A4, in landscape
_PATCH_PX = 32
# Ink and paper in the light of a room leave fewer colours away from black and white than a monitor.
_LEAST_FREE = 0.4


def chart_colours() -> NDArray[np.uint8]:
    """sRGB colours ``[7, 13, 3]``: those that a monitor is measured with, mixed, so that a slope of the light is none of the colours."""
    colours = colours_to_show()
    order = np.random.default_rng(0).permutation(len(colours))
    return colours[order].reshape(_ROWS, _COLUMNS, 3)


def make_chart(paper: str) -> Printable:
    """The chart, as large as a paper in landscape allows."""
    short, long = sorted(PAPERS_MM[paper])
    plain = frame_around(
        (_PICTURE_MM[0] / MM_PER_M, _PICTURE_MM[1] / MM_PER_M), CHART_SET, _MARKER_MM / MM_PER_M
    )
    width_m, height_m = plain.sheet_m
    scale = min(
        (long - 2.0 * _MARGIN_MM) / (MM_PER_M * width_m), (short - 2.0 * _MARGIN_MM) / (MM_PER_M * height_m)
    )
    size_m = (plain.picture_m[0] * scale, plain.picture_m[1] * scale)
    texture = np.kron(chart_colours(), np.ones((_PATCH_PX, _PATCH_PX, 1), np.uint8))
    return Printable(texture, size_m, frame_around(size_m, CHART_SET, plain.marker_m * scale))


def chart_record(chart: Printable, dpi: float) -> PrintRecord:
    """The record of a chart."""
    assert chart.frame is not None, "a chart has markers"
    return record_of(chart.frame, dpi, kind="chart", patches=chart_colours().astype(np.float64))


def chart_pdf(chart: Printable, paper: str, dpi: float) -> bytes:
    """The chart on one page in landscape.

    Raises:
        PrintError: More pixels than fit into memory.
    """
    short, long = sorted(PAPERS_MM[paper])
    width, height = chart.sheet_mm
    page, corner = Page((long, short)), (0.5 * (long - width), 0.5 * (short - height))
    page.image(
        corner, (width, height), chart.pixels((0.0, 0.0, width, height), pixels_of((width, height), dpi))
    )
    assert chart.frame is not None, "a chart has markers"
    marker_mm = chart.frame.marker_m * MM_PER_M
    page.text((corner[0] + 1.0, short - 3.0), f"Markers {marker_mm:.1f} mm wide. Print at 100 %.", 7.0)
    document = PdfDocument("Colour chart")
    document.add(page)
    return document.to_bytes()


def fit_printer(rgb: Rgb, lens: Intrinsics, record: PrintRecord) -> DisplayFit:
    """Fit a printer, its paper and the light to one photograph ``[H, W, 3]`` of its chart.

    Raises:
        PrintError: The record does not belong to a chart.
        DegenerateDataError: The photograph does not show the chart well enough.
        PoorFitError: The chart is bent, or its colours do not fit.
    """
    record.require("chart")
    assert record.patches is not None, "a chart has patches"
    markers = find_markers(rgb, lens, record.markers, "the chart")
    if not markers:
        raise DegenerateDataError(
            f"expected the chart in the photograph, found none of its markers: {why_none(rgb)}"
        )
    pose = fit_print(markers, record.markers, lens.pinhole)
    shape = record.patches.shape
    seen = patch_colours(
        rgb,
        lens,
        pose.laid,
        record.picture_m,
        (shape[0], shape[1]),
        {number: record.markers[number] for number in pose.seen},
    )
    shown = record.patches.reshape(-1, 3) / 255.0
    return fit_display(shown, seen.reshape(-1, 3), least_free=_LEAST_FREE, inks=True)


def printer_calibration(fit: DisplayFit, conditions: str) -> DisplayCalibration:
    """The calibration file of a fitted printer: a `DisplayCalibration`, which searches use as they use a monitor's."""
    method = "one photograph of a printed chart: ramps, primaries and mixed colours, least squares on the seen means"
    return fit.calibration(conditions).model_copy(update={"method": method, "date": datetime.date.today()})
