"""Do poses belong to their photographs? Matched features tell at once what a training would only fail at.

Matches of SIFT that one fundamental matrix explains are taken as true. The right poses have each of them near its epipolar line and in front of
both cameras (Hartley and Zisserman, Multiple View Geometry, 2nd edition, 9.6, 11.4.3); so has a usual mistake, once it is undone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.view_loading import load_image
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Array, Pinhole, invert_transform

_PAIRS, _ENOUGH_PAIRS = 12, 4
# Distances in the list, widest first: the wider the baseline, the surer the sign of a depth.
_STEPS = (8, 4, 2, 1)
_SIDE = 800  # px of the longer side in which features are looked for
_FEATURES, _ENOUGH_MATCHES = 1500, 30
_RATIO = 0.75  # of the distances of the nearest and the second nearest feature (Lowe 2004, 7.1)
# Parts of the longer side: from the epipolar line, of true matches and of right poses; and the least median shift of a pair.
_TRUE, _NEAR, _SHIFT = 0.0015, 0.006, 0.02
# Shares of true matches that fit poses which are wrong, and poses which are right.
_WRONG, _RIGHT = 0.3, 0.6

_MISTAKES: dict[str, Callable[[Array], Array]] = {
    "each pose multiplied by diag(1, -1, -1, 1) from the right: its camera axes are OpenCV's (y down, z forward) where OpenGL's belong, or the "
    "reverse": lambda poses: poses @ OPENGL_FROM_OPENCV,
    "each pose inverted: it leads from the world to the camera": invert_transform,
    "each pose inverted and multiplied by diag(1, -1, -1, 1) from the right: it leads from the world to the camera, and has other camera axes": (
        lambda poses: invert_transform(poses) @ OPENGL_FROM_OPENCV
    ),
    "the pose of the next image: the poses are one row late": lambda poses: np.roll(poses, -1, axis=0),
    "the pose of the image before: the poses are one row early": lambda poses: np.roll(poses, 1, axis=0),
}


def require_agreeing_poses(frames: Sequence[PosedImage], name: str) -> None:
    """Refuse poses that do not fit their photographs, if the same poses fit once a usual mistake is undone.

    Photographs without enough features in common, as of white walls, say nothing and pass. At most sixty are read.

    Args:
        frames: Photographs in an order in which most have something in common with the next one.
        name: The data set, for the message.

    Raises:
        DatasetError: The poses have a usual mistake, or an image cannot be read.
    """
    photographs = _Photographs(frames)
    pairs = list(_pairs(photographs))
    if len(pairs) < _ENOUGH_PAIRS:
        return
    poses = np.stack([frame.T_world_from_camera for frame in frames])
    given = _share(pairs, poses)
    if given > _WRONG:
        return
    shares = {how: _share(pairs, undo(poses)) for how, undo in _MISTAKES.items()}
    best = max(shares, key=lambda how: shares[how])
    if shares[best] >= _RIGHT:
        raise DatasetError(
            f"expected poses of {name} that fit its photographs, got {100 * given:.0f} % of the features that pairs of them share where the poses "
            f"put them; it is {100 * shares[best]:.0f} % with {best}"
        )


@dataclass(frozen=True, eq=False)
class _Seen:
    """SIFT features of a photograph: pixels ``[N, 2]`` and descriptors ``[N, 128]``."""

    pixels: Array
    descriptors: NDArray[np.float32] | None
    pinhole: Pinhole


class _Photographs:
    """Photographs whose features are looked for once, undistorted."""

    def __init__(self, frames: Sequence[PosedImage]) -> None:
        self._frames = frames
        self._seen: dict[int, _Seen] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: int) -> _Seen:
        if index not in self._seen:
            rgb, pinhole = load_image(self._frames[index])
            factor = min(1.0, _SIDE / max(rgb.shape[:2]))
            grey = cv2.resize(
                cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY),
                None,
                fx=factor,
                fy=factor,
                interpolation=cv2.INTER_AREA,
            )
            points, descriptors = cv2.SIFT.create(nfeatures=_FEATURES).detectAndCompute(grey, None)
            pixels = (np.array([point.pt for point in points]).reshape(-1, 2) + 0.5) / factor
            self._seen[index] = _Seen(
                pixels, np.asarray(descriptors, np.float32) if points else None, pinhole
            )
        return self._seen[index]


@dataclass(frozen=True, eq=False)
class _Pair:
    """True matches of two photographs: pixels ``[N, 2]`` in each."""

    first: int
    second: int
    one: Pinhole
    two: Pinhole
    in_one: Array
    in_two: Array


def _pairs(photographs: _Photographs) -> Iterator[_Pair]:
    last = len(photographs) - 1
    for first in np.unique(np.linspace(0, last - 1, min(last, _PAIRS)).round().astype(int)).tolist():
        seconds = (first + step for step in _STEPS if first + step <= last)
        yield from islice(filter(None, (_matched(photographs, first, second) for second in seconds)), 1)


def _matched(photographs: _Photographs, first: int, second: int) -> _Pair | None:
    one, two = photographs[first], photographs[second]
    if one.descriptors is None or two.descriptors is None or len(two.pixels) < 2:
        return None
    nearest = cv2.BFMatcher(cv2.NORM_L2).knnMatch(one.descriptors, two.descriptors, k=2)
    good = [
        (best.queryIdx, best.trainIdx) for best, next_ in nearest if best.distance < _RATIO * next_.distance
    ]
    if len(good) < _ENOUGH_MATCHES:
        return None
    here, there = np.array(good).T
    a, b = one.pixels[here], two.pixels[there]
    side = max(one.pinhole.width, one.pinhole.height)
    _, true = cv2.findFundamentalMat(a, b, cv2.FM_RANSAC, _TRUE * side, 0.999, 2000)
    kept = np.zeros(len(a), np.bool_) if true is None else true[:, 0] > 0
    if kept.sum() < _ENOUGH_MATCHES or np.median(np.linalg.norm(a - b, axis=1)[kept]) < _SHIFT * side:
        return None
    return _Pair(first, second, one.pinhole, two.pinhole, a[kept], b[kept])


def _share(pairs: Sequence[_Pair], T_world_from_camera: Array) -> float:
    """Median over pairs of the share of matches that poses ``[N, 4, 4]`` explain."""
    return float(np.median([_explained(pair, T_world_from_camera).mean() for pair in pairs]))


def _explained(pair: _Pair, T_world_from_camera: Array) -> NDArray[np.bool_]:
    """Which matches ``[N]`` lie near their epipolar lines, by Sampson's distance, and in front of both cameras."""
    T_two_from_one = invert_transform(T_world_from_camera[pair.second]) @ T_world_from_camera[pair.first]
    R, t = T_two_from_one[:3, :3], T_two_from_one[:3, 3]
    K_one, K_two = np.linalg.inv(pair.one.matrix), np.linalg.inv(pair.two.matrix)
    in_one, in_two = (np.column_stack([each, np.ones(len(each))]) for each in (pair.in_one, pair.in_two))
    fundamental = K_two.T @ np.cross(np.eye(3), t) @ R @ K_one
    lines, back = in_one @ fundamental.T, in_two @ fundamental
    slopes = (lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1)
    limit_px = _NEAR * max(pair.one.width, pair.one.height)
    near = (in_two * lines).sum(axis=1) ** 2 <= limit_px**2 * slopes
    # depth * ray + t = other * seen, crossed with either; only the signs count.
    ray, seen = in_one @ K_one.T @ R.T, in_two @ K_two.T
    across = np.cross(ray, seen)
    depth, other = ((np.cross(each, t) * across).sum(axis=1) for each in (seen, ray))
    return np.asarray(near & (depth > 0.0) & (other > 0.0))
