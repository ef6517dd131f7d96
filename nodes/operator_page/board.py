"""The content of the page: the newest messages of the bus as one plain description. Pure: times come as arguments."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import yaw_of
from calibration.schema import RoomCalibration
from nodes.operator_page.trial import Seen
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.messages import finite_pose, stamp_ns
from nodes.runtime.topics import STATUS_PREFIX
from nodes.runtime.wire import MessageInfo

SAFETY, CAR, SENT, MOTOR, DIAGNOSTICS = (
    "/safety/state",
    "/vicon/car",
    "/motor/sent",
    "/motor/state",
    "/diagnostics",
)
COUNTERFACTUAL, DRIVE, PROGRESS = "/policy/counterfactual", "/policy/drive", "/attack/progress"
LABELS = ("/compositor/attack", "/monitor/attack")
TOPICS = (SAFETY, CAR, SENT, MOTOR, DIAGNOSTICS, COUNTERFACTUAL, DRIVE, PROGRESS, *LABELS)
_TRAIL_POINTS, _TRAIL_STEP_M = 1500, 0.03
_LATENCIES = 50
_LIVE_NS = 60 * NS_PER_S
_PATH_POINTS = 241
_SILENT_S = 1.5
_SLOW_SILENT_S = 5.0  # for topics of 1 Hz
_LEVELS = {0: "ok", 1: "warning", 2: "error", 3: "stale"}


@dataclass
class ViewState:
    """Collects messages and describes them.

    Attributes:
        room: Fence and path; None without a room.
        nodes: Nodes whose health is shown, also before they report.
    """

    room: RoomCalibration | None = None
    nodes: tuple[str, ...] = ()
    _newest: dict[str, tuple[Any, int]] = field(default_factory=dict)
    _position_m: tuple[float, float] | None = None
    _pose_ns: int = 0
    _yaw_rad: float = 0.0
    _trail: deque[tuple[float, float]] = field(default_factory=lambda: deque(maxlen=_TRAIL_POINTS))
    _latency_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENCIES))
    _shown_ms: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENCIES))

    def __post_init__(self) -> None:
        self._path: DrivingPath | None = None if self.room is None else self.room.reference_path

    def hear(self, topic: str, message: Any, info: MessageInfo) -> None:
        """Note a message."""
        self._newest[topic] = message, info.publish_mono_ns
        if topic == CAR:
            self._move(message)
        elif topic == SENT and not message.braking:
            self._latency_ms.append((int(message.serial_write_real_ns) - stamp_ns(message)) / 1e6)

    def shown(self, capture_ns: int, real_ns: int) -> None:
        """Note that an image was sent to browsers. Images of a recording are older than any live one."""
        if real_ns - capture_ns < _LIVE_NS:
            self._shown_ms.append((real_ns - capture_ns) / 1e6)

    @property
    def armed(self) -> bool:
        """Whether the safety node says that the car is armed."""
        return bool(getattr(self._message(SAFETY), "armed", False))

    def seen(self) -> Seen:
        """What a trial is measured by."""
        safety = self._message(SAFETY)
        return Seen(
            self.armed,
            0 if safety is None else stamp_ns(safety),
            None if self._position_m is None else (self._pose_ns, *self._position_m),
            self._drawn_attack(),
            "" if self.armed else str(getattr(safety, "reason", "")),
        )

    def hears(self, node: str, now: Now) -> bool:
        """Whether a node has reported a moment ago that it is active."""
        topic = STATUS_PREFIX + node
        age_s = self._age_s(topic, now)
        return age_s is not None and age_s < _SILENT_S and str(self._message(topic).state) == "active"

    @property
    def label(self) -> Any:
        """Newest message about the attack in an image, of whichever node draws one; None before the first."""
        found = [message for topic in LABELS if (message := self._message(topic)) is not None]
        return next((message for message in found if message.attack_id), found[0] if found else None)

    def _drawn_attack(self) -> str:
        return str(self.label.attack_id) if self.label is not None and self.label.drawn else ""

    def status_text(self, node: str) -> str:
        """Last report of a node; empty if it never reported."""
        return str(getattr(self._message(STATUS_PREFIX + node), "text", ""))

    def place(self) -> dict[str, Any]:
        """Describe everything static, and the trail, for a browser that has just connected."""
        place: dict[str, Any] = {
            "trail": _rounded(list(self._trail)),
            "fence": [],
            "path": [],
            "off_track_m": None,
        }
        if self.room is not None and self._path is not None:
            s_m = np.linspace(0.0, self._path.length_m, _PATH_POINTS)
            place["fence"] = _rounded(self.room.fence_m)
            place["path"] = _rounded(self._path.pose_at(s_m)[:, :2].tolist())
            place["off_track_m"] = self.room.off_track_m
        return place

    def state(self, now: Now) -> dict[str, Any]:
        """Describe everything that changes."""
        return {
            "safety": self._safety(now),
            "car": self._car(now),
            "steering": self._steering(now),
            "attack": self._attack(now),
            "search": self._search(now),
            "nodes": [self._node(name, now) for name in self.nodes],
            "latency": {
                "motor_ms": self._while_fresh(SENT, self._latency_ms, now),
                "page_ms": _median(self._shown_ms),
            },
            "motor": self._motor(now),
            "rows": self._rows(now),
        }

    def _while_fresh(self, topic: str, values: deque[float], now: Now) -> float | None:
        """Median of what was measured from a topic; None once the topic is silent."""
        age_s = self._age_s(topic, now)
        return _median(values) if age_s is not None and age_s < _SILENT_S else None

    def _message(self, topic: str) -> Any:
        return self._newest.get(topic, (None, 0))[0]

    def _age_s(self, topic: str, now: Now) -> float | None:
        if topic not in self._newest:
            return None
        return round(max(0.0, (now.mono_ns - self._newest[topic][1]) / NS_PER_S), 2)

    def _move(self, message: Any) -> None:
        if (T := finite_pose(message)) is None:
            return  # an occluded subject; the age of the pose on the page grows
        x_m, y_m = float(T[0, 3]), float(T[1, 3])
        self._pose_ns, self._position_m, self._yaw_rad = stamp_ns(message), (x_m, y_m), yaw_of(T)
        if not self._trail or math.dist(self._trail[-1], (x_m, y_m)) >= _TRAIL_STEP_M:
            self._trail.append((x_m, y_m))

    def _safety(self, now: Now) -> dict[str, Any] | None:
        message = self._message(SAFETY)
        if message is None:
            return None
        return {
            "armed": bool(message.armed),
            "reason": str(message.reason),
            "source": str(message.source),
            "age_s": self._age_s(SAFETY, now),
        }

    def _car(self, now: Now) -> dict[str, Any] | None:
        if self._position_m is None:
            return None
        cte_m = None
        if self._path is not None:
            cte_m = round(float(self._path.project(np.array(self._position_m)).cte_m), 3)
        x_m, y_m = self._position_m
        return {
            "x_m": round(x_m, 3),
            "y_m": round(y_m, 3),
            "yaw_rad": round(self._yaw_rad, 3),
            "cte_m": cte_m,
            "age_s": self._age_s(CAR, now),
        }

    def _steering(self, now: Now) -> dict[str, Any] | None:
        compared, drive = self._message(COUNTERFACTUAL), self._message(DRIVE)
        if compared is None and drive is None:
            return None
        clean, attacked = (
            (None, drive.drive.steering_angle)
            if compared is None
            else (_finite(compared.clean_rad), compared.attacked_rad)
        )
        return {
            "clean_rad": clean,
            "attacked_rad": _finite(attacked),
            "drawn": compared is not None and bool(compared.drawn),
            "age_s": self._age_s(DRIVE if compared is None else COUNTERFACTUAL, now),
        }

    def _attack(self, now: Now) -> dict[str, Any] | None:
        label = self.label
        if label is None:
            return None
        age_s = min(age for topic in LABELS if (age := self._age_s(topic, now)) is not None)
        return {
            "id": str(label.attack_id),
            "drawn": bool(label.drawn),
            "reason": str(label.reason),
            "age_s": age_s,
        }

    def _search(self, now: Now) -> str:
        progress = self._slow_message(PROGRESS, now)
        if progress is None or progress.state in ("idle", ""):
            return ""
        return f"{progress.request_id}: {progress.state} {progress.evaluation}/{progress.evaluations}"

    def _node(self, name: str, now: Now) -> dict[str, Any]:
        topic = STATUS_PREFIX + name
        message = self._message(topic)
        return {
            "name": name,
            "state": "silent" if message is None else str(message.state),
            "text": "" if message is None else str(message.text)[:200],
            "age_s": self._age_s(topic, now),
        }

    def _motor(self, now: Now) -> dict[str, Any] | None:
        state, sent = self._message(MOTOR), self._message(SENT)
        if state is None and sent is None:
            return None
        return {
            "speed_mps": None if state is None else _finite(state.speed_mps),
            "voltage_v": None if state is None else _finite(state.input_voltage_v, 1),
            "fault": "" if state is None else str(state.fault_text),
            "braking": None if sent is None else bool(sent.braking),
            "reason": "" if sent is None else str(sent.reason),
            "peer": "" if sent is None else str(sent.peer),
            "age_s": self._age_s(SENT, now),
        }

    def _slow_message(self, topic: str, now: Now) -> Any:
        """Newest message of a topic of 1 Hz; None once its sender is silent."""
        age_s = self._age_s(topic, now)
        return self._message(topic) if age_s is not None and age_s < _SLOW_SILENT_S else None

    def _rows(self, now: Now) -> list[dict[str, Any]]:
        message = self._slow_message(DIAGNOSTICS, now)
        if message is None:
            return []
        return [
            {
                "name": str(row.name),
                "level": _LEVELS.get(int(row.level), "error"),
                "text": str(row.message)[:200],
            }
            for row in message.status
        ]


def _finite(value: Any, digits: int = 4) -> float | None:
    number = float(value)
    return round(number, digits) if math.isfinite(number) else None


def _median(values: deque[float]) -> float | None:
    # NumPy's median imports a module at its first call, which a page without free descriptors cannot.
    return round(median(values), 1) if values else None


def _rounded(points: Any) -> list[list[float]]:
    return [[round(float(x), 3), round(float(y), 3)] for x, y in points]
