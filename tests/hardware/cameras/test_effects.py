"""The camera's imperfections against closed forms, OpenCV's own projection, and a brute-force exposure."""

import cv2
import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

from advnerf_core.errors import ConfigError
from advnerf_core.geometry import Pinhole
from hardware.cameras import effects
from hardware.cameras.effects import PRESETS, CameraEffects, Effects, ImperfectCamera

PINHOLE = Pinhole(64, 48, 50.0, 50.0, 32.0, 24.0)
STILL = np.zeros(3)


def plain(level: int):
    return lambda state: np.full((PINHOLE.height, PINHOLE.width, 3), level, np.uint8)


def linear(srgb: float) -> float:
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


def picture(seed: int = 0):
    noise = np.random.default_rng(seed).integers(0, 256, (PINHOLE.height, PINHOLE.width, 3))
    return lambda state: cv2.GaussianBlur(noise.astype(np.uint8), (0, 0), 3.0)


def test_an_ideal_camera_hands_out_what_was_drawn():
    drawn = picture()(STILL)
    assert ImperfectCamera(PRESETS["ideal"], PINHOLE).see(lambda state: drawn, STILL, 0.1) is drawn
    assert CameraEffects(seed=7).ideal
    assert not CameraEffects(lost=0.1).ideal
    # Linear light and back loses no grey level.
    levels = np.arange(256, dtype=np.uint8)
    assert np.array_equal(effects._encoded(effects._decoded(levels)), levels)


@pytest.mark.parametrize("level", [30, 120, 220])
def test_noise_has_the_variance_of_the_linear_model(level):
    wanted = CameraEffects(read_noise=0.01, shot_noise=4e-4)
    light = linear(level / 255.0)
    drawn = effects._decoded(plain(level)(STILL))
    camera = ImperfectCamera(wanted, PINHOLE)
    noise = camera._noisy(drawn, np.random.default_rng(0)) - drawn
    # 9216 numbers: the sample deviation is known to 0.74 %, four of which are allowed.
    assert noise.std() == pytest.approx(np.sqrt(0.01**2 + 4e-4 * light), rel=0.03)
    assert abs(noise.mean()) < 4.0 * noise.std() / np.sqrt(noise.size)


def test_gain_and_white_balance_are_constant_over_a_drive_and_differ_between_drives():
    wanted = CameraEffects(gain_sigma=0.2, colour_sigma=0.1)
    seen = np.array(
        [
            [ImperfectCamera(wanted, PINHOLE, drive).see(plain(90), STILL, 0.1)[0, 0] for _ in range(2)]
            for drive in range(300)
        ]
    )
    assert np.array_equal(seen[:, 0], seen[:, 1])
    gains = np.log([[linear(v / 255.0) for v in colour] for colour in seen[:, 0]]) - np.log(linear(90 / 255))
    assert gains[:, 1].std() == pytest.approx(0.2, rel=0.15)  # green: exposure alone
    assert (gains[:, 0] - gains[:, 1]).std() == pytest.approx(0.1, rel=0.15)


@pytest.mark.parametrize("moments", [2, 5])
def test_a_rolling_shutter_leans_and_an_exposure_smears_a_moving_edge(moments):
    # An edge that moves 40 px in a tick of 0.1 s: light right of it.
    def edge(state):
        columns = np.arange(PINHOLE.width) + 0.5
        row = np.clip(columns - 400.0 * state[0] + 0.5, 0.0, 1.0)
        light = np.repeat(row[None, :, None], PINHOLE.height, 0).repeat(3, 2).astype(np.float32)
        return effects._encoded(light)

    def seen(**changes):
        camera = ImperfectCamera(CameraEffects(moments=moments, **changes), PINHOLE)
        camera.see(edge, np.array([0.0, 0.0, 0.0]), 0.1)
        return effects._decoded(camera.see(edge, np.array([0.1, 0.0, 0.0]), 0.1))[..., 0]

    def place(light):  # of the edge in each row [px]
        return PINHOLE.width - light.sum(axis=1)

    leaning = place(seen(readout_s=0.04))
    # The last row is read out now, the first 0.04 s ago, when the edge was 16 px further left.
    assert leaning[-1] == pytest.approx(40.0, abs=0.1)
    assert np.allclose(leaning, 40.0 - 16.0 * (47 - np.arange(48)) / 47, atol=0.15)
    smeared = seen(exposure_s=0.04)
    assert np.allclose(place(smeared), 40.0 - 8.0, atol=0.15)  # the middle of the way
    fading = (smeared[0] > 0.02) & (smeared[0] < 0.98)
    assert fading.sum() == pytest.approx(16, abs=2)
    assert np.array_equal(seen(exposure_s=0.04)[:1].repeat(48, 0), smeared)  # all rows alike


@pytest.mark.parametrize("moments", [2, 3, 5])
def test_row_weights_are_those_of_a_brute_force_exposure(moments):
    wanted = CameraEffects(exposure_s=0.01, readout_s=0.03, moments=moments)
    weights = effects._row_weights(24, wanted)
    assert np.allclose(weights.sum(axis=1), 1.0)
    assert weights.shape == (24, moments)
    drawn_s = np.linspace(-0.04, 0.0, moments)
    for row in range(24):
        end = -0.03 * (23 - row) / 23
        times = np.linspace(end - 0.01, end, 4001)
        hats = [np.interp(times, drawn_s, np.eye(moments)[k]).mean() for k in range(moments)]
        assert np.allclose(weights[row], hats, atol=0.01)


def test_a_point_is_where_opencv_projects_it():
    k1, k2 = -0.2, 0.05
    K = np.array([[50.0, 0.0, 31.5], [0.0, 50.0, 23.5], [0.0, 0.0, 1.0]])  # OpenCV's pixel centres
    for x, y in ((0.35, 0.25), (-0.4, 0.1), (0.0, -0.3)):
        ideal = np.array([50.0 * x + 31.5, 50.0 * y + 23.5])
        columns, rows = np.meshgrid(np.arange(64), np.arange(48))
        blob = np.exp(-0.5 * ((columns - ideal[0]) ** 2 + (rows - ideal[1]) ** 2) / 2.0**2)
        drawn = effects._encoded(np.repeat(blob[..., None], 3, 2).astype(np.float32))
        camera = ImperfectCamera(CameraEffects(k1=k1, k2=k2), PINHOLE)
        light = effects._decoded(camera.see(lambda state, drawn=drawn: drawn, STILL, 0.1))[..., 0]
        centre = [(light * grid).sum() / light.sum() for grid in (columns, rows)]
        expected, _ = cv2.projectPoints(np.array([[x, y, 1.0]]), STILL, STILL, K, np.array([k1, k2, 0, 0]))
        assert centre == pytest.approx(expected.ravel(), abs=0.15)
        assert np.abs(expected.ravel() - ideal).max() > 0.2  # there is something to see


def test_a_lens_that_folds_its_picture_is_refused():
    with pytest.raises(
        ConfigError, match=r"k1 and k2 of a lens that draws the whole picture, got -1 and 0, .* smaller"
    ):
        ImperfectCamera(CameraEffects(k1=-1.0), PINHOLE)


def test_frames_are_lost_as_often_as_asked_but_never_the_first():
    lost = []
    for drive in range(40):
        camera = ImperfectCamera(CameraEffects(lost=0.1), PINHOLE, drive)
        lost.append([camera.see(plain(90), STILL, 0.1) is None for _ in range(101)])
    assert not any(row[0] for row in lost)
    assert np.mean([row[1:] for row in lost]) == pytest.approx(0.1, abs=0.02)


def test_jpeg_loses_what_jpeg_loses_and_keeps_the_order_of_colours():
    drawn = picture()(STILL)
    drawn[:, :32, 0] = 250
    camera = ImperfectCamera(CameraEffects(jpeg_quality=80), PINHOLE)
    seen = camera.see(lambda state: drawn, STILL, 0.1)
    _, data = cv2.imencode(".jpg", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 80])
    assert np.array_equal(seen, cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB))


@pytest.mark.parametrize("name", ["webcam", "zed"])
def test_a_drive_repeats_itself_to_the_byte(name):
    def drive(number):
        camera = ImperfectCamera(PRESETS[name], PINHOLE, number)
        return [camera.see(picture(1), np.array([0.05 * t, 0.0, 0.01 * t]), 0.1) for t in range(5)]

    assert all(np.array_equal(a, b) for a, b in zip(drive(3), drive(3), strict=True))
    assert not np.array_equal(drive(3)[0], drive(4)[0])


def test_a_configuration_names_a_preset_or_the_effects():
    class Config(BaseModel):
        camera: Effects = PRESETS["ideal"]

    assert Config(camera="zed").camera == PRESETS["zed"]
    assert Config(camera={"lost": 0.5}).camera.lost == 0.5
    with pytest.raises(ValidationError, match="expected one of ideal, webcam, zed"):
        Config(camera="phone")
    with pytest.raises(ValidationError, match="less than 1"):
        Config(camera={"lost": 1.0})
