"""The monitor of an experiment: what is shown, at what angle it is seen, and its measured colours against the optics of the twin."""

from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.display import DisplayModel
from advnerf_core.fields.voxel_grid import face_corners_in_object
from advnerf_core.geometry import invert_transform, planar_pose, transform_points
from calibration.by_construction import LAB_DATE, twin_calibrations
from calibration.display_colour import DisplayCalibration
from calibration.schema import BY_CONSTRUCTION, CalibrationError, save_calibration
from hardware.worlds.lab.config import MonitorOpticsConfig
from hardware.worlds.lab.world import MONITOR_PIXELS
from nodes.experiment.show import faces, screen
from nodes.experiment.steps.run import load_experiment
from tests.support.faces import centre_square

LAUNCH = Path(__file__).parents[3] / "launch"
# A dim and reddish monitor in a lit room.
SEEN_AS = DisplayModel(
    np.tile(np.linspace(0.0, 1.0, 17) ** 2.2, (3, 1)),
    np.array([[0.7, 0.1, 0.0], [0.05, 0.5, 0.05], [0.0, 0.1, 0.3]]),
    np.array([0.02, 0.02, 0.03]),
    response=2.2,
    falloff=1.4,
)
SHOWN = np.array([0.8, 0.3, 0.6])


@pytest.fixture
def experiment(tmp_path):
    return load_experiment(LAUNCH / "monitor.experiment.yaml", "demo", [], tmp_path)


def test_the_face_is_the_centre_square_and_the_rest_is_black(experiment):
    width, height = MONITOR_PIXELS
    picture = faces.plain_screen(experiment)
    assert picture.shape == (height, width, 3)
    lit = picture.any(axis=2)
    columns = np.flatnonzero(lit.any(axis=0))
    # 0.3362 m of 0.5977 m, in the middle
    assert len(columns) == pytest.approx(width * 0.3362 / 0.5977, abs=1)
    assert columns[0] + columns[-1] == pytest.approx(width - 1, abs=1)
    assert lit.all(axis=0)[columns].all()
    assert (picture[lit] == np.round(255 * np.array([0.20, 0.62, 0.28]))).all()


def test_the_face_of_an_attack_is_where_the_calibrated_monitor_will_show_it(experiment):
    corners = face_corners_in_object(faces.panel_of(experiment).square_m)
    target = centre_square(twin_calibrations(experiment.named_world.config)["monitor"])
    assert target.subject == faces.wanted_face(experiment).panel == "monitor"
    assert np.abs(corners - target.corners).max() < 1e-6


def test_the_mean_viewing_angle_is_that_of_the_drive(experiment):
    # Straight stretch before the corner, by plane geometry: the camera 0.3 m before the axle, at 0.2 m, the screen's middle at 0.28 m.
    monitor = experiment.named_world.config.monitor
    cosines = []
    for x_m in -1.1 + 0.08 * np.arange(26):
        away = np.array([x_m + 0.3 - monitor.x_m, -2.0 - monitor.y_m, 0.2 - monitor.z_m])
        cosines.append(away @ [np.cos(monitor.yaw_rad), np.sin(monitor.yaw_rad), 0.0] / np.linalg.norm(away))
    cosine = faces.mean_cos_angle(experiment)
    assert min(cosines) - 0.05 < cosine < max(cosines)


def grey_room(poses, pinhole):
    """A learned scene in which there is nothing but grey, 9 m away."""
    size = (len(poses), pinhole.height, pinhole.width)
    return torch.full((*size, 3), 0.5), torch.full(size, 9.0)


def seen_on_the_face(sensor, experiment):
    """Colour ``[3]`` of the face's middle from a car 1.1 m before it, when all of it shows one colour."""
    face, mount = faces.panel_of(experiment).T_world_from_face, experiment.mount
    x_m, y_m, _ = (face @ [1.1, 0.0, 0.0, 1.0])[:3]
    heading_rad = np.arctan2(*(face[:2, 3] - [x_m, y_m])[::-1])
    state = torch.tensor([[x_m, y_m, heading_rad]], dtype=torch.float64)
    theta = torch.logit(torch.tensor(SHOWN, dtype=torch.float32)).expand(sensor.theta_shape)
    camera = planar_pose(x_m, y_m, heading_rad) @ mount
    column, row = experiment.view.pinhole.project(transform_points(invert_transform(camera), face[:3, 3]))
    return sensor.sense(state, theta).images[0, :, int(row), int(column)].numpy()


@pytest.mark.parametrize(
    ("file", "display_model", "seen"),
    [("monitor", True, "the display"), ("monitor", False, "as shown"), ("room", True, "as shown")],
)
def test_an_attack_looks_through_the_display_model_where_a_monitor_shows_it_and_it_is_on(
    tmp_path, file, display_model, seen
):
    changes = [f"carrier.display_model={str(display_model).lower()}"] if file == "monitor" else []
    asked = load_experiment(LAUNCH / f"{file}.experiment.yaml", "demo", changes, tmp_path)
    asked.calibration_folder.mkdir(parents=True)
    save_calibration(
        DisplayCalibration(date=LAB_DATE, method=BY_CONSTRUCTION, model=SEEN_AS.to_dict()),
        asked.calibration_folder / faces.DISPLAY,
    )
    space = faces.face_space(asked, grey_room)
    sensor = space.sensor
    colour = seen_on_the_face(sensor, asked)
    # The law in numpy, which the sensor's torch knows nothing of.
    displayed = SEEN_AS.forward(SHOWN, faces.mean_cos_angle(asked))
    assert np.abs(displayed - SHOWN).max() > 0.2
    assert colour == pytest.approx(displayed if seen == "the display" else SHOWN, abs=1e-4)
    assert isinstance(sensor, DisplayedSensor) is (seen == "the display")
    assert (sensor is space.surrogate) is (seen == "as shown")


def test_a_display_model_that_was_never_measured_is_one_clear_error(experiment):
    with pytest.raises(CalibrationError, match=r"display\.yaml"):
        faces.face_space(experiment, grey_room)


@pytest.mark.slow
def test_the_measured_colours_are_those_of_the_optics(experiment):
    optics = experiment.named_world.config.monitor_optics
    assert optics == MonitorOpticsConfig.office()
    with experiment.open_world() as world:
        fit = screen.measure_display(world, "monitor", faces.panel_of(experiment))
    assert fit.rmse(True) < 0.02
    assert fit.model.falloff == pytest.approx(optics.falloff, abs=0.3)
    shown = np.random.default_rng(0).random((50, 3))
    light = np.array(optics.glare) + shown ** np.array(optics.gamma) @ np.array(optics.mixing).T
    assert np.abs(fit.model.forward(shown) - light ** (1 / optics.response)).max() < 0.03
