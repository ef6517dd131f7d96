"""Photographs of a camera that only turned, told from their matches; the truth is projected in closed form."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from calibration.only_turned import turned
from calibration.photo_model import PhotoSource, ReconstructionError, SfmConfig
from calibration.structure_from_motion import reconstruct

SIZE = np.array([480.0, 360.0])


def seen(points_m, camera, focal_px, pixels_off, rng):
    """Places of points in an image, from its middle in longer sides, and which of them it shows."""
    R, centre_m = camera
    in_camera = (points_m - centre_m) @ R
    at = focal_px * in_camera[:, :2] / in_camera[:, 2:] + pixels_off * rng.standard_normal((len(points_m), 2))
    return at / SIZE.max(), (in_camera[:, 2] > 0.1) & (np.abs(at) < SIZE / 2).all(axis=1)


def matches(points_m, cameras, focal_px=420.0, pixels_off=0.5):
    rng, found = np.random.default_rng(1), []
    views = [seen(points_m, camera, focal_px, pixels_off, rng) for camera in cameras]
    for a, (one, in_one) in enumerate(views):
        for other, in_other in views[a + 1 :]:
            both = in_one & in_other
            if both.sum() >= 30:
                found.append((one[both], other[both]))
    return found


def cameras(count, reach_m, rng):
    turns = Rotation.from_euler("yxz", rng.uniform(-1.0, 1.0, (count, 3)) * [0.5, 0.1, 0.05]).as_matrix()
    return list(zip(turns, reach_m * rng.uniform(-1.0, 1.0, (count, 3)) * [1.0, 0.2, 0.2], strict=True))


def room(rng):
    return rng.uniform([-4.0, -1.5, 2.0], [4.0, 1.5, 5.0], (4000, 3))


def wall(rng):
    return np.column_stack([rng.uniform(-5.0, 5.0, 4000), rng.uniform(-2.0, 2.0, 4000), np.full(4000, 3.0)])


@pytest.mark.parametrize("place", [room, wall])
@pytest.mark.parametrize("focal_px", [250.0, 420.0, 700.0])
def test_a_camera_that_only_turned_is_told_from_one_that_was_moved(place, focal_px):
    rng = np.random.default_rng(0)
    points_m = place(rng)
    stood = turned(matches(points_m, cameras(12, 0.0, rng), focal_px))
    assert stood.only
    assert stood.share == 1.0
    moved = turned(matches(points_m, cameras(12, 0.6, rng), focal_px))
    assert not moved.only
    assert moved.share < 0.4


def test_too_few_pairs_say_nothing():
    rng = np.random.default_rng(0)
    few = matches(room(rng), cameras(3, 0.0, rng))
    assert len(few) <= 3
    assert not turned(few).only
    assert not turned([]).only


def test_a_panorama_is_refused_with_what_to_do(tmp_path):
    """It ended with 'too little overlap', or with invented poses and a lens that was 31 % off."""
    rng = np.random.default_rng(0)
    sky = cv2.resize(
        rng.integers(0, 255, (150, 300, 3), np.uint8), (1200, 600), interpolation=cv2.INTER_CUBIC
    )
    u, v = np.meshgrid(np.arange(320) - 159.5, np.arange(240) - 119.5)
    rays = np.stack([u / 280.0, v / 280.0, np.ones_like(u)], -1)
    names = tuple(f"{k}.png" for k in range(8))
    for k, name in enumerate(names):
        x, y, z = np.moveaxis(
            rays @ Rotation.from_euler("yx", [0.15 * k, 0.05 * (-1) ** k]).as_matrix().T, -1, 0
        )
        at = 600.0 + 190.0 * np.arctan2(x, z), 300.0 + 190.0 * np.arctan2(y, np.hypot(x, z))
        picture = cv2.remap(sky, *(each.astype(np.float32) for each in at), cv2.INTER_LINEAR)
        noisy = picture + rng.normal(0.0, 3.0, picture.shape)
        cv2.imwrite(str(tmp_path / name), np.clip(noisy, 0, 255).astype(np.uint8))
    with pytest.raises(
        ReconstructionError, match=r"a camera that only turned: rotation alone explains .* move the camera"
    ):
        reconstruct(tmp_path, [PhotoSource("phone", names)], tmp_path / "work", SfmConfig(max_features=600))
