"""The monitor's optics in the lab: closed form for plain colours, from where the camera is, and nothing at all by default."""

import numpy as np
import pytest

from advnerf_core.geometry import look_at, planar_pose
from hardware.worlds.lab.config import LabConfig, MonitorOpticsConfig
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.monitor import ScreenOptics

OFFICE = MonitorOpticsConfig.office()
PANEL = LabConfig().monitor


def closed_form(shown, cosine):
    light = np.asarray(OFFICE.mixing) @ (np.asarray(shown) ** np.asarray(OFFICE.gamma))
    return (np.asarray(OFFICE.glare) + cosine**OFFICE.falloff * light) ** (1.0 / OFFICE.response)


def place_before(distance_m, angle_rad):
    """A place before the monitor's middle, seen at an angle to its normal."""
    T = PANEL.T_world_from_face
    return T[:3, 3] + distance_m * (np.cos(angle_rad) * T[:3, 0] + np.sin(angle_rad) * T[:3, 1])


@pytest.mark.parametrize("angle_rad", [0.0, 0.9])
def test_a_plain_colour_is_seen_as_the_closed_form_says(angle_rad):
    optics = ScreenOptics(OFFICE, PANEL, (64, 36))
    shown = np.array([200, 90, 40], np.uint8)
    optics.show(np.full((4, 4, 3), shown))
    place = place_before(5.0, angle_rad)
    middle = optics.seen_from(place)[18, 32] / 255.0
    np.testing.assert_allclose(middle, closed_form(shown / 255.0, np.cos(angle_rad)), atol=0.004)


def test_near_by_the_far_side_is_dimmer():
    optics = ScreenOptics(OFFICE, PANEL, (64, 36))
    optics.show(np.full((4, 4, 3), 200, np.uint8))
    seen = optics.seen_from(place_before(0.5, 0.8)).astype(int)
    # Who stands at the panel's +y sees that side straighter; +y is the viewer's right, the last column.
    assert seen[18, -1, 1] > seen[18, 0, 1] + 5


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="gamma > 0 and glare >= 0"):
        MonitorOpticsConfig(gamma=(0.0, 1.0, 1.0))


def test_the_cameras_see_it_and_the_default_lab_does_not_change():
    at = planar_pose(1.85, 2.2, 0.5 * np.pi)
    shown = np.full((9, 16, 3), (180, 120, 60), np.uint8)
    rgb = {}
    for name, optics in (("ideal", MonitorOpticsConfig()), ("office", OFFICE)):
        with Lab(LabConfig(monitor_optics=optics, shadows=False)) as lab:
            lab.show("monitor", shown)
            image = lab.observe_held(at)
            np.testing.assert_array_equal(image, lab.observe_at(1.85, 2.2, 0.5 * np.pi, depth=False)[0])
            T = lab.config.camera.T_car_from_camera
            inside = np.linalg.inv(at @ T) @ np.append(PANEL.T_world_from_face[:3, 3], 1.0)
            column, row = lab.camera_pinhole.project(inside[:3]).astype(int)
            rgb[name] = image[row - 3 : row + 3, column - 3 : column + 3].reshape(-1, 3).mean(axis=0) / 255.0
            if name == "office":
                to_camera = (at @ T)[:3, 3] - PANEL.T_world_from_face[:3, 3]
                cosine = PANEL.T_world_from_face[:3, 0] @ to_camera / np.linalg.norm(to_camera)
                tilted = look_at((at @ T)[:3, 3] + [0.1, 0.0, 0.3], PANEL.T_world_from_face[:3, 3])
                assert lab.photograph(tilted).shape[2] == 3
    np.testing.assert_allclose(rgb["ideal"], np.array([180, 120, 60]) / 255.0, atol=0.006)
    np.testing.assert_allclose(
        rgb["office"], closed_form(np.array([180, 120, 60]) / 255.0, cosine), atol=0.012
    )
