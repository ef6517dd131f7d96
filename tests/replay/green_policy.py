"""A policy without a network, for replays: steers away from the greener half of the image, and counts its ticks."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from nodes.runtime.messages import drive_message, stamp_ns
from nodes.runtime.node import MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.pictures import rgb_image


class GreenConfig(BaseModel):
    """Configuration: steering per grey level of difference [rad], speed [m/s]."""

    model_config = ConfigDict(extra="forbid")

    gain_rad: float = Field(default=0.01, ge=0.0)
    speed_mps: float = 0.8


class GreenPolicy(Node):
    """Image in, drive command out."""

    subscriptions = ("/compositor/image",)
    publications = ("/policy/drive",)
    tick_rate_hz = 10.0

    def __init__(self, config: GreenConfig) -> None:
        self._config = config
        self._ticks = 0

    @classmethod
    def build(cls, config: GreenConfig, context: NodeContext) -> GreenPolicy:
        """Make the node."""
        del context
        return cls(config)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Steer by an image."""
        green = rgb_image(message, "test")[..., 1].astype(np.int64)
        half = green.shape[1] // 2
        difference = int(green[:, half:].sum() - green[:, :half].sum()) / green.size
        drive = drive_message(self._config.speed_mps, self._config.gain_rad * difference, stamp_ns(message))
        return [Out("/policy/drive", drive)]

    def tick(self, now: Now) -> list[Out]:
        """Count."""
        self._ticks += 1
        return []

    def counters(self) -> dict[str, float]:
        """Ticks so far."""
        return {"ticks": float(self._ticks)}
