"""A node of your own: it steers towards the brighter half of the camera's image.

    .venv/bin/advnerf launch examples/steer_to_the_light.launch.yaml --folder runs/light
    .venv/bin/python examples/read_a_bag.py runs/light/bag

A node is a class that turns messages into messages. The launch file runs it as a process, beside a player of a recording.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from advnerf_core.strict import StrictModel
from nodes.runtime import (
    MessageInfo,
    Node,
    NodeContext,
    Now,
    Out,
    drive_message,
    rgb_image,
    run_node_main,
    stamp_ns,
)

IMAGES, COMMANDS = "/camera/image_raw", "/policy/drive"


class LightConfig(StrictModel):
    """Configuration; an unknown key or a wrong value is one line with the file, the line and the valid keys.

    Attributes:
        gain_rad: Wheel angle at a difference of one, from black to white [rad].
        speed_mps: Speed [m/s].
    """

    gain_rad: float = Field(default=0.5, ge=0.0)
    speed_mps: float = Field(default=0.8, ge=0.0)


class LightNode(Node):
    """Image in, drive command out, with the stamp of the image."""

    subscriptions = (IMAGES,)
    publications = (COMMANDS,)

    def __init__(self, config: LightConfig) -> None:
        self._config = config
        self._steering_rad = 0.0

    @classmethod
    def build(cls, config: LightConfig, context: NodeContext) -> LightNode:
        """Make the node of a process; ``context`` has its name, run folder and clock."""
        del context
        return cls(config)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Steer by one image."""
        left, right = np.array_split(rgb_image(message, topic).mean(axis=2) / 255.0, 2, axis=1)
        self._steering_rad = self._config.gain_rad * float(left.mean() - right.mean())
        return [Out(COMMANDS, drive_message(self._config.speed_mps, self._steering_rad, stamp_ns(message)))]

    def status(self) -> tuple[str, str]:
        """What `advnerf car top` says about it."""
        return "active", f"steers {self._steering_rad:+.3f} rad"


if __name__ == "__main__":
    raise SystemExit(run_node_main(LightConfig, LightNode.build))
