"""A print measured in ray-traced photographs: from many angles, in three lights, covered, bent, out of focus. Right, or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from advnerf_core.attack.printing.frame import CHART_SET, frame_around
from advnerf_core.attack.printing.poster import Printable
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import make_transform, rotation_x
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.print_markers import find_markers, why_none
from calibration.print_pose import fit_print
from calibration.schema import CalibrationError
from tests.support.photographed import before_camera, lens, photograph, scaled

LENS, FINE = lens(640, 480, 520.0), lens(1600, 1200, 1300.0)
RNG = np.random.default_rng(3)
TEXTURE = cv2.resize(RNG.integers(0, 256, (12, 12, 3)).astype(np.uint8), (256, 256))
FRAME = frame_around((0.3, 0.3), 5)
PRINT = Printable(TEXTURE, (0.3, 0.3), FRAME)
CARD_FRAME = frame_around((0.1, 0.1), CHART_SET, 0.045)
CARD = Printable(TEXTURE, (0.1, 0.1), CARD_FRAME)
LIGHTS = {
    "day": {"light": (0.85, 0.85, 0.85), "noise": 1.5},
    "lamp": {"light": (0.8, 0.55, 0.3), "slope": 0.6, "noise": 3.0},
    "dusk": {"light": (0.07, 0.08, 0.12), "slope": -0.3, "noise": 3.0},
}


def fitted(sheets, card=None, card_scale=1.0, seen_by=LENS, **conditions):
    """The pose from a photograph of the print, as the commands find it."""
    image = photograph(sheets, seen_by, **conditions)
    markers = find_markers(image, seen_by, FRAME.corners_m)
    if not markers:
        raise DegenerateDataError(why_none(image))
    beside = None
    if card is not None:
        said = {number: card_scale * corners for number, corners in card.corners_m.items()}
        beside = find_markers(image, seen_by, card.corners_m, "the card"), said
    return fit_print(markers, FRAME.corners_m, seen_by.pinhole, beside)


def errors(found, T):
    """Error of the direction [deg] and of the distance, as a share."""
    R = found.T_camera_from_face[:3, :3].T @ T[:3, :3]
    lengths = [np.linalg.norm(pose[:3, 3]) for pose in (found.T_camera_from_face, T)]
    return np.degrees(rotation_angles(R[None])[0]), abs(lengths[0] / lengths[1] - 1.0)


def poses(count):
    rng = np.random.default_rng(0)
    for _ in range(count):
        turn, tilt, roll = rng.uniform([-70, -35, -30], [70, 35, 30])
        yield before_camera(
            rng.uniform(0.45, 1.1), turn, tilt, roll, rng.uniform(-0.08, 0.08), rng.uniform(-0.05, 0.05)
        )


def right_or_refused(T, **conditions):
    """Whether the photograph was measured; wrong without a word fails."""
    try:
        found = fitted([(PRINT, T)], **conditions)
    except CalibrationError:
        return False
    angle_deg, share = errors(found, T)
    bend_m = conditions.get("bend_m", 0.0)
    assert angle_deg < 1.0, (found, T)
    # The plane of a bent print is somewhere between its middle and its edges.
    assert share < 0.01 + bend_m / np.linalg.norm(T[:3, 3]), (found, T)
    assert found.bend_m == pytest.approx(0.45 * bend_m, abs=max(4.0 * found.bend_sd_m, 0.001))
    return True


@pytest.mark.parametrize("light", LIGHTS)
def test_right_or_refused_from_some_angles(light):
    measured = [right_or_refused(T, **LIGHTS[light]) for T in list(poses(30))[:3]]
    assert any(measured)


@pytest.mark.slow
def test_right_or_refused_from_thirty_angles_in_three_lights_half_covered_and_out_of_focus():
    counts = {}
    for name, conditions in {
        **LIGHTS,
        "half covered": {"covered": 0.5, "seen_by": FINE, "supersampling": 1},
        "half covered, coarse": {"covered": 0.5},
        "mostly covered": {"covered": 0.62},
        "soft": {"blur_px": 1.6},
        "out of focus": {"blur_px": 5.0},
        "bent": {"bend_m": 0.006},
        "badly bent": {"bend_m": 0.03},
    }.items():
        counts[name] = sum(right_or_refused(T, **conditions) for T in poses(30))
    print(counts)
    assert min(counts["day"], counts["lamp"], counts["dusk"]) >= 15
    assert counts["half covered"] >= 10
    assert counts["out of focus"] == counts["badly bent"] == 0


def test_a_card_in_its_plane_gives_the_size():
    T = before_camera(0.7, 20, 8, 4, -0.14)
    beside = T @ make_transform(rotation_x(0.3), [0.0, 0.36, 0.04])
    found = fitted([(CARD, beside), (PRINT, T)], card=CARD_FRAME, card_scale=1.1)
    # A card that is said to be a tenth larger makes the print a tenth larger and farther.
    assert found.card_scale == pytest.approx(1.1, rel=0.005)
    assert abs(np.log(found.card_scale / 1.1)) < 3.0 * found.card_scale_sd
    off = beside @ make_transform(cv2.Rodrigues(np.array([0.0, 0.0, 0.4]))[0], [0.0, 0.0, 0.0])
    with pytest.raises(PoorFitError, match="the card in the plane of the print, got an angle of 2"):
        fitted([(CARD, off), (PRINT, T)], card=CARD_FRAME)


def test_another_aspect_is_noticed():
    T = before_camera(0.55, 5, 3)
    assert fitted([(scaled(PRINT, up=0.98), T)]).aspect == pytest.approx(1.0 / 0.98, abs=0.003)
    assert fitted([(PRINT, T)]).aspect == 1.0


@pytest.mark.parametrize(
    ("sheets", "conditions", "message"),
    [
        ([(PRINT, before_camera(0.55))], {"blur_px": 5.0}, "out of focus"),
        ([(PRINT, before_camera(0.55))], {"covered": 0.63}, "uncover"),
        ([(PRINT, before_camera(2.5))], {}, "go nearer|is too small"),
        ([(PRINT, before_camera(0.55))], {"bend_m": 0.05}, "in one plane"),
        ([(CARD, before_camera(0.4))], {}, "not in view"),
        ([(PRINT, before_camera(0.55))], {"light": (0.001,) * 3, "noise": 0.5}, "check the exposure"),
        ([(PRINT, before_camera(1.0, right_m=-0.25)), (PRINT, before_camera(1.0, right_m=0.25))], {}, "2 times"),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_refused_with_the_reason(sheets, conditions, message):
    with pytest.raises(CalibrationError, match=message):
        fitted(sheets, **conditions)


def test_markers_of_a_swapped_print_do_not_fit():
    wide = frame_around((0.5, 0.3), 5)
    image = photograph([(PRINT, before_camera(0.55))], LENS)
    markers = find_markers(image, LENS, wide.corners_m)
    with pytest.raises(PoorFitError, match=r"is this its \.print\.json"):
        fit_print(markers, wide.corners_m, LENS.pinhole)
