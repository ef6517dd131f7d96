import json

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens, straightening
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Pinhole

SIZE = (160, 120)
PINHOLE = Pinhole(*SIZE, 70.0, 72.0, 79.0, 61.0)
FISHEYE = Lens((0.03, -0.01, 0.004, -0.001), fisheye=True)
BROWN = Lens((-0.2, 0.03, 0.001, -0.002, 0.0))


def fisheye_pixel(direction):
    """Kannala and Brandt, written out."""
    x, y, z = direction
    r = np.hypot(x, y)
    t = np.arctan2(r, z)
    k1, k2, k3, k4 = FISHEYE.coefficients
    d = t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8)
    return np.array([PINHOLE.fx * d * x / r + PINHOLE.cx, PINHOLE.fy * d * y / r + PINHOLE.cy])


def brown_pixel(direction):
    x, y = direction[:2] / direction[2]
    k1, k2, p1, p2, k3 = BROWN.coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.array([PINHOLE.fx * u + PINHOLE.cx, PINHOLE.fy * v + PINHOLE.cy])


def dot_at(pixel):
    rows, columns = np.mgrid[0 : SIZE[1], 0 : SIZE[0]] + 0.5
    return (255 * np.exp(-((columns - pixel[0]) ** 2 + (rows - pixel[1]) ** 2) / 8.0)).astype(np.uint8)


def centre_of(image):
    seen = image.astype(float)
    rows, columns = np.mgrid[0 : image.shape[0], 0 : image.shape[1]] + 0.5
    return np.array([(seen * columns).sum(), (seen * rows).sum()]) / seen.sum()


@pytest.mark.parametrize("keep_all", [False, True])
@pytest.mark.parametrize(
    ("lens", "pixel_of"), [(FISHEYE, fisheye_pixel), (BROWN, brown_pixel)], ids=["fisheye", "brown"]
)
def test_a_direction_ends_where_the_pinhole_puts_it(lens, pixel_of, keep_all):
    straight = straightening(PINHOLE, lens, keep_all)
    for direction in np.array([[0.3, -0.2, 1.0], [-0.5, 0.4, 1.0], [0.02, 0.01, 1.0]]):
        np.testing.assert_allclose(lens.distort(direction, PINHOLE)[0], pixel_of(direction), atol=1e-6)
        found = centre_of(straight.apply(dot_at(pixel_of(direction))))
        np.testing.assert_allclose(found, straight.pinhole.project(direction), atol=0.25)


@pytest.mark.parametrize("lens", [FISHEYE, BROWN])
def test_cropping_leaves_no_gap_and_keeping_all_says_where_they_are(lens):
    white = np.full((SIZE[1], SIZE[0]), 255, np.uint8)
    cropped, whole = straightening(PINHOLE, lens), straightening(PINHOLE, lens, keep_all=True)
    assert cropped.valid is None
    assert whole.valid is not None
    assert 0.3 < whole.valid.mean() < 1.0
    # Every direction at the border of the cropped image was seen by the lens.
    border = cropped.pinhole.directions()[[0, -1]].reshape(-1, 3)
    pixels = lens.distort(border, PINHOLE)
    assert pixels.min() > -1.5
    assert (pixels < np.array(SIZE) + 1.5).all()
    # A valid pixel's direction was seen too, an invalid one's was not.
    seen = lens.distort(whole.pinhole.directions().reshape(-1, 3), PINHOLE).reshape(*SIZE[::-1], 2)
    inside = ((seen >= 0.5) & (seen <= np.array(SIZE) - 0.5)).all(axis=-1)
    assert (inside == whole.valid).mean() > 0.99
    assert whole.apply(white).shape == white.shape


def test_a_lens_wider_than_a_pinhole_is_cropped_to_what_one_can_hold():
    wide = Pinhole(400, 400, 120.0, 120.0, 200.0, 200.0)  # 190 degrees across
    straight = straightening(wide, Lens((0.0, 0.0, 0.0, 0.0), fisheye=True), keep_all=True)
    assert 0.5 * 400 / straight.pinhole.fx == pytest.approx(np.tan(np.deg2rad(70.0)), rel=0.01)


def test_an_absurd_lens_is_refused_with_its_camera_and_advice_that_can_be_followed(tmp_path):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "camera_id": "ten/03"}
    file = write(tmp_path, k1=-3.0, k2=-1.6e8, frames=[frame])
    with pytest.raises(
        DatasetError, match=r"a\.png \(camera ten/03\): .*Remove the frames of this camera .*from-images"
    ):
        load_transforms(file).load()


@pytest.mark.parametrize("size", [(2**40, 48), (40_000, 48), (30_000, 30_000)])
def test_an_image_that_opencv_cannot_map_is_refused(size):
    with pytest.raises(DatasetError, match=r"expected an image of at most 32766 px a side .* got \d+ x \d+"):
        straightening(Pinhole(*size, 50.0, 50.0, 32.0, 24.0), Lens())


def test_coefficients_that_fold_the_image_are_refused():
    with pytest.raises(DatasetError, match=r"distortion that can be undone.*k1, k2.*= -3, 0"):
        straightening(PINHOLE, Lens((-3.0, 0.0, 0.0, 0.0, 0.0)))
    with pytest.raises(
        DatasetError, match=r"focal length that fits .* 164 degrees .*correct w and h, or fl_x"
    ):
        straightening(Pinhole(108, 192, 13.8, 13.8, 5.4, 9.6), Lens((0.058, -0.08, 0.0, 0.0, 0.0)))
    with pytest.raises(ValueError, match="4 finite distortion coefficients"):
        Lens((0.1, 0.2), fisheye=True)


def write(folder, **content):
    cv2.imwrite(str(folder / "a.png"), np.zeros((*SIZE[::-1], 3), np.uint8))
    file = folder / "transforms.json"
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    file.write_text(json.dumps({"fl_x": 70.0, "frames": [frame], **content}))
    return file


@pytest.mark.parametrize("model", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_both_ways_to_say_fisheye_are_understood(tmp_path, model):
    listed = load_transforms(write(tmp_path, k1=0.03, k2=-0.01, k3=0.004, k4=-0.001, **model))
    assert listed.frames[0].lens == FISHEYE
    assert listed.load().rgb.shape == (1, 120, 160, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            {"camera_model": "EQUIRECTANGULAR"},
            r"frame 0 \(a\.png\): camera_model: expected .*got EQUIRECTANGULAR; undistort",
        ),
        ({"camera_model": "OPENCV", "k4": 0.1}, r"frame 0 \(a\.png\): k4: expected only k1, k2, p1, p2, k3"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, r"p1: expected only k1, k2, k3, k4"),
        ({"k1": "much"}, r"k1: expected a number, got 'much'"),
        ({"k1": float("nan")}, r"k1: expected a finite number"),
    ],
)
def test_a_lens_that_would_be_misread_is_refused(tmp_path, content, message):
    with pytest.raises(DatasetError, match=message):
        load_transforms(write(tmp_path, **content))
