"""Compares the pose of the board or monitor with its attack's, and says how to move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from advnerf_core.attack.artifact import AttackFile
from advnerf_core.geometry import Array, invert_transform, make_transform, yaw_of
from calibration.schema import CalibrationError, TargetCalibration


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
