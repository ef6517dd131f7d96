"""The monitor of an experiment: what is shown, at what angle it is seen, and its measured colours against the optics of the twin."""

from pathlib import Path

import numpy as np
import pytest

from calibration.by_construction import write_twin_calibrations
from calibration.schema import save_calibration
from hardware.twin.config import MonitorOpticsConfig
from hardware.twin.lab import Lab
from hardware.twin.world import MONITOR_PIXELS
from nodes.experiment import screen
from nodes.experiment.context import CALIBRATION
from nodes.experiment.run import load_experiment

LAUNCH = Path(__file__).parents[3] / "launch"


@pytest.fixture
def experiment(tmp_path):
    loaded = load_experiment(LAUNCH / "monitor.experiment.yaml", "demo", [], tmp_path)
    write_twin_calibrations(loaded.lab_config, tmp_path / "capture" / CALIBRATION)
    return loaded


def test_the_face_is_the_centre_square_and_the_rest_is_black(experiment):
    width, height = MONITOR_PIXELS
    picture = screen.plain_picture(experiment)
    assert picture.shape == (height, width, 3)
    lit = picture.any(axis=2)
    columns = np.flatnonzero(lit.any(axis=0))
    # 0.3362 m of 0.5977 m, in the middle
    assert len(columns) == pytest.approx(width * 0.3362 / 0.5977, abs=1)
    assert columns[0] + columns[-1] == pytest.approx(width - 1, abs=1)
    assert lit.all(axis=0)[columns].all()
    assert (picture[lit] == np.round(255 * np.array([0.20, 0.62, 0.28]))).all()


def test_the_face_of_an_attack_is_where_the_monitor_will_show_it(experiment):
    corners = experiment.target.corners
    assert experiment.target.subject == "monitor"
    assert np.ptp(corners[:, 1]) == pytest.approx(experiment.face_m, abs=1e-5)
    assert np.abs(corners.mean(axis=0)).max() < 1e-5


def test_the_mean_viewing_angle_is_that_of_the_drive(experiment):
    # Straight stretch before the corner, by plane geometry: the camera 0.3 m before the axle, at 0.2 m, the screen's middle at 0.28 m.
    monitor = experiment.lab_config.monitor
    cosines = []
    for x_m in -1.1 + 0.08 * np.arange(26):
        away = np.array([x_m + 0.3 - monitor.x_m, -2.0 - monitor.y_m, 0.2 - monitor.z_m])
        cosines.append(away @ [np.cos(monitor.yaw_rad), np.sin(monitor.yaw_rad), 0.0] / np.linalg.norm(away))
    cosine = screen.mean_cos_angle(experiment)
    assert min(cosines) - 0.05 < cosine < max(cosines)


@pytest.mark.slow
def test_the_measured_colours_are_those_of_the_optics(experiment):
    optics = experiment.lab_config.monitor_optics
    assert optics == MonitorOpticsConfig.office()
    with Lab(experiment.lab_config) as lab:
        fit = screen.measure_display(lab)
    save_calibration(fit.calibration(), experiment.calibration_file("display"))
    assert fit.rmse(True) < 0.02
    assert fit.model.falloff == pytest.approx(optics.falloff, abs=0.3)
    shown = np.random.default_rng(0).random((50, 3))
    light = np.array(optics.glare) + shown ** np.array(optics.gamma) @ np.array(optics.mixing).T
    assert np.abs(experiment.display.forward(shown) - light ** (1 / optics.response)).max() < 0.03
