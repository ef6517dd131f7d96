"""The counterfactual node: computes how the policy would steer at each image without the attack.

The camera's image and the compositor's image with the same stamp go through the same policy, and the difference is published. No node
that drives depends on this node, and its process runs at idle priority. If it cannot keep up, it skips images and counts them. The
path from camera to motor is unchanged.

An attack on a monitor has no clean image, because the camera itself sees the attack.
"""

from __future__ import annotations

import contextlib
import os
from collections import OrderedDict
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from advnerf_core.policies.driver import Driver, require_goal
from advnerf_core.policies.load import load_driver
from advnerf_core.strict import StrictModel
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import ConfigError, MessageError
from nodes.runtime.messages import header, stamp_ns, types
from nodes.runtime.node import ACTIVE, FAULT, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.pictures import rgb_image
from nodes.runtime.priority import HELPER, take_share
from nodes.runtime.process import run_node_main

COUNTERFACTUAL_TOPIC = "/policy/counterfactual"
_ATTACKED, _LABEL = "/compositor/image", "/compositor/attack"
_ACTIVE_S = 1.0
# As in the policy node.
_MEMORY_GAP_S = 1.0
_WARM_UP_RUNS = 3
# Largest number of incomplete pairs. The images of a pair arrive within the compositor's waiting time for poses.
_OPEN = 12
_QUEUE = 12


class CounterfactualConfig(StrictModel):
    """Configuration of the counterfactual node.

    Attributes:
        policy: The policy that drives, as configured in the policy node.
        sha256: Expected hash of the policy; empty accepts any.
        clean_topic: Topic of the compositor's input images.
        shown_by: Node that shows the attack. Only a compositor leaves a clean image for the comparison.
        goal: Goal vector of a goal-conditioned policy.
        max_age_s: Largest age of a pair since publication. Older pairs are skipped, so that a busy computer can catch up [s].
    """

    policy: str = Field(min_length=1)
    sha256: str = ""
    clean_topic: Literal["/camera/image_raw", "/camera/image_raw/compressed"] = "/camera/image_raw"
    shown_by: Literal["compositor", "monitor"] = "compositor"
    goal: tuple[float, ...] = ()
    max_age_s: float = Field(default=1.0, gt=0.0, le=10.0)

    @field_validator("shown_by")
    @classmethod
    def _leaves_a_clean_image(cls, shown_by: str) -> str:
        if shown_by == "monitor":
            raise ValueError(
                "expected an attack that a compositor draws; one on a monitor is in the camera's own image, so there is no clean "
                "image to compare with. Disable the counterfactual node (params.counterfactual=false)"
            )
        return shown_by


class CounterfactualNode(Node):
    """Joins both images by their stamp and runs the policy on each. See the module's docstring.

    Args:
        clean: The policy for the camera's images.
        attacked: A second instance of the same policy for the compositor's images, because a policy may have a state.
    """

    publications = (COUNTERFACTUAL_TOPIC,)
    tick_rate_hz = 5.0

    def __init__(self, config: CounterfactualConfig, clean: Driver, attacked: Driver) -> None:
        if clean.sha256 != attacked.sha256:
            raise ConfigError(
                f"expected the same policy twice, got {clean.sha256[:12]} and {attacked.sha256[:12]}"
            )
        require_goal(config.goal, clean.goal_size, "set 'goal'")
        self.subscriptions = (config.clean_topic, _ATTACKED, _LABEL)
        # A queue, because the two images and the label of a stamp arrive one after the other.
        self.queues = dict.fromkeys(self.subscriptions, _QUEUE)
        self._clean_topic = config.clean_topic
        self._clean, self._attacked, self._goal = clean, attacked, config.goal
        self._max_age_ns = round(config.max_age_s * NS_PER_S)
        self._open: OrderedDict[int, dict[str, Any]] = OrderedDict()
        self._counts = {"pairs": 0, "without_partner": 0, "dropped_late": 0, "dropped_bad": 0}
        self._largest_rad = 0.0
        self._last_ns: int | None = None
        self._now_ns = 0
        self._trouble = ""
        self._warm_up()

    @classmethod
    def build(cls, config: CounterfactualConfig, context: NodeContext) -> CounterfactualNode:
        """Build the node: load the policy twice, check it and warm it up."""
        cv2.setNumThreads(1)
        clean, attacked = (load_driver(config.policy, config.sha256 or None) for _ in range(2))
        return cls(config, clean, attacked)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Store an image or label until its partners arrive, then run the policy on both images."""
        self._now_ns = now.mono_ns
        stamp = stamp_ns(message)
        entry = self._open.setdefault(stamp, {})
        entry[topic] = message
        if len(entry) < len(self.subscriptions):
            if len(self._open) > _OPEN:
                self._open.popitem(last=False)
                self._counts["without_partner"] += 1
            return []
        del self._open[stamp]
        if now.mono_ns - info.publish_mono_ns > self._max_age_ns:
            self._counts["dropped_late"] += 1
            return []
        try:
            clean, attacked = (self._seen(name, entry[name]) for name in (self._clean_topic, _ATTACKED))
        except MessageError as error:
            self._counts["dropped_bad"] += 1
            self._trouble = str(error)
            return []
        if self._last_ns is not None and now.mono_ns - self._last_ns > _MEMORY_GAP_S * NS_PER_S:
            for driver in (self._clean, self._attacked):
                driver.reset()
        self._trouble, self._last_ns = "", now.mono_ns
        return self._compare(clean, attacked, entry[_LABEL], stamp)

    def tick(self, now: Now) -> list[Out]:
        """Note the time, so that the status shows when images stop."""
        self._now_ns = now.mono_ns
        return []

    def status(self) -> tuple[str, str]:
        """Report active while pairs arrive."""
        if self._trouble:
            return FAULT, self._trouble
        name = f"policy {self._clean.sha256[:12]}"
        if self._last_ns is None or self._now_ns - self._last_ns > _ACTIVE_S * NS_PER_S:
            return READY, f"{name}, waiting for pairs of images"
        return ACTIVE, f"{name}, largest difference {np.rad2deg(self._largest_rad):.1f} degrees"

    def counters(self) -> dict[str, float]:
        """Report compared and skipped pairs."""
        return {key: float(value) for key, value in self._counts.items()} | {
            "largest_delta_rad": self._largest_rad
        }

    def _seen(self, topic: str, message: Any) -> NDArray[np.uint8]:
        """Convert an image message to the policy's input."""
        rgb = rgb_image(message, topic)
        camera = self._clean.view.camera
        if rgb.shape[:2] != (camera.height, camera.width):
            raise MessageError(
                f"expected images of {camera.width} x {camera.height}, got {rgb.shape[1]} x {rgb.shape[0]}; name the policy that drives"
            )
        return self._clean.view.image(rgb)

    def _compare(
        self, clean: NDArray[np.uint8], attacked: NDArray[np.uint8], label: Any, stamp: int
    ) -> list[Out]:
        clean_rad, attacked_rad = (
            self._clean.steer(clean, self._goal),
            self._attacked.steer(attacked, self._goal),
        )
        if not np.isfinite([clean_rad, attacked_rad]).all():
            self._counts["dropped_bad"] += 1
            self._trouble = "the policy's output is not finite"
            return []
        self._counts["pairs"] += 1
        self._largest_rad = max(self._largest_rad, abs(attacked_rad - clean_rad))
        message = types.Counterfactual(
            header=header(stamp, label.header.frame_id),
            attack_id=label.attack_id,
            drawn=bool(label.drawn),
            clean_rad=clean_rad,
            attacked_rad=attacked_rad,
            delta_rad=attacked_rad - clean_rad,
            changed=float((clean != attacked).any(axis=-1).mean()),
            policy_sha256=self._clean.sha256,
        )
        return [Out(COUNTERFACTUAL_TOPIC, message)]

    def _warm_up(self) -> None:
        camera = self._clean.view.camera
        blank = self._clean.view.image(np.zeros((camera.height, camera.width, 3), np.uint8))
        for driver in (self._clean, self._attacked):
            for _ in range(_WARM_UP_RUNS):
                driver.steer(blank, self._goal)
            driver.reset()


def build_to_give_way(config: CounterfactualConfig, context: NodeContext) -> CounterfactualNode:
    """Build the node, then set its process to idle priority."""
    # The policy is loaded before, because loading at idle priority could take for ever on a busy computer.
    take_share(HELPER)
    node = CounterfactualNode.build(config, context)
    with contextlib.suppress(OSError):  # a container may forbid it; then only nice applies
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    return node


if __name__ == "__main__":
    raise SystemExit(run_node_main(CounterfactualConfig, build_to_give_way))
