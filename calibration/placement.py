"""Compares the corners and the pose of the board or monitor with its attack's, and says how to correct or move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from advnerf_core.attack.artifact import AttackFace, AttackFile
from advnerf_core.geometry import Array, invert_transform, make_transform, wrap_angle, yaw_of
from calibration.schema import CORNERS, CalibrationError, TargetCalibration

# Of the corners of one face in one frame: a wand's error is smaller, another corner or a redefined subject further off.
_SAME_DIRECTION_RAD = float(np.deg2rad(10.0))
_SAME_MIDDLE = 0.05  # of the diagonal


@dataclass(frozen=True)
class Misplacement:
    """Displacement of a face from its target pose, as seen from the front.

    Attributes:
        right_m: Too far right [m].
        up_m: Too high [m].
        near_m: Too far out, towards the viewer [m].
        turned_rad: Turned about the vertical, counter-clockwise from above [rad].
        tilted_rad: Leaning back, its top away from the viewer [rad].
        rolled_rad: Turned in its own plane, clockwise for the viewer [rad].
    """

    right_m: float
    up_m: float
    near_m: float
    turned_rad: float
    tilted_rad: float
    rolled_rad: float

    @property
    def distance_m(self) -> float:
        """Distance to its place [m]."""
        return float(np.sqrt(self.right_m**2 + self.up_m**2 + self.near_m**2))

    @property
    def angle_rad(self) -> float:
        """Greatest of the angles [rad]."""
        return max(abs(self.turned_rad), abs(self.tilted_rad), abs(self.rolled_rad))

    def within(self, tolerance_m: float, tolerance_rad: float) -> bool:
        """Whether the displacement is within the limits."""
        return self.distance_m <= tolerance_m and self.angle_rad <= tolerance_rad

    def advice(self) -> list[tuple[str, str]]:
        """Instructions, one for each direction: the quantity, and how to move."""
        ways = (
            ("left / right", 100 * self.right_m, "cm", ("left", "right")),
            ("height", 100 * self.up_m, "cm", ("down", "up")),
            ("distance", 100 * self.near_m, "cm", ("away from you", "towards you")),
            (
                "turn",
                np.rad2deg(self.turned_rad),
                "deg",
                ("clockwise from above", "counter-clockwise from above"),
            ),
            ("tilt", np.rad2deg(self.tilted_rad), "deg", ("top towards you", "top away from you")),
            ("roll", np.rad2deg(self.rolled_rad), "deg", ("counter-clockwise", "clockwise")),
        )
        return [
            (name, f"{abs(off):.1f} {unit} {less if off > 0 else more}")
            for name, off, unit, (less, more) in ways
        ]


def face_frame(corners_m: Array) -> Array:
    """``T_frame_from_face`` ``[4, 4]`` of corners ``[4, 3]``: origin in the middle, x out of the face, z up for the viewer."""
    right = corners_m[1] - corners_m[0] + corners_m[2] - corners_m[3]
    right = right / np.linalg.norm(right)
    up = corners_m[0] - corners_m[3] + corners_m[1] - corners_m[2]
    up = up - (up @ right) * right
    up = up / np.linalg.norm(up)
    # The viewer's right is the face's y axis (its left is -y), so x = y cross z points at the viewer.
    return make_transform(np.stack([np.cross(right, up), right, up], axis=1), corners_m.mean(axis=0))


def require_same_corners(attack: AttackFile, target: TargetCalibration) -> None:
    """Raise for a target with the corners of the attack's face in another order, by which it would be shown turned or mirrored.

    A subject may have been redefined since the search, with another origin or other axes. Then its corners have another middle or lie in
    another plane, nothing is known of their order, and they are accepted.

    Raises:
        AttackFileError: The attack has no face.
        CalibrationError: Middle and plane are the same, but the directions differ by more than 10 degrees.
    """
    if got := _another_order(attack.required_face(), target):
        raise CalibrationError(
            f"expected corners_in_subject_m of target {target.subject} in the order {', '.join(CORNERS)}, as seen from the front, as in attack "
            f"{attack.attack_id}, got {got}; correct the target file, or search an attack for it if the subject was redefined"
        )


def _another_order(face: AttackFace, target: TargetCalibration) -> str:
    """How the corners of a target contradict those of an attack's face; empty if they do not."""
    off = invert_transform(face_frame(face.corners_in_subject)) @ face_frame(target.corners)
    diagonal_m = np.linalg.norm(face.corners_in_subject[2] - face.corners_in_subject[0])
    outward, rolled_rad = off[0, 0], np.arctan2(off[2, 1], off[1, 1])
    if np.linalg.norm(off[:3, 3]) > _SAME_MIDDLE * diagonal_m or abs(outward) < np.cos(_SAME_DIRECTION_RAD):
        return ""
    if outward < 0.0:
        return "them mirrored: they go the other way round"
    if abs(rolled_rad) <= _SAME_DIRECTION_RAD:
        return ""
    later = round(-rolled_rad / (0.5 * np.pi)) % 4
    if abs(wrap_angle(rolled_rad + later * 0.5 * np.pi)) > _SAME_DIRECTION_RAD:
        return f"a face turned by {abs(np.rad2deg(rolled_rad)):.0f} degrees in its plane"
    turned = "upside down" if later == 2 else "on its side"
    return f"a face {turned}: they begin {later} corner{'s' * (later > 1)} later, at the {CORNERS[later]} one"


def misplacement(attack: AttackFile, target: TargetCalibration, T_world_from_subject: Array) -> Misplacement:
    """Compare the pose of a face with the pose of its attack.

    Args:
        attack: The attack; its object's frame is the face's.
        target: Corners of the board or monitor, in the subject's frame; for a monitor the whole panel.
        T_world_from_subject: Current pose of the subject ``[4, 4]``.

    Raises:
        CalibrationError: The attack belongs to another subject.
    """
    if attack.face is None or attack.face.subject != target.subject:
        subject = "nothing that can be shown" if attack.face is None else attack.face.subject
        raise CalibrationError(f"attack {attack.attack_id} is for {subject}, the target is {target.subject}")
    # As computed: the object's own frame has the face's axes, and its corners say nothing about the world.
    now = T_world_from_subject @ face_frame(target.corners)
    off = invert_transform(np.asarray(attack.face_object.T_world_from_object)) @ now
    x_axis, z_axis = off[:3, 0], off[:3, 2]
    return Misplacement(
        right_m=float(off[1, 3]),
        up_m=float(off[2, 3]),
        near_m=float(off[0, 3]),
        turned_rad=float(np.arctan2(x_axis[1], x_axis[0])),
        tilted_rad=float(np.arctan2(-z_axis[0], z_axis[2])),
        rolled_rad=float(np.arctan2(z_axis[1], z_axis[2])),
    )


def measured_pose(target: TargetCalibration, T_world_from_subject: Array) -> dict[str, float]:
    """Current pose of the face, in an attack request's form: x, y, z [m] and yaw [rad]."""
    now = T_world_from_subject @ face_frame(target.corners)
    x, y, z = (round(float(value), 4) for value in now[:3, 3])
    return {"x_m": x, "y_m": y, "z_m": z, "yaw_rad": round(float(yaw_of(now)), 4)}
