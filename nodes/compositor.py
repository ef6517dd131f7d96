"""The compositor node: draws the attack into the live image at the pose of its face from motion capture.

Images and poses are joined by capture stamp. An image waits a limited time for later poses. After that, poses are extrapolated at
constant velocity up to a limit, which is flagged. Beyond the limit, the image is dropped and counted, and the safety and motor nodes
stop the car. Without an attack file, images pass through unchanged.

A new attack is received in pieces over the bus. It replaces the current one between two images, once it is complete, verified, and
fits camera and face. If it is refused, the reason is in the status and the current attack stays.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.projection import FaceOverlay
from advnerf_core.geometry import Array, invert_transform
from advnerf_core.strict import StrictModel
from calibration.panel import target_size
from calibration.placement import require_same_corners
from calibration.schema import CameraCalibration, TargetCalibration, load_calibration
from nodes.control.attack_receiver import ATTACK_FILE, AttackReceiver
from nodes.control.interlock import ATTACK_SWITCH, SAFETY_STATE, AttackSwitch, Interlock
from nodes.control.pose_buffer import PoseBuffer
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, MessageError
from nodes.runtime.messages import finite_pose, header, image_message, stamp_ns, types
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.pictures import rgb8_message, rgb_image
from nodes.runtime.process import run_node_main

_CAR = "/vicon/car"
_ACTIVE_S = 1.0
_SIZE_TOLERANCE = 0.05
_OUT_OF_VIEW, _TURNED_AWAY = "out of view", "turned away: the camera sees the back of the face"


class CompositorConfig(StrictModel):
    """Configuration of the compositor node.

    Attributes:
        attack: Attack file to draw; empty for none.
        camera: Camera calibration file.
        target: Calibration file of the face that shows the attack.
        image_topic: Topic of the images; ``/camera/image_raw/compressed`` over a wireless link.
        wait_s: Longest time that an image waits for poses [s].
        extrapolation_limit_s: Longest time over which poses are then extrapolated at constant velocity [s].
        max_gap_s: Longest gap in a pose stream that is interpolated [s].
        supersample: Samples along each side of a pixel.
        interlock: Draw the attack only while the safety node reports that the car is armed, so inside the fence with fresh poses.
    """

    attack: Path | None = None
    camera: Path
    target: Path
    image_topic: Literal["/camera/image_raw", "/camera/image_raw/compressed"] = "/camera/image_raw"
    wait_s: float = Field(default=0.025, ge=0.0, le=0.1)
    extrapolation_limit_s: float = Field(default=0.05, ge=0.0, le=0.2)
    max_gap_s: float = Field(default=0.1, gt=0.0, le=0.5)
    supersample: int = Field(default=2, ge=1, le=4)
    interlock: bool = False

    @field_validator("attack", mode="before")
    @classmethod
    def _empty_is_none(cls, value: Any) -> Any:
        return None if value == "" else value


@dataclass(frozen=True, eq=False)
class Showing:
    """The attack to draw, prepared for a camera."""

    attack_id: str
    overlay: FaceOverlay
    T_car_from_camera: Array


@dataclass(frozen=True, eq=False)
class _Waiting:
    message: Any
    stamp_ns: int
    deadline_mono_ns: int


class CompositorNode(Node):
    """Joins images with poses and draws the face. See the module's docstring.

    Args:
        attack: The attack to draw; None passes images through.
    """

    publications = ("/compositor/image", "/compositor/attack")
    tick_rate_hz = 100.0

    def __init__(
        self,
        config: CompositorConfig,
        camera: CameraCalibration,
        target: TargetCalibration,
        attack: AttackFile | None = None,
    ) -> None:
        prepare = partial(show, camera=camera, target=target, supersample=config.supersample)
        self._interlock, self._switch = Interlock() if config.interlock else None, AttackSwitch()
        self._image_topic = config.image_topic
        self._showing = None if attack is None else prepare(attack)
        self._received = AttackReceiver(prepare)
        self._takeover_ms = 0.0
        self._wait_ns = round(config.wait_s * NS_PER_S)
        self._limit_s = config.extrapolation_limit_s
        self._face_topic = f"/vicon/{target.subject}"
        interlock = (SAFETY_STATE,) * config.interlock
        self.subscriptions = (
            self._image_topic, _CAR, self._face_topic, ATTACK_FILE, *interlock, ATTACK_SWITCH,
        )  # fmt: skip
        self._poses = {topic: PoseBuffer(max_gap_s=config.max_gap_s) for topic in (_CAR, self._face_topic)}
        self._waiting: _Waiting | None = None
        self._counts = dict.fromkeys(
            ("images", "drawn", "extrapolated", "dropped_no_pose", "dropped_bad", "bad_poses"), 0
        )
        self._size = (camera.width, camera.height)
        self._last_image_ns: int | None = None
        self._now_ns = 0
        self._trouble = ""

    @classmethod
    def build(cls, config: CompositorConfig, context: NodeContext) -> CompositorNode:
        """Build the node."""
        camera = load_calibration(CameraCalibration, config.camera)
        target = load_calibration(TargetCalibration, config.target)
        return cls(config, camera, target, None if config.attack is None else load_attack(config.attack))

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Handle an image, a pose, a piece of an attack, the operator's switch, or the state of the safety node."""
        self._now_ns = now.mono_ns
        if topic == ATTACK_FILE:
            return self._take_piece(message, info)
        if topic == SAFETY_STATE and self._interlock is not None:
            self._interlock.heard(message, info)
            return []
        if topic == ATTACK_SWITCH:
            self._switch.heard(message, now.real_ns)
            return []
        if topic != self._image_topic:
            return self._take_pose(topic, message, now)
        self._last_image_ns = now.mono_ns
        self._counts["images"] += 1
        try:
            image = rgb8_message(message, topic)
        except MessageError as error:
            self._counts["dropped_bad"] += 1
            self._trouble = f"image dropped: {error}"
            return []
        refusal = self._switch.refusal() or (self._interlock.refusal(now.mono_ns) if self._interlock else "")
        # An older image that still waits is published with the current poses, so that only one image waits.
        before = self._finish() if self._waiting else []
        if self._showing is None or refusal:
            self._trouble = refusal
            # A raw image is forwarded as the received bytes.
            out = (info.raw or message) if image is message else image
            return [
                *before,
                Out("/compositor/image", out),
                self._label(image, False, refusal or "no attack file"),
            ]
        if (image.width, image.height) != self._size:
            self._counts["dropped_bad"] += 1
            self._trouble = f"image dropped: expected {self._size[0]} x {self._size[1]}, as calibrated, got {image.width} x {image.height}"
            return before
        self._waiting = _Waiting(image, stamp_ns(image), now.mono_ns + self._wait_ns)
        return before + self._release(now)

    def tick(self, now: Now) -> list[Out]:
        """Publish a waiting image when its waiting time is over."""
        self._now_ns = now.mono_ns
        return self._release(now)

    def status(self) -> tuple[str, str]:
        """Report active while images arrive."""
        shown = (
            f"attack {self._showing.attack_id}" if self._showing else "no attack file, images pass through"
        )
        if self._last_image_ns is None or self._now_ns - self._last_image_ns > _ACTIVE_S * NS_PER_S:
            return READY, "; ".join(filter(None, (f"waiting for images; {shown}", self._received.trouble)))
        return ACTIVE, "; ".join(filter(None, (shown, self._trouble, self._received.trouble)))

    def counters(self) -> dict[str, float]:
        """Report images received, drawn on, drawn with extrapolated poses, and dropped; attacks accepted and refused."""
        counts = {key: float(value) for key, value in self._counts.items()}
        taken, refused = float(self._received.taken), float(self._received.refused)
        return counts | {"attacks_taken": taken, "attacks_refused": refused, "takeover_ms": self._takeover_ms}

    def _take_piece(self, chunk: Any, info: MessageInfo) -> list[Out]:
        """Handle a piece of a new attack. After the last piece, a valid attack replaces the current one."""
        # This clock only measures the reported duration. No decision depends on it, so replays stay deterministic.
        start = time.perf_counter()
        showing = self._received.heard(chunk, info)
        if showing is None:
            return []
        # A waiting image was captured before the change, so it gets the old attack.
        before = self._finish() if self._waiting else []
        self._showing = showing
        self._takeover_ms = 1e3 * (time.perf_counter() - start)
        return before

    def _take_pose(self, topic: str, message: Any, now: Now) -> list[Out]:
        """Note a pose. One that is none is as good as a lost one: the image is dropped, not passed on as if the face were out of view."""
        if (T := finite_pose(message)) is None:
            self._counts["bad_poses"] += 1
            return []
        self._poses[topic].add(stamp_ns(message), T)
        return self._release(now)

    def _release(self, now: Now) -> list[Out]:
        waiting = self._waiting
        if waiting is None:
            return []
        complete = all(poses.reaches(waiting.stamp_ns) for poses in self._poses.values())
        return self._finish() if complete or now.mono_ns >= waiting.deadline_mono_ns else []

    def _finish(self) -> list[Out]:
        waiting, self._waiting = self._waiting, None
        assert waiting is not None
        assert self._showing is not None
        car = self._poses[_CAR].at(waiting.stamp_ns, self._limit_s)
        face = self._poses[self._face_topic].at(waiting.stamp_ns, self._limit_s)
        if car is None or face is None:
            missing = _CAR if car is None else self._face_topic
            self._counts["dropped_no_pose"] += 1
            self._trouble = f"image dropped: no pose on {missing} at its stamp"
            return []
        T_camera_from_face = invert_transform(car.T @ self._showing.T_car_from_camera) @ face.T
        # The received array is read-only; the overlay draws on a copy.
        seen, overlay = rgb_image(waiting.message, self._image_topic), self._showing.overlay
        image, drawn = overlay.draw(seen, T_camera_from_face)
        ahead_s = max(car.extrapolated_s, face.extrapolated_s)
        self._counts["drawn"] += drawn
        self._counts["extrapolated"] += ahead_s > 0.0
        if not drawn:
            self._trouble = _TURNED_AWAY if overlay.shows_back(seen, T_camera_from_face) else _OUT_OF_VIEW
        else:
            self._trouble = f"pose extrapolated by {1e3 * ahead_s:.0f} ms" if ahead_s > 0.0 else ""
        frame = waiting.message.header.frame_id
        out = waiting.message if not drawn else image_message(image, waiting.stamp_ns, frame)
        return [Out("/compositor/image", out), self._label(waiting.message, drawn, self._trouble)]

    def _label(self, image: Any, drawn: bool, reason: str) -> Out:
        attack_id = self._showing.attack_id if self._showing else ""
        head = header(stamp_ns(image), image.header.frame_id)
        label = types.AttackStamp(header=head, attack_id=attack_id, drawn=bool(drawn), reason=reason)
        return Out("/compositor/attack", label)


def show(
    attack: AttackFile, camera: CameraCalibration, target: TargetCalibration, supersample: int = 2
) -> Showing:
    """Prepare an attack for a camera and a face. An attack without a face, or for a face of another size or subject, or turned, is refused.

    The camera may have another size than the attack's, which is that of the images its policy saw.
    """
    face, size_m = attack.required_face(), target_size(target)
    same_subject = face.subject == target.subject
    if same_subject:
        require_same_corners(attack, target)
    wrong_size = any(
        abs(got / want - 1.0) > _SIZE_TOLERANCE for got, want in zip(size_m, face.size_m, strict=True)
    )
    if wrong_size or not same_subject:
        raise ConfigError(
            f"attack {attack.attack_id} was made for {face.subject}, {face.size_m[0]:.2f} x {face.size_m[1]:.2f} m, but the "
            f"target is {target.subject}, {size_m[0]:.2f} x {size_m[1]:.2f} m; name the target it was made for"
        )
    overlay = FaceOverlay(face.texture, target.corners, camera.pinhole, camera.distortion, supersample)
    return Showing(attack.attack_id, overlay, camera.mount)


if __name__ == "__main__":
    raise SystemExit(run_node_main(CompositorConfig, CompositorNode.build))
