"""The policy node: computes a drive command from the newest image, stamped with that image's capture time.

Images that were captured or published too long ago are dropped and counted, so that the safety and motor nodes notice that commands
have stopped. The first inferences of a process are slow, so they run on a blank image before the node reports ready. Any policy that
follows docs/policies.md can drive; a policy in an ONNX file does not need torch.
"""

from __future__ import annotations

import time
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from advnerf_core.policies.driver import Driver, require_goal
from advnerf_core.policies.load import load_driver
from advnerf_core.strict import StrictModel
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, MessageError
from nodes.runtime.messages import drive_message, stamp_ns
from nodes.runtime.node import ACTIVE, FAULT, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.pictures import rgb_image
from nodes.runtime.process import run_node_main

_DRIVE = "/policy/drive"
_WARM_UP_RUNS = 5
_ACTIVE_S = 1.0
# A policy with memory forgets it when no image came for so long: what it remembers is no longer where the car is.
_MEMORY_GAP_S = 1.0
# Largest accepted lead of the camera's clock over the local clock.
_CLOCK_TOLERANCE_S = 0.02


class PolicyNodeConfig(StrictModel):
    """Configuration of the policy node.

    Attributes:
        policy: Policy file (.safetensors, .onnx, .pt2), or ``package.module:factory``.
        sha256: Expected hash of the policy; empty accepts any.
        image_topic: Topic of the images, raw or compressed.
        speed_mps: Speed of the commands [m/s].
        planned_speed: Drive at the speed that the policy's waypoints imply, at most ``speed_mps``. Predictions assume a constant speed.
        max_age_s: Largest age of an image since capture and since publication [s].
        recorded: The images are those of a recording, so that their capture may be long ago: only the age since publication counts. The safety node
            does not drive by such commands, because of their stamps.
        goal: Goal vector of a goal-conditioned policy.
    """

    policy: str = Field(min_length=1)
    sha256: str = ""
    image_topic: str = "/compositor/image"
    speed_mps: float = Field(default=0.8, ge=0.0, le=2.0)
    planned_speed: bool = False
    max_age_s: float = Field(default=0.15, gt=0.0, le=0.5)
    recorded: bool = False
    goal: tuple[float, ...] = ()


class PolicyNode(Node):
    """Turns images into drive commands."""

    publications = (_DRIVE,)
    tick_rate_hz = 10.0

    def __init__(self, config: PolicyNodeConfig, driver: Driver) -> None:
        require_goal(config.goal, driver.goal_size, "set 'goal'")
        if config.planned_speed and driver.contract.trajectory is None:
            raise ConfigError(
                "expected a policy that answers with waypoints for planned_speed, got one that steers; leave planned_speed out"
            )
        self.subscriptions = (config.image_topic,)
        self._config, self._driver = config, driver
        self._max_age_ns = round(config.max_age_s * NS_PER_S)
        self._counts = {"images": 0, "dropped_stale": 0, "dropped_bad": 0}
        self._inference_ms = 0.0
        self._last_drive_ns: int | None = None
        self._now_ns = 0
        self._trouble = ""
        self._fault = False
        self._warm_up()

    @classmethod
    def build(cls, config: PolicyNodeConfig, context: NodeContext) -> PolicyNode:
        """Build the node: load, check and warm up the policy."""
        # One thread: with one image at a time, more would take cores from the other nodes and add wake-up delays.
        cv2.setNumThreads(1)
        return cls(config, load_driver(config.policy, config.sha256 or None))

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Compute a command from an image, unless the image is too old or does not fit the policy."""
        self._now_ns = now.mono_ns
        self._counts["images"] += 1
        capture_ns = stamp_ns(message)
        captured_age_ns = 0 if self._config.recorded else now.real_ns - capture_ns
        published_age_ns = now.mono_ns - info.publish_mono_ns
        if max(captured_age_ns, published_age_ns) > self._max_age_ns:
            self._drop("dropped_stale", f"image is {max(captured_age_ns, published_age_ns) / 1e6:.0f} ms old")
            return []
        if captured_age_ns < -_CLOCK_TOLERANCE_S * NS_PER_S:
            self._drop(
                "dropped_bad",
                "the image's stamp is in the future; synchronise the clocks of camera and policy computer",
            )
            return []
        try:
            rgb = rgb_image(message, topic)
        except MessageError as error:
            self._drop("dropped_bad", str(error))
            return []
        camera = self._driver.view.camera
        if rgb.shape[:2] != (camera.height, camera.width):
            got = f"{rgb.shape[1]} x {rgb.shape[0]}"
            self._drop(
                "dropped_bad",
                f"expected images of {camera.width} x {camera.height}, got {got}; train for this camera",
            )
            return []
        if self._last_drive_ns is not None and now.mono_ns - self._last_drive_ns > _MEMORY_GAP_S * NS_PER_S:
            self._driver.reset()
        steering_rad, speed_mps = self._command(rgb)
        if not np.isfinite([steering_rad, speed_mps]).all():
            self._drop("dropped_bad", "the policy's output is not finite")
            return []
        self._trouble, self._fault = "", False
        self._last_drive_ns = now.mono_ns
        return [Out(_DRIVE, drive_message(speed_mps, steering_rad, capture_ns))]

    def tick(self, now: Now) -> list[Out]:
        """Note the time, so that the status shows when images stop."""
        self._now_ns = now.mono_ns
        return []

    def status(self) -> tuple[str, str]:
        """Report active while sending commands; fault if images arrive that it cannot use."""
        name = f"policy {self._driver.sha256[:12]}"
        if self._trouble:
            return (FAULT if self._fault else READY), self._trouble
        recent = self._last_drive_ns is not None and self._now_ns - self._last_drive_ns < _ACTIVE_S * NS_PER_S
        return (ACTIVE, name) if recent else (READY, f"{name}, waiting for images")

    def counters(self) -> dict[str, float]:
        """Report used and dropped images, and the duration of the last inference [ms]."""
        return {**self._counts, "inference_ms": self._inference_ms}

    def _command(self, rgb: NDArray[np.uint8]) -> tuple[float, float]:
        """Steering [rad] and speed [m/s]."""
        # This clock only measures the reported duration. No decision depends on it, so replays stay deterministic.
        start = time.perf_counter()
        steering_rad, planned_mps = self._driver.command(self._driver.view.image(rgb), self._config.goal)
        self._inference_ms = 1e3 * (time.perf_counter() - start)
        if planned_mps is None or not self._config.planned_speed:
            return steering_rad, self._config.speed_mps
        return steering_rad, float(np.minimum(planned_mps, self._config.speed_mps))  # NaN stays

    def _warm_up(self) -> None:
        camera = self._driver.view.camera
        for _ in range(_WARM_UP_RUNS):
            self._command(np.zeros((camera.height, camera.width, 3), np.uint8))
        self._driver.reset()

    def _drop(self, counter: str, trouble: str) -> None:
        self._counts[counter] += 1
        self._trouble, self._fault = trouble, counter == "dropped_bad"


if __name__ == "__main__":
    raise SystemExit(run_node_main(PolicyNodeConfig, PolicyNode.build))
