"""Caches frames of a scene that are requested again: on a drive, and for its gradient."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from advnerf_core.geometry import Pinhole


def frame_bytes(pinhole: Pinhole) -> int:
    """Size of one cached frame: colours and depth in float32."""
    return 4 * 4 * pinhole.height * pinhole.width


class RememberedBackground:
    """A background renderer that caches its last frames, each by its pose to the bit.

    Args:
        background: ``(T_world_from_camera [B, 4, 4], pinhole) -> (rgb [B, H, W, 3], planar depth [B, H, W], ...)``, whose frames do not
            depend on the rest of the batch. The first two parts are kept.
        budget_bytes: Memory for cached frames [bytes]; the oldest are dropped first.
    """

    def __init__(self, background: Any, budget_bytes: int) -> None:
        self._background, self._budget_bytes = background, budget_bytes
        self._frames: OrderedDict[tuple[bytes, Pinhole], tuple[Tensor, Tensor]] = OrderedDict()
        self._lock = threading.Lock()
        self.nbytes = 0

    def __call__(self, T_world_from_camera: ArrayLike, pinhole: Pinhole) -> tuple[Tensor, Tensor]:
        """Colours and planar depth of a batch of views; only those that are not cached are rendered."""
        poses = np.ascontiguousarray(T_world_from_camera, np.float64).reshape(-1, 4, 4)
        keys = [(pose.tobytes(), pinhole) for pose in poses]
        with self._lock:
            found = {key: self._frames[key] for key in keys if key in self._frames}
        missing = [index for index, key in enumerate(keys) if key not in found]
        if missing:
            rgb, depth_m = (
                torch.as_tensor(part, device="cpu") for part in self._background(poses[missing], pinhole)[:2]
            )
            found |= {keys[index]: (rgb[k], depth_m[k]) for k, index in enumerate(missing)}
            self._keep({keys[index]: (rgb[k].clone(), depth_m[k].clone()) for k, index in enumerate(missing)})
        rows = [found[key] for key in keys]
        return torch.stack([rgb for rgb, _ in rows]), torch.stack([depth_m for _, depth_m in rows])

    def _keep(self, new: dict[tuple[bytes, Pinhole], tuple[Tensor, Tensor]]) -> None:
        with self._lock:
            for key, frame in new.items():
                if key not in self._frames:
                    self._frames[key] = frame
                    self.nbytes += frame[0].nbytes + frame[1].nbytes
            while self.nbytes > self._budget_bytes and self._frames:
                _, (rgb, depth_m) = self._frames.popitem(last=False)
                self.nbytes -= rgb.nbytes + depth_m.nbytes
