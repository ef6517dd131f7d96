"""Corners of a board as a camera with known numbers sees them: the truth that the calibrations are tested against."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from advnerf_core.geometry import invert_transform, make_transform
from calibration.charuco import Board, Detection

BOARD = Board(columns=8, rows=6, square_m=0.1, marker_m=0.075)


def corners(board=BOARD):
    x, y = np.meshgrid(np.arange(1, board.columns), np.arange(1, board.rows))
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1) * board.square_m


def seen(T_camera_from_board, matrix, distortion, size, rng, noise_px=0.1, board=BOARD):
    points = corners(board)
    inside = points @ T_camera_from_board[:3, :3].T + T_camera_from_board[:3, 3]
    pixels = cv2.projectPoints(inside, np.zeros(3), np.zeros(3), matrix, np.asarray(distortion))[0].reshape(
        -1, 2
    )
    pixels += rng.normal(0.0, noise_px, pixels.shape)
    keep = (inside[:, 2] > 0.1) & (pixels > 1.0).all(axis=1) & (pixels < np.array(size) - 1.0).all(axis=1)
    return Detection(points[keep], pixels[keep]) if keep.sum() >= 6 else None


def turned(T, rng, turn_rad, move_m):
    return T @ make_transform(
        Rotation.from_rotvec(rng.normal(0.0, turn_rad, 3)).as_matrix(), rng.normal(0.0, move_m, 3)
    )


def board_views(rng, count, matrix, distortion, size, tilt_rad=0.5, noise_px=0.1, about_y_rad=0.0):
    """Views spread over the picture, the board's middle anywhere in it, turned by up to ``tilt_rad`` from a turn about its y."""
    middle = np.array([0.4, 0.3, 0.0])
    views = []
    while len(views) < count:
        depth = rng.uniform(0.5, 1.2)
        pixel = rng.uniform([0.1, 0.1], [0.9, 0.9]) * size
        ray = np.array(
            [(pixel[0] - matrix[0, 2]) / matrix[0, 0], (pixel[1] - matrix[1, 2]) / matrix[1, 1], 1.0]
        )
        R = Rotation.from_euler(
            "xyz",
            [*(rng.uniform(-tilt_rad, tilt_rad, 2) + np.array([0.0, about_y_rad])), rng.uniform(-0.3, 0.3)],
        ).as_matrix()
        found = seen(make_transform(R, ray * depth - R @ middle), matrix, distortion, size, rng, noise_px)
        if found is not None and len(found.pixels) >= 12:
            views.append(found)
    return views


__all__ = ["BOARD", "board_views", "corners", "invert_transform", "seen", "turned"]
