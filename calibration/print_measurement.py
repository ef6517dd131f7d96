"""The result of measuring a print: what the photograph or drive determines, and what it does not, as JSON data and as text."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from advnerf_core.geometry import Array
from advnerf_core.plain import Numbers, PlainData
from calibration.print_colour import ColourError
from calibration.print_drive import PlacedPrint
from calibration.print_pose import PrintPose

CARD, DISTANCE, WIDTH, POSES = "a card", "the distance", "the width", "the camera's poses"
# Beyond what a hand that holds the camera tilts it; and a print that faces up or down has no upright.
_UPRIGHT_DEG, _LEAST_UPRIGHT = 10.0, 0.5
# No printer is off by more, but a length in another unit is; and no shade covers so much of a print that was found.
_LARGEST_OFF, _OTHER_SHARE = 0.3, 0.5
# A marker stands out by this multiple of the others' median distance, and by more than cutting and gluing with care.
_STANDS_OUT, _LEAST_OFF_MM = 4.0, 2.0
_NO_PLACE = (
    "unknown: give the camera file of the car, --car X,Y,YAW, and the size with --card, --distance or --width"
)
_NO_SIZE = "unknown: one photograph gives the pose in units of the nominal size; give --card, --distance or --width, or a bag with the car's poses"


@dataclass(frozen=True, eq=False)
class PrintMeasurement(PlainData):
    """A measured print.

    Attributes:
        source: Name of the photograph or bag.
        nominal_m: Nominal width and height of the picture [m].
        size_m: True width and height of the picture [m]; None where the size is unknown.
        size_sd: Standard deviation of the size, as a share of it.
        size_from: Source of the size; empty if unknown.
        T_camera_from_face: Pose ``[4, 4]`` before the camera of a photograph [m]; in nominal metres where the size is unknown. None of a bag.
        T_world_from_face: Pose ``[4, 4]`` in the world; None if unknown.
        angle_sd_deg: Standard deviation of the direction that it faces [deg].
        view_angle_deg: Angle at which a photograph shows it; 0 from straight ahead. None of a bag.
        markers_seen: Numbers of the markers that were used.
        markers_dropped: Numbers of those that do not lie where the others put them.
        markers_off_mm: Distance of each marker that was found from its place in the print's plane, by number [mm].
        markers_printed: Number of markers on the print.
        markers_outside: Number of markers that lie outside a photograph.
        residual_px: Root mean square distance of the corners from where a flat print has them [px].
        residual_mm: The same in the print's plane [mm].
        flatness_mm: Root mean square distance of the markers from their plane [mm]; of a photograph, as far as it shows a bend.
        flatness_sd_mm: Standard deviation of the flatness [mm].
        colours: Colours of the print; None if unknown.
        colours_unknown: The reason for that.
    """

    source: str
    nominal_m: tuple[float, float]
    size_m: tuple[float, float] | None
    size_sd: float
    size_from: str
    T_camera_from_face: Numbers | None
    T_world_from_face: Numbers | None
    angle_sd_deg: float
    view_angle_deg: float | None
    markers_seen: tuple[int, ...]
    markers_dropped: tuple[int, ...]
    markers_off_mm: Mapping[int, float]
    markers_printed: int
    residual_px: float
    residual_mm: float
    flatness_mm: float
    flatness_sd_mm: float
    markers_outside: int = 0
    colours: ColourError | None = None
    colours_unknown: str = ""

    @property
    def scale(self) -> float:
        """True size over nominal size; 1 if unknown."""
        if self.size_m is None:
            return 1.0
        return float(np.sqrt(self.size_m[0] * self.size_m[1] / (self.nominal_m[0] * self.nominal_m[1])))

    @property
    def turned_deg(self) -> float | None:
        """Clockwise turn in its own plane [deg], against the vertical of the world if that is known, else of the photograph; None if it lies."""
        if self.T_world_from_face is not None:
            up, right = np.asarray(self.T_world_from_face)[2, [2, 1]]
        else:
            up, right = -np.asarray(self.T_camera_from_face)[1, [2, 1]]
        return float(np.degrees(np.arctan2(-right, up))) if np.hypot(up, right) > _LEAST_UPRIGHT else None

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Quantities and their values as text."""
        rows = [("markers", self._markers()), ("size", self._size())]
        if self.T_camera_from_face is not None:
            x, y, z = np.asarray(self.T_camera_from_face)[:3, 3]
            unit = "m" if self.size_m else "nominal m"
            rows.append(
                (
                    "before the camera",
                    f"x {x:.3f}, y {y:.3f}, z {z:.3f} {unit}, seen at {self.view_angle_deg:.1f} degrees",
                )
            )
        if self.T_world_from_face is not None:
            T = np.asarray(self.T_world_from_face)
            yaw_deg, up_deg = np.degrees(
                [np.arctan2(T[1, 0], T[0, 0]), np.arcsin(np.clip(T[2, 0], -1.0, 1.0))]
            )
            rows.append(
                (
                    "in the world",
                    f"x {T[0, 3]:.3f}, y {T[1, 3]:.3f}, z {T[2, 3]:.3f} m, faces {yaw_deg:.1f} degrees, {up_deg:+.1f} up",
                )
            )
        else:
            rows.append(("in the world", _NO_PLACE))
        if (turned := self._turned()) is not None:
            rows.append(("turned", turned))
        rows.append(("direction within", f"{self.angle_sd_deg:.2f} degrees (standard deviation)"))
        flat = f"{self.flatness_mm:.1f} mm from a plane (standard deviation {self.flatness_sd_mm:.1f} mm)"
        rows.append(("flatness", flat))
        rows.append(("fit", self._fit()))
        rows.append(("colours", self._colours()))
        return rows

    def _markers(self) -> str:
        text = f"{len(self.markers_seen)} of {self.markers_printed}"
        if self.markers_dropped:
            text += f"; left out, as they do not fit: {', '.join(map(str, self.markers_dropped))}"
        if self.markers_outside:
            text += f"; {self.markers_outside} outside the picture"
        missing = (
            self.markers_printed - len(self.markers_seen) - len(self.markers_dropped) - self.markers_outside
        )
        return f"{text}; {missing} not found, so the print may be covered there" if missing else text

    def _size(self) -> str:
        if self.size_m is None:
            return _NO_SIZE
        (width, height), (w, h) = self.size_m, self.nominal_m
        doubt = (
            ""
            if abs(np.log(self.scale)) < np.log1p(_LARGEST_OFF)
            else "; no printer is so far off: is that length right, and in m?"
        )
        return (
            f"{width:.4f} x {height:.4f} m ({100 * (width / w - 1):+.2f} % and {100 * (height / h - 1):+.2f} % of nominal), by {self.size_from}, "
            f"within {100 * self.size_sd:.2f} %{doubt}"
        )

    def _turned(self) -> str | None:
        """The turn of a print that does not hang upright; None if it does."""
        turned_deg = self.turned_deg
        if turned_deg is None or abs(turned_deg) < _UPRIGHT_DEG:
            return None
        way = "clockwise" if turned_deg > 0.0 else "anticlockwise"
        of = "" if self.T_world_from_face is not None else " of the photograph"
        return f"by {abs(turned_deg):.0f} degrees {way} against the horizontal{of}: not as it was searched, which is upright; hang it upright"

    def _fit(self) -> str:
        off_mm = self.markers_off_mm
        worst = max(off_mm, key=off_mm.__getitem__)
        others_mm = float(np.median([off for number, off in off_mm.items() if number != worst]))
        text = (
            f"corners within {self.residual_mm:.1f} mm of where that puts them; marker {worst} is the farthest off, by {off_mm[worst]:.1f} mm, "
            f"the others by {others_mm:.1f} mm (median)"
        )
        apart = off_mm[worst] > max(_STANDS_OUT * others_mm, _LEAST_OFF_MM)
        return f"{text}: is a part of the print glued off its place?" if apart else text

    def _colours(self) -> str:
        if self.colours is None:
            return f"unknown: {self.colours_unknown}"
        found = self.colours
        red, green, blue = found.mean
        text = f"{found.rms:.0f} of 255 from nominal (mean {red:+.0f}, {green:+.0f}, {blue:+.0f}), light uneven by {100 * found.uneven:.0f} %"
        if found.far_share > 0.02:
            why = (
                "covered, or colours that the printer has not?"
                if found.far_share < _OTHER_SHARE
                else "another texture in this frame, or the wrong --print or --attack?"
            )
            text += f"; {100 * found.far_share:.0f} % far off: {why}"
        hidden = 1.0 - found.seen_share
        return text + (
            f"; {100 * hidden:.0f} % outside the picture, taken from the nominal texture"
            if hidden > 0.0
            else ""
        )


def of_photograph(
    source: str,
    nominal_m: tuple[float, float],
    printed: int,
    pose: PrintPose,
    known: tuple[str, float, float] | None,
    T_world_from_camera: Array | None,
) -> PrintMeasurement:
    """The measurement of one photograph, without colours.

    Args:
        nominal_m: Nominal width and height of the picture [m].
        printed: Number of markers on the print.
        known: Source of the size, true over nominal size, and its standard deviation; None where nothing gives it.
        T_world_from_camera: Pose ``[4, 4]`` of the camera in the world; None if unknown.
    """
    size_from, scale, sd = known or ("", 1.0, 0.0)
    T = np.array(pose.T_camera_from_face)
    T[:3, 3] *= scale
    bend = np.sqrt(pose.aspect)
    size_m = (nominal_m[0] * scale * bend, nominal_m[1] * scale / bend) if known else None
    return PrintMeasurement(
        source=source,
        nominal_m=nominal_m,
        size_m=size_m,
        size_sd=sd,
        size_from=size_from,
        T_camera_from_face=T,
        T_world_from_face=None if T_world_from_camera is None or known is None else T_world_from_camera @ T,
        angle_sd_deg=float(np.degrees(pose.angle_sd_rad)),
        view_angle_deg=float(np.degrees(pose.view_angle_rad)),
        markers_seen=pose.seen,
        markers_dropped=pose.dropped,
        markers_off_mm={number: 1000.0 * scale * off for number, off in pose.off_m.items()},
        markers_printed=printed,
        residual_px=pose.rms_px,
        residual_mm=1000.0 * pose.rms_m * scale,
        flatness_mm=1000.0 * pose.bend_m * scale,
        flatness_sd_mm=1000.0 * pose.bend_sd_m * scale,
    )


def of_drive(
    source: str, nominal_m: tuple[float, float], printed: int, found: PlacedPrint, distance_px: float
) -> PrintMeasurement:
    """The measurement of a drive, without colours; ``distance_px`` is the mean distance over the focal length [m/px]."""
    return PrintMeasurement(
        source=source,
        nominal_m=nominal_m,
        size_m=(nominal_m[0] * found.scale, nominal_m[1] * found.scale),
        size_sd=found.scale_sd,
        size_from=f"{POSES} in {found.views} pictures",
        T_camera_from_face=None,
        T_world_from_face=found.T_world_from_face,
        angle_sd_deg=float(np.degrees(found.angle_sd_rad)),
        view_angle_deg=None,
        markers_seen=tuple(found.off_m),
        markers_dropped=(),
        markers_off_mm={number: 1000.0 * off for number, off in found.off_m.items()},
        markers_printed=printed,
        residual_px=found.rms_px,
        residual_mm=1000.0 * found.rms_px * distance_px,
        flatness_mm=1000.0 * found.flatness_m,
        flatness_sd_mm=1000.0 * found.flatness_sd_m,
    )
