"""Puts a model of photographs into an upright, metric world, by facts that the user knows about it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.csv_rows import read_csv
from advnerf_core.data.image_files import read_stored
from advnerf_core.data.lens import straightening
from advnerf_core.data.rigid import far_from_origin
from advnerf_core.data.similarity import Similarity
from advnerf_core.errors import ConfigError
from advnerf_core.geometry import Array
from calibration.known_scale import View, fit_known_positions, length_scale, marker_scale
from calibration.photo_model import Model
from calibration.world_axes import Ground, cameras_up, find_ground, on_ground, upright
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.metric_options import MetricOptions

# A scan's own metre is off by a few percent; more is another place, or another unit.
_MOST_RESCALED = 2.0
# Cameras that people or robots hold point down by less than 75 degrees: their tops are this much up.
_LEAST_UP, _SAME_WAY = 0.25, 0.8


@dataclass(frozen=True)
class OwnScale:
    """Scale of a model without a known length.

    Attributes:
        scale: Factor of its lengths.
        source: Source of the metre: ``poses``, or None if lengths are not metric.
        why: The report's explanation.
    """

    scale: float
    source: str | None
    why: str


def place(
    model: Model,
    points_by_id: Mapping[int, Array],
    views: Callable[[], Iterable[View]],
    options: MetricOptions,
    otherwise: OwnScale,
    R_upright_from_model: Array | None = None,
) -> tuple[Similarity, dict[str, Any]]:
    """Similarity from a model into an upright world, and the report's description of it.

    Args:
        points_by_id: Points ``[3]`` of the model by COLMAP's number.
        views: Returns the undistorted images, for markers.
        otherwise: The scale if no option gives it.
        R_upright_from_model: Rotation ``[3, 3]`` to z up, if the model knows gravity.
    """
    known = R_upright_from_model if options.up == "auto" else None
    if known is not None:
        _require_upright(known, model)
    ground = _ground(model, options, known)
    if options.positions is not None:
        return _at_positions(model, options.positions, ground, otherwise)
    up = "the cameras' up" if known is None else "that of the scan"
    if ground is not None:
        plane = f"a plane of {ground.points} points at z = 0"
        up = f"normal of the ground, {plane}" if known is None else f"{up}; the ground is {plane}"
    scale, scale_from, said = otherwise.scale, otherwise.source, otherwise.why
    if options.length is not None:
        one, other, length_m = options.length
        scale, scale_from = length_scale(model, points_by_id, one, other, length_m), "length"
        said = f"metric: {length_m:g} m from {one} to {other}"
    elif options.marker_m is not None:
        found = marker_scale(views(), options.marker_m, options.dictionary)
        scale, scale_from = found.scale, "fiducials"
        said = f"metric: {found.markers} markers of {options.marker_m:g} m, whose sides differ by {100 * found.spread:.2g} %"
    said += _rescaled(scale, otherwise)
    similarity = on_ground(model, ground, scale) if known is None else upright(known, model, ground, scale)
    return similarity, _facts(said, scale_from, up, ground is not None)


def _require_upright(R_upright_from_model: Array, model: Model) -> None:
    """Refuse a world in which all cameras lie on their sides the same way. A camera that is mounted turned points its top elsewhere in every bend."""
    tops = -model.poses[:, :3, 1].mean(axis=0)
    up = R_upright_from_model[2] @ cameras_up(model.poses)
    if up < _LEAST_UP and np.linalg.norm(tops) > _SAME_WAY:
        raise ImportRecordingError(
            f"expected a scan whose z is up, got cameras whose tops point {np.degrees(np.arccos(np.clip(up, -1.0, 1.0))):.0f} degrees away from it: "
            "its world probably has y up; turn it, or give --up cameras"
        )


def _ground(model: Model, options: MetricOptions, known: Array | None) -> Ground | None:
    up = None if known is None else known[2]
    ground = None if options.up == "cameras" else find_ground(model.poses, model.points, up=up)
    if ground is None and options.up == "ground":
        raise ImportRecordingError(
            "expected a ground plane among the points below the cameras, found none; take photographs that show more of the ground, "
            "or give --up cameras"
        )
    return ground


def _rescaled(scale: float, own: OwnScale) -> str:
    """What an option changes in the metres of a scan that has them; empty for no change, or no metres."""
    factor = scale / own.scale
    if own.source is None or factor == 1.0:
        return ""
    if not 1.0 / _MOST_RESCALED <= factor <= _MOST_RESCALED:
        raise ImportRecordingError(
            f"expected a length that the scan agrees with, as it is in metres ({own.why}), got one that makes it {factor:.3g} times as large; "
            "correct --length, --positions or --marker, or leave it out"
        )
    return f"; this makes the scan, which is in metres, {factor:.4g} times as large"


def _at_positions(
    model: Model, file: Path, ground: Ground | None, own: OwnScale
) -> tuple[Similarity, dict[str, Any]]:
    positions = _read_positions(file)
    fit = fit_known_positions(model, positions, ground)
    not_used = f"; {fit.not_used}" if fit.not_used else ""
    said = (
        f"metric: known positions of {fit.images} images ({len(positions)} in the file{not_used}), rms {fit.rms_m:.3g} m, "
        f"worst {fit.worst_m:.3g} m ({fit.worst})"
    ) + _rescaled(fit.similarity.scale, own)
    up = "that of the known positions"
    if fit.on_line:
        up = (
            "the cameras' up"
            if ground is None
            else f"normal of the ground, a plane of {ground.points} points"
        )
    return fit.similarity, _facts(said, "positions", up, ground_at_zero=False)


def _facts(scale: str, scale_from: str | None, up: str, ground_at_zero: bool) -> dict[str, Any]:
    return {"scale": scale, "scale_from": scale_from, "up": up, "ground_at_zero": ground_at_zero}


def _read_positions(file: Path) -> dict[str, Array]:
    positions: dict[str, Array] = {}
    for row in read_csv(file, ("image", "x_m", "y_m", "z_m")):
        name = row.values["image"].strip()
        if name in positions:
            raise ConfigError(
                f"{row.place}: image: expected each image once, got {name} again; remove one row"
            )
        positions[name] = np.array([row.number(column) for column in ("x_m", "y_m", "z_m")])
    # The data set takes over their world, and would be refused when it is read.
    if positions and (wrong := far_from_origin(np.stack(list(positions.values())))) is not None:
        raise ConfigError(f"{file}: {list(positions)[wrong[0]]}: {wrong[1]}")
    return positions


def undistorted_views(model: Model, folder: Path) -> Iterator[View]:
    """Undistorted images of a model, whose names are relative to a folder, with pinhole and pose."""
    for image in model.images:
        pixels, pinhole = read_stored(folder / image.name)[0], image.pinhole
        if not image.lens.is_ideal:
            straight = straightening(image.pinhole, image.lens)
            pixels, pinhole = straight.apply(pixels), straight.pinhole
        yield pixels, pinhole, np.asarray(image.T_world_from_camera)
