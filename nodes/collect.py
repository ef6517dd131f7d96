"""The collector: on the twin, lets the expert (or a policy) drive from every configured start, one drive after the other.

The node is the operator of a series of trials. It arms the car only if the motor's peer reports that it is the twin. With a real car,
disable it (``--set collect.if=false``), place the car at each start, and hold the button.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.strict import StrictModel
from calibration.schema import RoomCalibration, load_calibration
from nodes.lab.trials.trial import TrialNode, TrialPlan
from nodes.runtime.errors import NodeFinished
from nodes.runtime.node import MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main


class Start(StrictModel):
    """Start of a drive.

    Attributes:
        s_m: Distance along the path from its beginning [m].
        lateral_m: Offset from the path, left positive [m].
        heading_rad: Angle from the heading of the path, left positive [rad].
    """

    s_m: float = 0.0
    lateral_m: float = Field(default=0.0, ge=-1.0, le=1.0)
    heading_rad: float = Field(default=0.0, ge=-1.0, le=1.0)

    def pose_on(self, path: DrivingPath) -> tuple[float, float, float]:
        """Pose of the rear axle: x [m], y [m], yaw [rad]."""
        x_m, y_m, yaw_rad = (float(v) for v in path.pose_at(self.s_m))
        left = (-math.sin(yaw_rad), math.cos(yaw_rad))
        return x_m + self.lateral_m * left[0], y_m + self.lateral_m * left[1], yaw_rad + self.heading_rad


class CollectConfig(StrictModel):
    """Configuration of the collector.

    Attributes:
        room: Room calibration file with the path.
        starts: Starts of the drives.
        laps: Number of laps per drive.
        speed_mps: Speed used to convert laps to time [m/s].
        nodes: Nodes that must be ready before anything moves.
        patience_s: Longest time for each of getting ready, placing, arming and stopping [s].
    """

    room: Path
    starts: tuple[Start, ...] = Field(default=(Start(),), min_length=1)
    laps: float = Field(default=3.0, gt=0.0)
    speed_mps: float = Field(default=0.8, gt=0.0)
    nodes: tuple[str, ...] = ("camera", "vicon", "expert", "safety", "motor")
    patience_s: float = Field(default=30.0, gt=0.0)


class CollectNode(Node):
    """Runs one trial after the other."""

    tick_rate_hz = TrialNode.tick_rate_hz
    publications = TrialNode.publications

    def __init__(self, plans: list[TrialPlan]) -> None:
        self._waiting = [TrialNode(plan) for plan in plans]
        self._drives = len(plans)
        self._trial = self._waiting.pop(0)
        self.subscriptions = self._trial.subscriptions
        self._stopped_early: list[str] = []

    @classmethod
    def build(cls, config: CollectConfig, context: NodeContext) -> CollectNode:
        """Build the node."""
        path = load_calibration(RoomCalibration, config.room).reference_path
        duration_s = config.laps * path.length_m / config.speed_mps
        poses = [start.pose_on(path) for start in config.starts]
        return cls([TrialPlan(pose, duration_s, config.nodes, config.patience_s) for pose in poses])

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Pass a message to the current trial."""
        return self._trial.handle(topic, message, info, now)

    def tick(self, now: Now) -> list[Out]:
        """Advance the current trial, or start the next."""
        try:
            return self._trial.tick(now)
        except NodeFinished:
            number = self._drives - len(self._waiting)
            stopped = self._trial.outcome.stopped_early
            print(
                f"drive {number} of {self._drives} is done{f', stopped early: {stopped}' if stopped else ''}",
                flush=True,
            )
            if stopped:
                self._stopped_early.append(stopped)
            if not self._waiting:
                raise
            self._trial = self._waiting.pop(0)
            return []

    def status(self) -> tuple[str, str]:
        """Report the current drive."""
        number = self._drives - len(self._waiting)
        return "active", f"drive {number} of {self._drives}: {self._trial.phase.value}"

    def counters(self) -> dict[str, float]:
        """Report started drives, and drives that the stack stopped."""
        return {"drives": self._drives - len(self._waiting), "stopped_early": len(self._stopped_early)}


if __name__ == "__main__":
    raise SystemExit(run_node_main(CollectConfig, CollectNode.build))
