"""Pictures of a camera that turns before a far wall, whose truth is in closed form."""

import cv2
import numpy as np


def yaw_at(t):
    """Turned to and fro by hand: no rhythm."""
    return 0.5 * np.sin(1.1 * t) + 0.25 * np.sin(2.63 * t + 1.0) + 0.1 * np.sin(5.1 * t)


def far_wall(camera, yaws):
    """Grey pictures of a texture at infinity from a car that is turned by each yaw [rad]."""
    rng = np.random.default_rng(1)
    grey = cv2.GaussianBlur(rng.uniform(0, 255, (600, 1400)).astype(np.float32), (0, 0), 3.0)
    grey = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    for yaw in yaws:
        c, s = np.cos(yaw), np.sin(yaw)
        R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ camera.mount[:3, :3]
        rays = camera.pinhole.directions() @ R.T
        u = 700.0 - 400.0 * np.arctan2(rays[..., 1], rays[..., 0])
        v = 300.0 - 400.0 * rays[..., 2] / np.hypot(rays[..., 0], rays[..., 1])
        seen = cv2.remap(grey, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        yield seen.astype(np.uint8)
