"""A print measured in ray-traced photographs: from many angles, in three lights, covered, bent, out of focus. Right, or refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from advnerf_core.attack.printing.frame import CHART_SET, frame_around
from advnerf_core.attack.printing.poster import Printable
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.geometry import invert_transform, make_transform, rotation_x, transform_points
from calibration.degeneracy import DegenerateDataError, PoorFitError
from calibration.print_drive import PrintView, place_print
from calibration.print_markers import find_markers, why_none
from calibration.print_measurement import of_drive, of_photograph
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


def seen_corners(T_camera_from_face, moved_m, rng):
    """Pixels of all markers through the pinhole, with noise; ``moved_m`` are shifts ``[3]`` of some of them on the sheet."""
    found = {}
    for number, corners in FRAME.corners_m.items():
        glued = corners + np.array(moved_m.get(number, (0.0, 0.0, 0.0)))
        pixels = LENS.pinhole.project(transform_points(T_camera_from_face, glued))
        found[number] = pixels + rng.normal(0.0, 0.05, pixels.shape)
    return found


def measured_photograph(moved_m):
    markers = seen_corners(before_camera(0.7, 20, 8, 3), moved_m, np.random.default_rng(0))
    pose = fit_print(markers, FRAME.corners_m, LENS.pinhole)
    return of_photograph("p.png", (0.3, 0.3), len(FRAME.corners_m), pose, ("the width", 1.1, 0.0), None)


def measured_drive(moved_m):
    rng, views = np.random.default_rng(0), []
    for k, turn_deg in enumerate(np.linspace(-30, 30, 7)):
        T = before_camera(0.5 + 0.05 * k, turn_deg, 5)
        T_world_from_camera = invert_transform(T)
        T_world_from_camera[:3, 3] *= 1.1
        views.append(PrintView(seen_corners(T, moved_m, rng), T_world_from_camera))
    placed = place_print(views, FRAME.corners_m, LENS.pinhole)
    return of_drive("bag", (0.3, 0.3), len(FRAME.corners_m), placed, 0.001)


@pytest.mark.parametrize("measured", [measured_photograph, measured_drive])
@pytest.mark.parametrize("shift_mm", [(12.0, 0.0), (0.0, -12.0)])
def test_a_marker_that_is_glued_off_its_place_is_named_with_its_distance(measured, shift_mm):
    """The print is a tenth larger than it says, and so is the distance."""
    number = max(FRAME.corners_m)
    found = measured({number: (0.0, *np.multiply(shift_mm, 0.001))})
    off = found.markers_off_mm
    assert max(off, key=off.get) == number
    assert off[number] == pytest.approx(1.1 * 12.0, abs=1.3)
    said = dict(found.lines)["fit"]
    assert f"marker {number} is the farthest off, by 1" in said
    assert "is a part of the print glued off its place?" in said
    right = dict(measured({}).lines)["fit"]
    assert "is the farthest off, by 0." in right
    assert "glued" not in right


def test_a_print_in_parts_that_do_not_meet_is_refused_with_the_worst_marker():
    right_half = [number for number, corners in FRAME.corners_m.items() if corners[:, 1].mean() > 0.0]
    with pytest.raises(
        PoorFitError, match=r"the farthest, marker \d+, \d+\.\d mm off; .*glued off its place"
    ):
        measured_photograph(dict.fromkeys(right_half, (0.0, 0.0, 0.012)))
