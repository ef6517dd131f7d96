"""What a log allows: learning a policy, learning a scene, evaluating a policy; and if not, why not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.logs.drive_log import DriveLog
from nodes.lab.policy_data.frames import HOLDOUT_EVERY, LEAST_FRAMES

_LOOKED_AT = 32
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
        has_camera: Whether the calibration of the camera is attached.
    """

    log: DriveLog
    size: tuple[int, int]
    steering: NDArray[np.float64]
    missing: int
    same_image: bool
    has_camera: bool

    def verdicts(self) -> list[Verdict]:
        """What the log allows."""
        return [self._policy(), self._scene(), self._evaluation()]

    def _unusable_steering(self) -> str:
        """Why the recorded steering teaches nothing; empty if it does."""
        log = self.log
        if log.unit is None:
            return f"no steering found; name it with --steering: {', '.join(log.controls) or 'the log has no numbers'}"
        if not len(self.steering):
            return f"{log.unit.name} has no value"
        if float(self.steering.std()) < _STEADY:
            return f"the steering is always {self.steering[0]:.3g}"
        return f"give {log.unit.unknown}" if log.unit.unknown else ""

    def _unusable_images(self) -> str:
        if self.log.count < LEAST_FRAMES:
            return f"{self.log.count} images are too few"
        return "the images are all the same" if self.same_image else ""

    def _policy(self) -> Verdict:
        log = self.log
        by_expert = "labels by the expert at the poses" if log.poses and log.labels == "expert" else ""
        why = self._unusable_images() or ("" if by_expert else self._unusable_steering())
        if why:
            return Verdict("learn a policy", False, why)
        few = f"; {log.count} images are few, expect a weak policy" if log.count < _FEW_IMAGES else ""
        recorded = "labels are the recorded steering"
        if not by_expert and log.labels == "expert":
            recorded += " (--labels recorded): no poses for the expert"
        return Verdict("learn a policy", True, (by_expert or recorded) + few)

    def _scene(self) -> Verdict:
        log = self.log
        if log.count < _LEAST_SCENE_IMAGES or self.same_image:
            return Verdict(
                "learn a scene", False, self._unusable_images() or f"{log.count} images are too few"
            )
        is_bag = log.format.startswith("bag")
        if is_bag and not log.poses:
            return Verdict("learn a scene", False, "no poses on /vicon/car")
        if is_bag:
            missing = "" if self.has_camera else ", with --calibration, as no camera.yaml is attached"
            return Verdict("learn a scene", True, f"advnerf scene from-bag{missing}")
        how = "scene from-images or from-video estimates the poses of the camera"
        return Verdict(
            "learn a scene", True, how + (", or from-bag with the exported bag" if log.poses else "")
        )

    def _evaluation(self) -> Verdict:
        if why := self._unusable_images() or self._unusable_steering():
            return Verdict("evaluate a policy", False, why)
        blocks = self.log.count // (16 * HOLDOUT_EVERY)
        part = "" if blocks else "; too short for --held-out"
        return Verdict("evaluate a policy", True, f"against the recorded steering{part}")


def read_facts(log: DriveLog) -> LogFacts:
    """Read the controls and the first images of a log.

    Raises:
        AdvnerfError: One of the first images is missing or damaged.
    """
    images = [frame.image for frame in islice(log.frames(), _LOOKED_AT)]
    values = log.steering()
    known = values[np.isfinite(values)]
    height, width = images[0].shape[:2] if images else (0, 0)
    same = len(images) > 1 and all(np.array_equal(images[0], other) for other in images[1:])
    return LogFacts(
        log, (width, height), known, len(values) - len(known), same, "camera.yaml" in log.attached()
    )
