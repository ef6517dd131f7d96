"""Files that strangers sent, which were once read wrongly and in silence."""

from pathlib import Path

import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.transforms import load_transforms
from advnerf_core.documents import parse_yaml
from advnerf_core.errors import ConfigError
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.declaration import declaration_beside
from advnerf_core.strict import validate
from calibration.schema import CalibrationError, RoomCalibration, VehicleCalibration, load_calibration
from nodes.experiment.node.request import parse_request
from nodes.lab.policy_data.logs import open_log
from nodes.policy import PolicyNodeConfig

ROOT = Path(__file__).parents[1]
CASES = ROOT.parent / "shared/data/cases"
TWIN = ROOT / "calibration/twin"


def case(name):
    if not (CASES / name).exists():
        pytest.skip("needs the shared cases")
    return CASES / name


def test_a_servo_gain_that_is_given_twice_is_refused():
    file = case("calibration_duplicate_key") / "vehicle.yaml"
    with pytest.raises(
        CalibrationError, match=r"vehicle\.yaml:6: gains\.servo_per_rad is given twice; remove one"
    ):
        load_calibration(VehicleCalibration, file)


def test_a_log_with_decimal_commas_is_refused_with_its_first_line_and_their_number():
    file = case("log_decimal_comma") / "drive.csv"
    rows = len(file.read_text("utf-8-sig").splitlines()) - 1
    with pytest.raises(
        ConfigError,
        match=rf"^\S*drive\.csv:2: expected 2 fields as in the header, got 3; write numbers with a "
        rf"decimal point, and put text with commas in quotes; and {rows - 1} more like it$",
    ):
        open_log(file)


def test_a_byte_order_mark_before_a_log_and_a_transforms_file_is_no_matter(tmp_path):
    (tmp_path / "transforms.json").write_bytes(b"\xef\xbb\xbf" + b'{"fl_x": 1, "frames": []}')
    with pytest.raises(DatasetError, match=r"expected a list 'frames' .* got list without entries"):
        load_transforms(tmp_path)
    (tmp_path / "transforms.json").write_text('{"fl_x": 100,\n"fl_x": 250, "frames": []}')
    with pytest.raises(DatasetError, match=r"transforms\.json:2: fl_x is given twice"):
        load_transforms(tmp_path)


def test_on_is_no_speed_and_yes_no_distance(tmp_path):
    with pytest.raises(ConfigError, match="speed_mps: input should be a valid number, got 'on'"):
        validate(PolicyNodeConfig, parse_yaml("policy: a\nspeed_mps: on\n", "a.yaml"))
    text = (TWIN / "room.yaml").read_text()
    for word in ("yes", "true", "3:14"):
        changed = "".join(
            f"off_track_m: {word}\n" if line.startswith("off_track_m:") else line
            for line in text.splitlines(keepends=True)
        )
        (tmp_path / "room.yaml").write_text(changed)
        with pytest.raises(
            CalibrationError, match=r"room\.yaml:\d+: off_track_m: input should be a valid number"
        ):
            load_calibration(RoomCalibration, tmp_path / "room.yaml")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("horizon: yes", r"a:\d: horizon: input should be a valid integer, got 'yes'"),
        ("over: {seed: [010]}", "a:3: 010: expected a number without leading zeros"),
        ("attack: &a {x: *a}", r"a:3: \*a is part of the value that it refers to"),
        ("attack: {start_poses: [[0, 0, 3:14]]}", "got '3:14'"),
    ],
)
def test_an_attack_takes_no_other_number_than_the_one_that_is_written(line, message):
    with pytest.raises(ConfigError, match=message):
        parse_request(f"name: a\npaths: [b]\n{line}\n", "a")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("output_unit: deg\noutput_unit: rad\n", r":2: output_unit is given twice"),
        ("value_max: true\n", "value_max: expected a number, got True"),
        ("mean: [0, yes, 0]\n", "mean: expected a number, got 'yes'"),
        ("stateless: on\n", "stateless: expected true or false, got 'on'"),
        ("goal_size: true\n", "goal size >= 0, got True"),
    ],
)
def test_a_declaration_is_as_strict(tmp_path, text, message):
    view = "view: {camera: {width: 168, height: 94, fx: 87, fy: 87, cx: 84, cy: 47}, crop_top_px: 12, crop_height_px: 55}\n"
    (tmp_path / "p.onnx.policy.yaml").write_text(text + view)
    with pytest.raises(PolicyContractError, match=message):
        declaration_beside(tmp_path / "p.onnx", None)
