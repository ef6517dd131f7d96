"""A policy with one idea, for measuring the stack without a trained one: ``--set policy.module=tests.support.live.straight_policy``."""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict

from advnerf_core.strict import StrictModel
from nodes.runtime.messages import drive_message, ns_from_stamp
from nodes.runtime.node import MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main


class StraightConfig(StrictModel):
    """Configuration.

    Attributes:
        policy: Not used; so that it can stand in for the real policy node.
        speed_mps: Speed [m/s].
        steering_rad: Steering [rad].
    """

    model_config = ConfigDict(extra="ignore")

    policy: Any = None
    speed_mps: float = 0.8
    steering_rad: float = 0.02


class StraightPolicy(Node):
    """Answers every image with the same command."""

    subscriptions = ("/compositor/image",)
    publications = ("/policy/drive",)

    def __init__(self, config: StraightConfig) -> None:
        self._config = config

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Drive on."""
        stamp_ns = ns_from_stamp(message.header.stamp)
        return [
            Out("/policy/drive", drive_message(self._config.speed_mps, self._config.steering_rad, stamp_ns))
        ]


def build(config: StraightConfig, context: NodeContext) -> StraightPolicy:
    """Make the node of a process."""
    del context
    return StraightPolicy(config)


if __name__ == "__main__":
    raise SystemExit(run_node_main(StraightConfig, build))
