"""A trial on the page: one drive from the start pose over a fixed time, and how far it left the path. Pure.

The trial runs from the first motion of the armed car, as those of ``advnerf car trial`` and the drives of ``advnerf bag evaluate`` do. A trial
that a fault of the stack ended has no metrics, by the rule for stops that those commands have too.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from advnerf_core.driving.metrics import MOVED_M, Horizon, drive_metrics
from advnerf_core.driving.path import Path as DrivingPath
from nodes.control.stop_causes import is_result
from nodes.runtime.clock import NS_PER_S

IDLE, WAITING, RUNNING, DONE = "idle", "waiting", "running", "done"


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
        self.phase, self.number, self.attack_id = IDLE, 0, ""
        self._began_ns = 0
        self._armed_at_m: tuple[float, float] | None = None
        self._states: list[tuple[float, float]] = []
        self._result: dict[str, Any] = {}
        self._stopped = ""

    def start(self) -> None:
        """Begin a new trial, which waits for the car to be armed and to move."""
        self.phase, self.number, self._armed_at_m = WAITING, self.number + 1, None
        self._states, self._result, self.attack_id, self._stopped = [], {}, "", ""

    def step(
        self,
        armed: bool,
        position_m: tuple[float, float] | None,
        attack_id: str,
        mono_ns: int,
        reason: str = "",
    ) -> bool:
        """Continue the trial. Returns whether it has just ended.

        Args:
            position_m: Position of the rear axle [m]; None while unknown.
            attack_id: The attack that is drawn now; empty for none.
            reason: Why the car is not armed.
        """
        if self.phase == WAITING and position_m is not None:
            self._armed_at_m = (self._armed_at_m or position_m) if armed else None
            if self._armed_at_m is not None and math.dist(position_m, self._armed_at_m) > MOVED_M:
                self.phase, self._began_ns = RUNNING, mono_ns
                self._states = [position_m]
        if self.phase != RUNNING:
            return False
        self.attack_id = self.attack_id or attack_id
        tick = (mono_ns - self._began_ns) // round(self._horizon.dt_s * NS_PER_S)
        if position_m is not None and armed:
            while len(self._states) <= min(tick, self._horizon.ticks):
                self._states.append(position_m)
        if armed and tick < self._horizon.ticks:
            return False
        self._stopped = "" if armed else reason
        self.end()
        return True

    def end(self) -> bool:
        """End the trial. Returns whether there was one."""
        if self.phase not in (WAITING, RUNNING):
            return False
        ran, self.phase = self.phase == RUNNING, DONE
        if ran and is_result(self._stopped) and self._path is not None and len(self._states) > 1:
            found = drive_metrics(self._path, np.array(self._states), self._horizon)
            self._result = {
                "total_cte_m": found.total_cte_m,
                "mean_cte_m": found.mean_cte_m,
                "max_cte_m": found.max_cte_m,
                "off_track": found.off_track,
            }
        return True

    def state(self) -> dict[str, Any]:
        """Describe the trial for the page."""
        return {
            "phase": self.phase,
            "number": self.number,
            "attack_id": self.attack_id,
            "ticks": max(0, len(self._states) - 1),
            "of_ticks": self._horizon.ticks,
            "stopped": self._stopped,
            "counts": is_result(self._stopped),
            **self._result,
        }
