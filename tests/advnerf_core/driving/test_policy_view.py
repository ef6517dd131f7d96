import json

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.view import PolicyView

CAMERA = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
VIEW = PolicyView(CAMERA)


def test_linear_ramp_lands_where_the_intrinsics_say() -> None:
    columns = np.arange(336) + 0.5
    ramp = np.repeat(np.repeat(columns[None, :, None] * 0.7, 188, 0), 3, 2)
    seen = VIEW.image(np.round(ramp).astype(np.uint8))
    assert seen.shape == (66, 200, 3)
    assert seen.dtype == np.uint8
    # The centre of policy column j shows camera column (j + 0.5) * 336 / 200.
    expected = (np.arange(200) + 0.5) * 1.68 * 0.7
    np.testing.assert_allclose(seen[30, :, 0], expected, atol=1.2)


def test_rows_outside_the_crop_are_not_seen() -> None:
    image = np.full((188, 336, 3), 255, np.uint8)
    image[24:135] = 7
    assert (VIEW.image(image) == 7).all()


def test_pinhole_projects_like_the_camera() -> None:
    points = np.array([[0.3, 0.1, 1.0], [-0.5, 0.2, 2.0]])
    scale = np.array([200 / 336, 66 / 111])
    np.testing.assert_allclose(VIEW.pinhole.project(points), (CAMERA.project(points) - [0, 24]) * scale)


def test_distortion_is_removed() -> None:
    coefficients = (-0.2, 0.05, 0.001, -0.001)
    view = PolicyView(CAMERA, distortion=coefficients)
    point = np.array([[0.35, 0.12, 1.0]])
    matrix = CAMERA.matrix - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    distorted = (
        cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, np.array(coefficients))[0][0, 0] + 0.5
    )
    yy, xx = np.mgrid[:188, :336] + 0.5
    blob = np.exp(-((xx - distorted[0]) ** 2 + (yy - distorted[1]) ** 2) / 18.0)
    seen = view.image(np.repeat((255 * blob)[..., None], 3, 2).astype(np.uint8))[..., 0].astype(float)
    rows, columns = np.mgrid[:66, :200] + 0.5
    centre = [(seen * columns).sum() / seen.sum(), (seen * rows).sum() / seen.sum()]
    np.testing.assert_allclose(centre, VIEW.pinhole.project(point)[0], atol=0.15)


def test_round_trip_and_errors() -> None:
    view = PolicyView(CAMERA, distortion=(0.1, 0.0, 0.0, 0.0))
    assert PolicyView.from_dict(json.loads(json.dumps(view.to_dict()))) == view
    with pytest.raises(ValueError, match="expected a uint8 image"):
        VIEW.image(np.zeros((188, 336, 3), np.float32))
    with pytest.raises(ValueError, match="crop inside"):
        PolicyView(CAMERA, crop_top_px=100)
    with pytest.raises(ValueError, match=r"PolicyView\.to_dict"):
        PolicyView.from_dict({"camera": {}})


def test_columns_outside_the_crop_are_not_seen() -> None:
    view = PolicyView(CAMERA, crop_left_px=20, crop_width_px=300)
    image = np.full((188, 336, 3), 255, np.uint8)
    image[24:135, 20:320] = 7
    assert (view.image(image) == 7).all()
    points = np.array([[0.3, 0.1, 1.0], [-0.5, 0.2, 2.0]])
    scale = np.array([200 / 300, 66 / 111])
    np.testing.assert_allclose(view.pinhole.project(points), (CAMERA.project(points) - [20, 24]) * scale)
    with pytest.raises(ValueError, match="crop inside"):
        PolicyView(CAMERA, crop_left_px=100, crop_width_px=300)
