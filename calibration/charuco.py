"""ChArUco boards: chessboards with markers in the white squares, so that every corner is identified, even in a partial view."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.aruco import marker_dictionary
from advnerf_core.geometry import Array
from calibration.schema import CalibrationError

MIN_CORNERS = 6
_LARGEST_SQUARE_M = 1.0
# A pose is ambiguous where the error of the first solution is above this share of the second's.
_AMBIGUOUS = 0.6


@dataclass(frozen=True)
class Board:
    """A printed board. Its frame: origin in the printed picture's top left corner, x to the right, y down, z into the paper.

    Attributes:
        columns: Squares per row.
        rows: Squares per column.
        square_m: Side of a square, measured on the print [m].
        marker_m: Side of a marker [m].
        dictionary: OpenCV's name of the markers.
        legacy: Printed by OpenCV before 4.6, with a marker instead of a square in the first corner.
    """

    columns: int = 6
    rows: int = 6
    square_m: float = 0.16
    marker_m: float = 0.12
    dictionary: str = "DICT_4X4_50"
    legacy: bool = False

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3 or not 0.0 < self.marker_m < self.square_m:
            raise CalibrationError(
                f"expected a board of 3 x 3 squares or more with markers smaller than squares, got {self.columns} x {self.rows}, "
                f"squares of {self.square_m} m, markers of {self.marker_m} m"
            )
        if self.square_m > _LARGEST_SQUARE_M:
            raise CalibrationError(
                f"expected squares of at most {_LARGEST_SQUARE_M:g} m, got {self.square_m:g} m; is it in mm?"
            )
        if len(self._dictionary.bytesList) < self.columns * self.rows // 2:
            raise CalibrationError(
                f"expected a dictionary of at least {self.columns * self.rows // 2} markers for this board, {self.dictionary} "
                f"has {len(self._dictionary.bytesList)}"
            )

    @property
    def _dictionary(self) -> Any:
        return marker_dictionary(self.dictionary)

    @property
    def opencv(self) -> Any:
        """The board as an OpenCV object."""
        size = (self.columns, self.rows)
        board = cv2.aruco.CharucoBoard(size, self.square_m, self.marker_m, self._dictionary)
        board.setLegacyPattern(self.legacy)
        return board

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height [m]."""
        return self.columns * self.square_m, self.rows * self.square_m

    def picture(self, pixels_per_square: int = 100) -> NDArray[np.uint8]:
        """Image of the board to print, ``[H, W]`` uint8, without margin."""
        size = (self.columns * pixels_per_square, self.rows * pixels_per_square)
        return np.asarray(self.opencv.generateImage(size, marginSize=0), np.uint8)


@dataclass(frozen=True, eq=False)
class Detection:
    """The corners of a board in one image.

    Attributes:
        board_m: Corners in the board's frame ``[n, 3]`` [m].
        pixels: Positions in the image ``[n, 2]``, pixel centres at +0.5 [px].
    """

    board_m: Array
    pixels: Array


class BoardDetector:
    """Detects a board in images."""

    def __init__(self, board: Board) -> None:
        self._board = board.opencv
        self._detector = cv2.aruco.CharucoDetector(self._board)

    def find(self, image: NDArray[np.uint8]) -> Detection | None:
        """Detect the board in an image ``[H, W]`` or ``[H, W, 3]`` RGB; None with fewer than six corners, or only a line of them."""
        grey = image if image.ndim == 2 else cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY)
        corners, ids, _, _ = self._detector.detectBoard(np.ascontiguousarray(grey))
        if ids is None or len(ids) < MIN_CORNERS:
            return None
        points, pixels = self._board.matchImagePoints(corners, ids)
        points, pixels = points.reshape(-1, 3).astype(np.float64), pixels.reshape(-1, 2).astype(np.float64)
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[1] < 0.1 * spread[0]:
            return None
        # OpenCV counts pixels from their centres, we from their corners.
        return Detection(points, pixels + 0.5)


def board_pose(found: Detection, matrix: Array, distortion: Array) -> Array | None:
    """Pose ``T_camera_from_board`` ``[4, 4]`` of a board in one picture; None where two tilts explain it about equally well.

    Args:
        matrix: Camera matrix ``[3, 3]``, pixel centres at +0.5.
        distortion: OpenCV's coefficients.
    """
    count, turns, moves, errors = cv2.solvePnPGeneric(
        found.board_m, found.pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    if count == 0 or not np.isfinite(turns).all():
        return None
    if count > 1 and errors[0, 0] > _AMBIGUOUS * errors[1, 0]:
        return None
    turn, move = cv2.solvePnPRefineLM(found.board_m, found.pixels, matrix, distortion, turns[0], moves[0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(turn)[0], move.ravel()
    return T if T[2, 3] > 0.0 else None
