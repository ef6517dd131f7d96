"""Selects the frames of a video to keep: sharp ones, and a new one whenever the view has moved on.

Sharpness is the variance of the Laplacian (Pech-Pacheco et al. 2000) of a small grey copy. Movement is the median displacement of
corners tracked by optical flow (Lucas and Kanade, with pyramids) since the last kept frame; when too few can be followed, the view
counts as changed. Among the frames since the movement came near its limit the sharpest is kept, so that a shake costs no place.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import Grey, Rgb

_WORK_WIDTH = 480
_CORNERS, _LEAST_CORNERS = 300, 12
_LOST_SHARE, _RETURN_PX = 0.35, 1.0
# Displacement of the picture after which a new frame is due, as a share of its width.
MOVEMENT = 0.06
# Share of that movement over which the sharpest frame is looked for.
WINDOW = 0.4
# A frame less sharp than this share of the usual sharpness is passed over until the longest wait is over.
BLUR_LIMIT = 0.35
# Longest time until another frame is kept, if the view has moved at all [s].
MAX_WAIT_S = 2.0


@dataclass(frozen=True, eq=False)
class Candidate:
    """A frame of a video.

    Attributes:
        number: Number of the frame, from 0.
        time_s: Time in the video [s].
        rgb: ``[H, W, 3]`` uint8.
        sharpness: Variance of the Laplacian.
    """

    number: int
    time_s: float
    rgb: Rgb
    sharpness: float


class KeyframeSelector:
    """Takes frames one after another and selects those to keep; holds at most two of them.

    Args:
        movement: Displacement of the picture after which a new frame is due, as a share of its width.
    """

    def __init__(self, movement: float = MOVEMENT) -> None:
        self._due = movement
        self._kept: Grey | None = None
        self._kept_s = 0.0
        self._corners: NDArray[np.float32] = np.zeros((0, 1, 2), np.float32)
        self._best: Candidate | None = None
        self._usual = 0.0

    def offer(self, number: int, time_s: float, rgb: Rgb) -> Candidate | None:
        """Take the next frame ``[H, W, 3]`` uint8; returns a frame to keep once one is settled."""
        grey = work_image(rgb)
        new = Candidate(number, time_s, rgb, sharpness(grey))
        self._usual = new.sharpness if self._usual == 0.0 else 0.95 * self._usual + 0.05 * new.sharpness
        if self._kept is None:
            # A sharper frame soon after may still replace the first one.
            self._best = new
            self._remember(new)
            return None
        waited = time_s - self._kept_s
        if new.sharpness < BLUR_LIMIT * self._usual and waited < MAX_WAIT_S:
            return None  # and corners cannot be followed into it either
        moved = self.movement(grey)
        late = waited >= MAX_WAIT_S and moved >= 0.1 * self._due
        if (moved >= (1.0 - WINDOW) * self._due or late) and (
            self._best is None or new.sharpness > self._best.sharpness
        ):
            self._best = new
        return self._keep() if moved >= self._due or late else None

    def last(self) -> Candidate | None:
        """At the end of the video: the best frame that has moved on and was not kept, if any."""
        return None if self._best is None else self._keep()

    def movement(self, grey: Grey) -> float:
        """Median displacement since the last kept frame, as a share of the width; 1 when it cannot be followed."""
        if self._kept is None or len(self._corners) < _LEAST_CORNERS:
            # On a bare wall there is nothing to follow: the difference of the pictures replaces it.
            return (
                0.0 if self._kept is None else float(np.asarray(cv2.absdiff(self._kept, grey)).mean() / 255.0)
            )
        found, status = _follow(self._kept, grey, self._corners)
        back, status_back = _follow(grey, self._kept, found)
        # Flow gives a result in any picture; it is the same corner only if tracking back ends where it began.
        same = status & status_back & (np.linalg.norm(back - self._corners, axis=-1).reshape(-1) < _RETURN_PX)
        if same.mean() < _LOST_SHARE:
            return 1.0
        shift = np.linalg.norm((found - self._corners).reshape(-1, 2)[same], axis=1)
        return float(np.median(shift) / grey.shape[1])

    def _keep(self) -> Candidate:
        assert self._best is not None
        kept, self._best = self._best, None
        self._remember(kept)
        return kept

    def _remember(self, frame: Candidate) -> None:
        grey = work_image(frame.rgb)
        corners = cv2.goodFeaturesToTrack(grey, _CORNERS, 0.01, 6)
        self._corners = (
            np.zeros((0, 1, 2), np.float32) if corners is None else np.asarray(corners, np.float32)
        )
        self._kept, self._kept_s = grey, frame.time_s


def work_image(rgb: Rgb) -> Grey:
    """Small grey copy ``[h, w]`` for judging a frame."""
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    width = min(_WORK_WIDTH, grey.shape[1])
    size = (width, max(1, round(grey.shape[0] * width / grey.shape[1])))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _follow(
    first: Grey, second: Grey, points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    found, status, _ = cv2.calcOpticalFlowPyrLK(first, second, points, None, winSize=(21, 21), maxLevel=4)  # type: ignore[call-overload]
    return np.asarray(found, np.float32), np.asarray(status.reshape(-1) == 1)


def sharpness(grey: Grey) -> float:
    """Variance of the Laplacian of an image ``[h, w]``."""
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())
