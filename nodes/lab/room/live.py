"""Current pose of a standing subject: the mean of its poses over a short time, or None if motion capture has lost it."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from advnerf_core.geometry import Array
from calibration.degeneracy import mean_transform
from nodes.runtime.bus import Bus
from nodes.runtime.messages import pose_matrix

_LOST_S = _WINDOW_S = 0.5
_LEAST_POSES = 5


def standing_poses(run_dir: Path, topic: str, period_s: float) -> Iterator[Array | None]:
    """Yield the mean pose ``[4, 4]`` over a window once per period, for ever; None while the subject is lost."""
    recent: deque[tuple[float, Array]] = deque()
    with Bus(run_dir) as bus:
        bus.subscribe(topic, queue=1000)
        due = time.monotonic() + period_s
        while True:
            bus.wait(max(0.0, min(0.05, due - time.monotonic())))
            now = time.monotonic()
            recent.extend((now, pose_matrix(received.message())) for received in bus.receive())
            while recent and now - recent[0][0] > _WINDOW_S:
                recent.popleft()
            if now < due:
                continue
            due = now + period_s
            fresh = len(recent) >= _LEAST_POSES and now - recent[-1][0] < _LOST_S
            yield mean_transform(np.stack([T for _, T in recent])) if fresh else None
