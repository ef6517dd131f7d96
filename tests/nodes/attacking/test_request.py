import numpy as np
import pytest

from nodes.experiment.node.request import load_request, parse_request, request_text
from nodes.runtime.errors import ConfigError

LEAST = """\
scene: scene.safetensors
policy: ../policy.safetensors
calibration: calibration
objects:
  - {x_m: 3.0, y_m: -1.5, z_m: 0.5, yaw_rad: 3.0}
"""


def test_paths_are_relative_to_the_file_and_a_request_survives_its_own_text(tmp_path):
    file = tmp_path / "here" / "corner.attack.yaml"
    file.parent.mkdir()
    file.write_text(LEAST)
    request = load_request(file, ["search.seeds=[3, 4]", "horizon=7"])
    assert request.policy == tmp_path / "policy.safetensors"
    assert request.calibration_file("room") == tmp_path / "here" / "calibration" / "room.yaml"
    assert (request.search.seeds, request.horizon) == ((3, 4), 7)
    assert parse_request(request_text(request)) == request


def test_a_pose_from_position_and_heading_looks_where_it_says():
    pose = parse_request(LEAST).objects[0].pose
    np.testing.assert_allclose(pose[:3, 3], [3.0, -1.5, 0.5])
    np.testing.assert_allclose(pose[:3, 0], [np.cos(3.0), np.sin(3.0), 0.0])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (["horizn=3"], r"--set horizn=3: unknown key horizn; valid keys here: .*horizon"),
        (["search.metod=random"], r"unknown key search.metod; valid keys here: cache_mib"),
        (
            ["search.method=annealing"],
            r"--set search.method=annealing: search.method: expected an attack method of random, .*, cem, .*; got 'annealing'; one of your own",
        ),
        (["search.evaluations=0"], r"search.evaluations: .* greater than or equal to 1"),
        (["objects=[]"], "objects: .* at least 1 item"),
        (["objects=[{kind: face}]"], r"objects.0: expected either T_world_from_object or x_m, y_m and z_m"),
        (["objects=[{kind: file, x_m: 0, y_m: 0, z_m: 0}]"], "expected a file exactly with kind 'file'"),
        (
            ["objects=[{T_world_from_object: [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]"],
            "expected a rotation",
        ),
        (
            ["starts.count=3", "goals=[[1, 0], [0, 1]]"],
            r"expected no goal, one, or 3 \(one per start\), got 2",
        ),
        (["dynamics.delay_s=.nan"], "dynamics.delay_s"),
    ],
)
def test_what_is_wrong_is_one_error_that_says_where(change, message):
    with pytest.raises(ConfigError, match=message):
        parse_request(LEAST, "corner", overrides=change)


def test_the_error_names_file_and_line(tmp_path):
    file = tmp_path / "corner.attack.yaml"
    file.write_text(LEAST + "  - {x_m: 1.0, y_m: 0.0, z_m: 0.0, yaw: 1.0}\n")
    with pytest.raises(
        ConfigError, match=r"corner.attack.yaml:6: unknown key objects.1.yaw; valid keys here: .*yaw_rad"
    ):
        load_request(file)


def test_without_a_calibration_folder_every_file_is_needed():
    with pytest.raises(ConfigError, match="expected a calibration folder, or files for vehicle, room"):
        parse_request(LEAST.replace("calibration: calibration", "camera: camera.yaml"))
