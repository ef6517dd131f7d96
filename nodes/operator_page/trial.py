"""A trial on the page: one drive from the start pose over a fixed time, and how far it left the path. Pure.

The trial runs from the first motion of the armed car, as those of ``advnerf car trial`` and the drives of ``advnerf bag evaluate`` do, and is
measured by the stamps of its poses, as they are. A trial that a fault of the stack ended, or in which several attacks were shown, has no metrics.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from advnerf_core.driving.metrics import MOVED_M, Horizon, drive_metrics, states_at_ticks
from advnerf_core.driving.path import Path as DrivingPath
from nodes.control.stop_causes import is_result, safety_silence
from nodes.runtime.clock import NS_PER_S

IDLE, WAITING, RUNNING, DONE = "idle", "waiting", "running", "done"
Pose = tuple[int, float, float]
"""Stamp [ns] and position of the rear axle: x [m], y [m]."""
# Poses that stop coming do not end a trial; the time of this computer does, this long after them [s].
_PATIENCE_S = 1.0


@dataclass(frozen=True)
class Seen:
    """What the page knows at a moment.

    Attributes:
        armed: Whether the car is armed.
        safety_ns: Stamp of that report [ns].
        pose: Newest pose of the car; None while unknown.
        attack_id: The attack that is drawn now; empty for none.
        reason: Why the car is not armed.
    """

    armed: bool
    safety_ns: int
    pose: Pose | None
    attack_id: str = ""
    reason: str = ""


class Trial:
    """The current or last trial.

    Args:
        path: Reference path; None leaves out the metrics.
        off_track_m: Cross-track error beyond which the car is off the track [m].
    """

    def __init__(
        self, path: DrivingPath | None, off_track_m: float, ticks: int = 60, dt_s: float = 0.1
    ) -> None:
        self._path = path
        self._horizon = Horizon(ticks=ticks, dt_s=dt_s, off_track_m=off_track_m)
        self.phase, self.number = IDLE, 0
        self._forget()

    def _forget(self) -> None:
        self._began_ns = 0
        self._armed_at_m: tuple[float, float] | None = None
        self._poses: list[Pose] = []
        self._attack_ids: list[str] = []
        self._result: dict[str, Any] = {}
        self._stopped, self._stopped_s = "", math.inf
        self._safety_ns = self._heard_ns = 0

    def start(self) -> None:
        """Begin a new trial, which waits for the car to be armed and to move."""
        self._forget()
        self.phase, self.number = WAITING, self.number + 1

    def step(self, seen: Seen, mono_ns: int) -> bool:
        """Continue the trial, with every pose and every report of the safety node. Returns whether it has just ended."""
        if seen.safety_ns != self._safety_ns:
            self._safety_ns, self._heard_ns = seen.safety_ns, mono_ns
        if self.phase == WAITING and seen.pose is not None:
            position_m = seen.pose[1:]
            self._armed_at_m = (self._armed_at_m or position_m) if seen.armed else None
            if self._armed_at_m is not None and math.dist(position_m, self._armed_at_m) > MOVED_M:
                self.phase, self._began_ns, self._poses = RUNNING, mono_ns, [seen.pose]
        if self.phase != RUNNING:
            return False
        if seen.attack_id and seen.attack_id not in self._attack_ids:
            self._attack_ids.append(seen.attack_id)
        if seen.pose is not None and seen.pose[0] > self._poses[-1][0]:
            self._poses.append(seen.pose)
        length_s = self._horizon.ticks * self._horizon.dt_s
        if silence := safety_silence(self._heard_ns, mono_ns) if seen.armed else "":
            self._stopped, self._stopped_s = silence, self._since_start_s(seen.safety_ns)
        elif seen.armed:
            late = (mono_ns - self._began_ns) / NS_PER_S > length_s + _PATIENCE_S
            if not late and self._since_start_s(self._poses[-1][0]) < length_s:
                return False
        else:
            self._stopped_s = self._since_start_s(seen.safety_ns)
            # A fault that took away the last poses ended the drive, also if the car was disarmed a moment after its end.
            lost = self._since_start_s(self._poses[-1][0]) < length_s and not is_result(seen.reason)
            self._stopped = seen.reason if lost or self._stopped_s < length_s else ""
        self.end()
        return True

    def end(self) -> bool:
        """End the trial. Returns whether there was one."""
        if self.phase not in (WAITING, RUNNING):
            return False
        ran, self.phase = self.phase == RUNNING, DONE
        if ran and len(self._attack_ids) > 1:
            self._stopped = f"several attacks were shown: {', '.join(self._attack_ids)}"
        if ran and is_result(self._stopped) and self._path is not None and len(self._poses) > 1:
            self._measure(self._path)
        return True

    def _measure(self, path: DrivingPath) -> None:
        stamps, poses = (
            [each[0] for each in self._poses],
            [(*each[1:], 0.0) for each in self._poses],
        )
        stopped = None if math.isinf(self._stopped_s) else self._ticks(self._stopped_s)
        try:
            states = states_at_ticks(np.array(stamps), np.array(poses), stamps[0], self._horizon)
        except ValueError as error:
            self._stopped = f"poses are missing: {error}"
            return
        found = drive_metrics(path, states, self._horizon, stopped)
        self._result = {
            "total_cte_m": found.total_cte_m,
            "mean_cte_m": found.mean_cte_m,
            "max_cte_m": found.max_cte_m,
            "off_track": found.off_track,
        }

    def _since_start_s(self, stamp_ns: int) -> float:
        return (stamp_ns - self._poses[0][0]) / NS_PER_S

    def _ticks(self, time_s: float) -> int:
        """Whole control ticks of a time since the start, at most those of the trial."""
        return min(max(0, self._horizon.whole_ticks(time_s)), self._horizon.ticks)

    def state(self) -> dict[str, Any]:
        """Describe the trial for the page."""
        driven_s = min(self._since_start_s(self._poses[-1][0]), self._stopped_s) if self._poses else 0.0
        return {
            "phase": self.phase,
            "number": self.number,
            "attack_id": " ".join(self._attack_ids),
            "ticks": self._ticks(driven_s),
            "of_ticks": self._horizon.ticks,
            "stopped": self._stopped,
            "counts": is_result(self._stopped),
            **self._result,
        }
