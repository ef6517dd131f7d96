"""Calibration files: what is accepted, what is refused with which words, and that the shipped ones are the twin's truth."""

import datetime
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from advnerf_core.geometry import make_transform, transform_points
from calibration.by_construction import twin_calibrations, write_twin_calibrations
from calibration.schema import (
    CalibrationError,
    CameraCalibration,
    RoomCalibration,
    TargetCalibration,
    VehicleCalibration,
    load_calibration,
    measured,
    save_calibration,
)
from hardware.motor.limits import VehicleGains
from hardware.worlds.lab.config import CameraConfig, LabConfig
from tests.support.faces import outward_normal

SHIPPED = Path(__file__).parents[2] / "calibration" / "twin"
MODELS = {
    "camera": CameraCalibration,
    "vehicle": VehicleCalibration,
    "board": TargetCalibration,
    "monitor": TargetCalibration,
    "room": RoomCalibration,
}


# A camera's rotation, its axes in the car's: it looks ahead, upright (OpenCV).
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
PATH = yaml.safe_load((SHIPPED / "room.yaml").read_text())["path"]


def mounted(R_car_from_camera, x_m=0.3):
    return make_transform(R_car_from_camera, [x_m, 0.0, 0.2]).tolist()


@pytest.mark.parametrize("name", sorted(MODELS))
def test_shipped_files_are_those_of_the_default_lab(name):
    assert load_calibration(MODELS[name], SHIPPED / f"{name}.yaml") == twin_calibrations(LabConfig())[name]


def test_numbers_of_the_default_lab():
    camera = load_calibration(CameraCalibration, SHIPPED / "camera.yaml")
    assert camera.pinhole.fx == pytest.approx(173.97, abs=0.01)
    # A point straight ahead on the floor: where the optical axis, 10 degrees down from 0.2 m up, hits it.
    hit_x = 0.30 + 0.20 / np.tan(np.radians(10.0))
    in_camera = transform_points(np.linalg.inv(camera.mount), [[hit_x, 0.0, 0.0]])
    assert camera.pinhole.project(in_camera)[0] == pytest.approx([168.0, 94.0], abs=1e-6)
    room = load_calibration(RoomCalibration, SHIPPED / "room.yaml")
    assert room.start_pose == pytest.approx((-1.1, -2.0, 0.0))
    assert room.reference_path.length_m == pytest.approx(4 * 1.8 + 2 * np.pi * 1.1)
    assert np.abs(room.fence_m).max() == 3.5
    vehicle = load_calibration(VehicleCalibration, SHIPPED / "vehicle.yaml")
    assert vehicle.vehicle_gains == VehicleGains()
    assert vehicle.drive_limits.steering_max_rad == pytest.approx(0.3135, abs=1e-4)
    assert vehicle.drive_limits.steering_min_rad == pytest.approx(-0.2634, abs=1e-4)


@pytest.mark.parametrize("name", ["board", "monitor"])
def test_faces_look_where_their_subject_looks(name):
    lab = LabConfig()
    panel = getattr(lab, name)
    target = load_calibration(TargetCalibration, SHIPPED / f"{name}.yaml")
    assert outward_normal(target) == pytest.approx([1.0, 0.0, 0.0])
    corners = transform_points(panel.T_world_from_face, target.corners)
    assert corners.mean(axis=0) == pytest.approx([panel.x_m, panel.y_m, panel.z_m])
    # The board faces a driver on the bottom straight, who sees +y of the world on the left.
    if name == "board":
        assert corners[0, 1] > corners[1, 1]
    assert corners[0, 2] > corners[3, 2]


def test_another_lab_gets_its_own_files(tmp_path):
    paths = write_twin_calibrations(LabConfig(camera=CameraConfig(width=366)), tmp_path)
    assert load_calibration(CameraCalibration, paths["camera"]).width == 366


def edited(tmp_path, name, **changes):
    data = yaml.safe_load((SHIPPED / f"{name}.yaml").read_text())
    data.update(changes)
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in data.items() if v is not ...}))
    return path


@pytest.mark.parametrize(
    ("name", "changes", "words"),
    [
        ("camera", {"zoom": 2}, "unknown key zoom; valid keys here: .*width"),
        ("camera", {"fx": -1.0}, "fx"),
        ("camera", {"fx": float("nan")}, "fx"),
        ("camera", {"fx": 1.7}, "got fx 1.7.*if they are normalised, multiply fx and cx by the width"),
        ("camera", {"cx": 5000.0}, "cx 5000"),
        ("camera", {"date": ...}, "date"),
        ("camera", {"kind": "vehicle"}, "kind"),
        (
            "camera",
            {"T_car_from_camera": np.diag([1.0, 1.0, -1.0, 1.0]).tolist()},
            "T_car_from_camera.*rotation",
        ),
        ("camera", {"T_car_from_camera": np.diag([2.0, 1.0, 1.0, 1.0]).tolist()}, "off by"),
        ("board", {"corners_in_subject_m": [[0, 0, 0]] * 4}, "span a face"),
        (
            "board",
            {"corners_in_subject_m": [[0, -1, 1], [0, 1, 1], [0.1, 1, -1], [0, -1, -1]]},
            "100.0 mm off",
        ),
        ("room", {"fence_m": [[0, 0], [1, 1]]}, "fence_m"),
        ("room", {"path": {"segments": []}}, "path"),
        ("room", {"start_pose": [-1.1, -2.0, 90]}, "as degrees that is 1.5708"),
        ("room", {"start_pose": [-1100.0, -2000.0, 0.0]}, "expected start_pose inside fence_m"),
        ("room", {"off_track_m": 40.0}, "cm or mm"),
        ("room", {"fence_m": [[-4, -4], [4, 4], [4, -4], [-4, 4]]}, "edges do not cross"),
        ("room", {"fence_m": [[-4, -2], [0, -2], [4, -2]]}, "on a line"),
        ("room", {"fence_m": [[-4000, -4000], [4000, -4000], [4000, 4000], [-4000, 4000]]}, "is it in mm"),
        (
            "room",
            {"fence_m": [[10, 10], [11, 10], [11, 11]], "start_pose": [10.8, 10.2, 0.0]},
            "path inside fence_m",
        ),
        (
            "board",
            {"corners_in_subject_m": [[0, -500, 500], [0, 500, 500], [0, 500, -500], [0, -500, -500]]},
            "cm or mm",
        ),
        ("camera", {"latency_s": 4.0}, "1 s, not ms"),
        ("vehicle", {"wheelbase_m": 15.0}, "8 m, not cm or mm"),
        ("camera", {"T_car_from_camera": mounted(AHEAD, 19.0)}, r"at most 5 m from .*; is it in cm or mm"),
        (
            "room",
            {"fence_m": [[-350, -350], [350, -350], [350, 350], [-350, 350]]},
            r"25 times the path's extent of 4 m, got 700 m",
        ),
        (
            "board",
            {"corners_in_subject_m": [[0, -50, 100], [0, 50, 100], [0, 50, 0], [0, -50, 0]]},
            "at most 20 m",
        ),
        (
            "board",
            {"corners_in_subject_m": [[0, -1, 2], [0, 1, 2], [0, -1, 0], [0, 1, 0]]},
            "rectangle in the order",
        ),
        (
            "board",
            {"corners_in_subject_m": [[0, -1, 2], [0, 1, 3], [0, 1, 1], [0, -1, 0]]},
            "rectangle in the order",
        ),
        *(
            ("room", {"path": PATH | change}, told)
            for change, told in (
                ({"radius_cm": 5}, r"expected a path \{start_pose"),
                ({"segments": [{"line_m": 1.8, "arc_radius_m": 1.1, "arc_angle_rad": 1.5}]}, "no segment is"),
                ({"segments": [{"line_m": 1.8, "colour": "red"}]}, "no segment is"),
                ({"segments": [{"line_m": True}]}, "no number is True"),
                ({"closed": "no"}, "expected closed of a path to be true or false, got 'no'"),
            )
        ),
    ],
)
def test_wrong_files_are_one_clear_error(tmp_path, name, changes, words):
    path = edited(tmp_path, name, **changes)
    with pytest.raises(CalibrationError, match=words) as error:
        load_calibration(MODELS[name], path)
    assert str(error.value).startswith(f"{path}:")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "rotation", [np.eye(3), AHEAD * [1, -1, -1], AHEAD * [-1, -1, 1]], ids=["none", "OpenGL", "upside down"]
)
def test_a_camera_that_looks_elsewhere_has_no_mount_and_still_a_lens(tmp_path, rotation):
    camera = load_calibration(
        CameraCalibration, edited(tmp_path, "camera", T_car_from_camera=mounted(rotation))
    )
    assert camera.pinhole.width == 336
    with pytest.raises(CalibrationError, match=r"expected a camera that looks ahead, upright, .*; got "):
        _ = camera.mount
    ahead = edited(tmp_path, "camera", T_car_from_camera=mounted(AHEAD))
    np.testing.assert_array_equal(load_calibration(CameraCalibration, ahead).mount[:3, :3], AHEAD)


@pytest.mark.parametrize(
    ("section", "values", "words"),
    [
        ("limits", {"speed_max_mps": -1.0}, "around zero"),
        ("limits", {"speed_max_mps": 100.0}, "km/h"),
        (
            "limits",
            {"steering_max_rad": 18.0},
            "limits.steering_max_rad: expected at most 1.5708 rad, not degrees",
        ),
        ("limits", {"steering_min_rad": -15.0}, "degrees"),
        ("limits", {"steering_rate_radps": 183.0}, "degrees/s"),
        ("limits", {"current_max_a": 60000.0}, "mA"),
        ("gains", {"servo_offset": 5.0}, "servo_offset between them"),
        ("gains", {"servo_offset": 0.9}, "servo_offset between them"),
        ("gains", {"servo_per_rad": -0.0212}, "per degree"),
        ("gains", {"erpm_per_mps": 4.614e9}, "is it per km/h or per mm/s"),
        ("gains", {"erpm_per_mps": 4.614}, "is it per km/h or per mm/s"),
        ("gains", {"erpm_offset": 5000.0}, "at most 0.3 m/s, the wheels stand still"),
    ],
)
def test_impossible_sections_are_found_when_the_file_is_read(tmp_path, section, values, words):
    changed = yaml.safe_load((SHIPPED / "vehicle.yaml").read_text())[section] | values
    with pytest.raises(CalibrationError, match=words):
        load_calibration(VehicleCalibration, edited(tmp_path, "vehicle", **{section: changed}))


def test_the_bounds_hold_a_lorry_and_a_motorway(tmp_path):
    vehicle = yaml.safe_load((SHIPPED / "vehicle.yaml").read_text())
    limits = vehicle["limits"] | {"speed_max_mps": 36.0, "steering_max_rad": 1.2, "current_max_a": 400.0}
    load_calibration(VehicleCalibration, edited(tmp_path, "vehicle", wheelbase_m=6.5, limits=limits))
    load_calibration(CameraCalibration, edited(tmp_path, "camera", latency_s=0.4))


def test_what_was_measured_impossibly_is_one_clear_error(tmp_path):
    vehicle = load_calibration(VehicleCalibration, SHIPPED / "vehicle.yaml")
    values = {name: getattr(vehicle, name) for name in VehicleCalibration.model_fields}
    assert measured(VehicleCalibration, **values) == vehicle
    with pytest.raises(CalibrationError, match="what was measured: wheelbase_m: expected at most 8 m"):
        measured(VehicleCalibration, **values | {"wheelbase_m": 325.0})


def test_missing_and_unreadable_files(tmp_path):
    with pytest.raises(CalibrationError, match="no such calibration file"):
        load_calibration(CameraCalibration, tmp_path / "none.yaml")
    (tmp_path / "bad.yaml").write_text("a: [1, 2")
    with pytest.raises(CalibrationError, match=r"bad\.yaml:1: expected valid YAML"):
        load_calibration(CameraCalibration, tmp_path / "bad.yaml")
    (tmp_path / "tag.yaml").write_text("!!python/object/apply:os.system ['true']")
    with pytest.raises(CalibrationError, match=r"tag\.yaml:1: expected valid YAML: remove the tag"):
        load_calibration(CameraCalibration, tmp_path / "tag.yaml")


def target_file():
    return TargetCalibration(
        date=datetime.date(2026, 1, 2),
        method="ruler",
        subject="sign",
        corners_in_subject_m=((0, 0, 1), (0, 1, 1), (0, 1, 0), (0, 0, 0)),
    )


def test_nothing_is_left_half_written(tmp_path):
    target = target_file()
    save_calibration(target, tmp_path / "sign.yaml")
    assert load_calibration(TargetCalibration, tmp_path / "sign.yaml") == target
    with pytest.raises(CalibrationError, match="cannot write"):
        save_calibration(target, tmp_path / "sign.yaml" / "sign.yaml")
    assert [p.name for p in tmp_path.iterdir()] == ["sign.yaml"]


def test_a_calibration_replaces_only_its_own_kind(tmp_path):
    target, room = target_file(), tmp_path / "room.yaml"
    shutil.copy(SHIPPED / "room.yaml", room)
    (tmp_path / "my.experiment.yaml").write_text("place: {world: {kind: lab}}\n")
    (tmp_path / "notes.txt").write_text("- milk: [\n")
    for name, got in (
        ("room.yaml", "of the kind room"),
        ("my.experiment.yaml", "no calibration"),
        ("notes.txt", "no calibration"),
    ):
        before = (tmp_path / name).read_bytes()
        with pytest.raises(CalibrationError, match=rf"of the kind target .*{name}, which is {got}"):
            save_calibration(target, tmp_path / name)
        assert (tmp_path / name).read_bytes() == before
    (tmp_path / "new.yaml").touch()
    for _ in range(2):
        save_calibration(target, tmp_path / "new.yaml")
