"""What a log allows: learning a policy, learning a scene, evaluating a policy; and if not, why not."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import Rgb
from advnerf_core.data.logs.choice import LogError
from advnerf_core.data.logs.drive_log import DriveLog
from nodes.bags.images import CAMERA_TOPICS
from nodes.lab.policy_data.frames import HOLDOUT_EVERY, LEAST_FRAMES

_LOOKED_AT, _LOOKING_S = 32, 3.0
_FEW_IMAGES = 1000
_LEAST_SCENE_IMAGES = 20
_STEADY = 1e-3  # standard deviation, as a share of a steering of 1


@dataclass(frozen=True)
class Verdict:
    """Whether a log can be used for something, and why or how."""

    use: str
    possible: bool
    why: str


@dataclass(frozen=True, eq=False)
class LogFacts:
    """What was found in a log.

    Attributes:
        size: Width and height of the images [px].
        steering: Finite steering values in the log's unit.
        same_image: Whether the first images are all the same.
        looked_at: Images that were looked at.
        joined: Whether a steering value belongs to one of them.
        has_camera: Whether the calibration of the camera is attached.
        has_room: Whether the room file is attached.
        other_size: Where an image has another size than the first; empty if none has.
    """

    log: DriveLog
    size: tuple[int, int]
    steering: NDArray[np.float64]
    missing: int
    same_image: bool
    looked_at: int
    joined: bool
    has_camera: bool
    has_room: bool
    other_size: str

    def verdicts(self) -> list[Verdict]:
        """What the log allows."""
        return [self._policy(), self._scene(), self._evaluation()]

    def _unusable_steering(self) -> str:
        """Why the recorded steering teaches nothing; empty if it does."""
        log = self.log
        if log.unit is None:
            return f"no steering found; {log.steering_advice}"
        if not len(self.steering):
            return f"{log.unit.name} has no value"
        if float(self.steering.std()) < _STEADY:
            return f"the steering is always {self.steering[0]:.3g}"
        if log.unit.unknown:
            return f"give {log.unit.unknown}"
        try:  # as training will
            for value in (self.steering.min(), self.steering.max()):
                log.unit.wheel_rad(float(value), log.unit.name)
        except LogError as error:
            return str(error)
        return (
            ""
            if self.joined
            else f"no steering belongs to any of the first {self.looked_at} images: their times differ"
        )

    def _unusable_images(self) -> str:
        if self.log.count < LEAST_FRAMES:
            return f"{self.log.count} images are too few"
        return "the images are all the same" if self.same_image else ""

    def _policy(self) -> Verdict:
        log = self.log
        room = "" if self.has_room else ", with --room, as no room.yaml is attached"
        by_expert = f"labels by the expert at the poses{room}" if log.poses and log.labels == "expert" else ""
        why = self._unusable_images() or self.other_size or ("" if by_expert else self._unusable_steering())
        if why:
            return Verdict("learn a policy", False, why)
        few = f"; {log.count} images are few, expect a weak policy" if log.count < _FEW_IMAGES else ""
        return Verdict("learn a policy", True, (by_expert or "labels are the recorded steering") + few)

    def _scene(self) -> Verdict:
        log = self.log
        if log.count < _LEAST_SCENE_IMAGES or self.same_image:
            return Verdict(
                "learn a scene", False, self._unusable_images() or f"{log.count} images are too few"
            )
        is_bag = log.format.startswith("bag")
        if is_bag and not log.poses:
            return Verdict("learn a scene", False, "no poses on /vicon/car")
        if is_bag and log.images not in CAMERA_TOPICS:
            topics = " or ".join(CAMERA_TOPICS)
            return Verdict(
                "learn a scene", False, f"scene from-bag reads images on {topics}, these are on {log.images}"
            )
        if is_bag:
            missing = "" if self.has_camera else ", with --calibration, as no camera.yaml is attached"
            return Verdict("learn a scene", True, f"advnerf scene from-bag{missing}")
        how = "scene from-images estimates the poses of the camera"
        return Verdict(
            "learn a scene", True, how + (", or from-bag with the exported bag" if log.poses else "")
        )

    def _evaluation(self) -> Verdict:
        if why := self._unusable_images() or self.other_size or self._unusable_steering():
            return Verdict("evaluate a policy", False, why)
        blocks = self.log.count // (16 * HOLDOUT_EVERY)
        part = "" if blocks else "; too short for --held-out"
        return Verdict("evaluate a policy", True, f"against the recorded steering{part}")


def read_facts(log: DriveLog) -> LogFacts:
    """Read the controls and the images of a log, of a long one the first.

    Raises:
        AdvnerfError: One of these images is missing or damaged.
    """
    images, looked_at, joined, other_size = list[Rgb](), 0, False, ""
    ends_s = time.monotonic() + _LOOKING_S
    for frame in log.frames():
        looked_at += 1
        joined |= math.isfinite(frame.steering)
        if len(images) < _LOOKED_AT:
            images.append(frame.image)
        if not frame.unusable and frame.image.shape != images[0].shape:
            sizes = [f"{each.shape[1]} x {each.shape[0]}" for each in (images[0], frame.image)]
            other_size = (
                f"{frame.place}: expected images of one size, {sizes[0]}, got {sizes[1]}; remove this one"
            )
            break
        if len(images) == _LOOKED_AT and time.monotonic() > ends_s:
            break
    values = log.steering()
    known = values[np.isfinite(values)]
    height, width = images[0].shape[:2] if images else (0, 0)
    same = len(images) > 1 and all(np.array_equal(images[0], other) for other in images[1:])
    return LogFacts(
        log,
        (width, height),
        known,
        len(values) - len(known),
        same,
        looked_at,
        joined,
        "camera.yaml" in log.attached(),
        "room.yaml" in log.attached(),
        other_size,
    )
