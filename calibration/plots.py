"""Plots of calibration fits against their measurements, saved next to the calibration file. No display is needed."""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from advnerf_core.files import refuse_overwriting, write_atomically
from calibration.camera_to_car import MountFit
from calibration.display_colour import DisplayFit
from calibration.intrinsics import IntrinsicsFit
from calibration.schema import Calibration, CalibrationError, refuse_other_kinds, save_calibration
from calibration.time_offset import OffsetFit
from calibration.vehicle import GainsFit
from calibration.vehicle_response import ResponseFit

_CHANNELS = ("tab:red", "tab:green", "tab:blue")


def plot_beside(path: Path) -> Path:
    """Path of the plot of a calibration file."""
    return path.with_suffix(".png")


def save_with_plot(calibration: Calibration, path: Path, draw: Callable[[Figure], None]) -> Path:
    """Write a calibration file and its plot, each atomically. Returns the path of the plot.

    Raises:
        CalibrationError: A file cannot be written, or would replace a file of another kind.
    """
    refuse_other_kinds(calibration, path)
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    draw(figure)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    picture = plot_beside(path)
    refuse_overwriting((), (picture, path))
    try:
        write_atomically(picture, buffer.getvalue())
    except OSError as error:
        raise CalibrationError(f"cannot write {picture}: {error.strerror or error}") from error
    save_calibration(calibration, path)
    return picture


def intrinsics_plot(figure: Figure, fit: IntrinsicsFit) -> None:
    """Coverage map and reprojection errors."""
    left, right = figure.subplots(1, 2)
    size = (fit.calibration.width, fit.calibration.height)
    shown = left.imshow(fit.coverage, extent=(0, size[0], size[1], 0), cmap="viridis", aspect="equal")
    figure.colorbar(shown, ax=left, label="corners per cell")
    left.set(title="coverage", xlabel="column [px]", ylabel="row [px]")
    right.plot(fit.errors_px[:, 0], fit.errors_px[:, 1], ".", markersize=2, alpha=0.5)
    _square(right, "reprojection error", "column [px]", "row [px]", f"rms {fit.calibration.rms_px:.3f} px")


def mount_plot(figure: Figure, fit: MountFit) -> None:
    """Reprojection error of each view, left-out views marked."""
    axes = figure.subplots()
    index, rms = np.arange(len(fit.view_rms_px)), fit.view_rms_px
    axes.bar(index[fit.used], rms[fit.used], label="fitted")
    if not fit.used.all():
        axes.bar(index[~fit.used], np.nan_to_num(rms[~fit.used]), color="tab:red", label="left out")
    degrees, mm = np.degrees(fit.rotation_stddev_rad), 1000.0 * fit.translation_stddev_m
    axes.set(
        title=f"{fit.method}\nstandard deviation {degrees:.3f} degrees, {mm:.2f} mm",
        xlabel="view",
        ylabel="reprojection error [px]",
    )
    axes.legend()


def vehicle_plot(figure: Figure, gains: GainsFit, response: ResponseFit) -> None:
    """Both lines, and ten seconds of the yaw."""
    one, two, three = figure.subplots(1, 3)
    servo, erpm = (np.array([getattr(s, name) for s in gains.segments]) for name in ("servo", "erpm"))
    _line(one, servo, gains.steering_rad, gains.steering_of, "servo", "wheel angle [rad]")
    _line(two, erpm, gains.speed_mps, gains.speed_of, "erpm", "speed [m/s]")
    last = response.steering.time_s > response.steering.time_s[-1] - 10.0
    three.plot(response.steering.time_s[last], response.steering.seen[last], "k", linewidth=0.8, label="seen")
    three.plot(response.steering.time_s[last], response.steering.modelled[last], "tab:orange", label="model")
    s = response.steering
    three.set(
        title=f"delay {1000 * s.delay_s:.0f} ms, lag {1000 * s.lag_s:.0f} ms",
        xlabel="time [s]",
        ylabel="turn in 60 ms [rad]",
    )
    three.legend()


def display_plot(figure: Figure, fit: DisplayFit) -> None:
    """Curves, and predicted against seen colours."""
    left, right = figure.subplots(1, 2)
    levels = np.linspace(0.0, 1.0, fit.model.curves.shape[1])
    predicted = fit.model.forward(fit.shown, fit.cos_angle)
    for channel, colour in enumerate(_CHANNELS):
        left.plot(levels, fit.model.curves[channel], color=colour)
        for rows, marker in ((~fit.held_out, "."), (fit.held_out, "x")):
            right.plot(fit.seen[rows, channel], predicted[rows, channel], marker, color=colour, markersize=4)
    left.set(title="light of the monitor's channels", xlabel="shown", ylabel="light")
    right.plot([0, 1], [0, 1], "k", linewidth=0.6)
    _square(right, f"held out (x): rmse {100 * fit.rmse(True):.2f} %", "seen", "predicted")


def offset_plot(figure: Figure, fit: OffsetFit) -> None:
    """Correlation over the shift, and both turns at the offset."""
    left, right = figure.subplots(1, 2)
    left.plot(1000.0 * fit.shifts_s, fit.correlation)
    left.axvline(1000.0 * fit.camera_minus_mocap_s, color="tab:orange")
    ms, sd = 1000.0 * fit.camera_minus_mocap_s, 1000.0 * fit.stddev_s
    left.set(title=f"camera {ms:.1f} +- {sd:.1f} ms behind", xlabel="shift [ms]", ylabel="correlation")
    right.plot(fit.turns.end_s, fit.turns.yaw_rad, "k.", markersize=3, label="image")
    right.plot(
        fit.turns.end_s,
        fit.car_yaw_rad,
        color="tab:orange",
        linewidth=0.8,
        label="motion capture at the offset",
    )
    right.set(xlabel="time [s]", ylabel="turn between frames [rad]")
    right.legend()


def _line(axes: Any, x: Any, y: Any, of: Callable[[Any], Any], x_name: str, y_name: str) -> None:
    ends = np.array([x.min(), x.max()])
    axes.plot(x, y, ".")
    axes.plot(ends, of(ends), color="tab:orange", linewidth=0.8)
    axes.set(xlabel=x_name, ylabel=y_name)


def _square(axes: Any, title: str, x_name: str, y_name: str, label: str = "") -> None:
    axes.set(title=f"{title} {label}".strip(), xlabel=x_name, ylabel=y_name, aspect="equal")
    axes.grid(alpha=0.3)
