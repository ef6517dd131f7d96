"""`advnerf attack measure`: an attack is printed, photographed, measured, and driven past as it hangs."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import load_attack, save_attack
from advnerf_core.attack.printing.poster import poster_of
from advnerf_core.attack.printing.record import save_record
from advnerf_core.data.image_files import write_image
from advnerf_core.data.similarity import rotation_angles
from advnerf_core.fields.voxel_grid import face_corners_in_object
from advnerf_core.geometry import (
    Pinhole,
    invert_transform,
    make_transform,
    planar_pose,
    rotation_x,
    rotation_z,
)
from calibration.print_chart import chart_record, make_chart
from calibration.print_colour import ColourError, print_colours
from calibration.print_markers import find_markers, why_none
from calibration.print_measurement import WIDTH, of_photograph
from calibration.print_model import LaidPrint
from calibration.print_pose import PrintPose, fit_print
from calibration.schema import CameraCalibration, load_calibration, save_calibration
from nodes.bags.writer import BagWriter
from nodes.experiment.node.printed import record_beside
from nodes.experiment.node.search import run_attack
from nodes.experiment.show.own_scene import own_objects
from nodes.lab.wizards.prints import MeasuredPrint, write_measured
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import encode, image_message, pose_message
from nodes.runtime.progress import ProgressDisplay
from tests.support.commands import advnerf
from tests.support.faces import face_attack
from tests.support.photographed import before_camera, lens, photograph, scaled
from tests.support.tiny_request import CALIBRATION, loaded, tiny_request, with_objects

LENS = lens(960, 720, 750.0)
FACE = {
    "method": "gradient", "subject": "board", "corners_in_subject": face_corners_in_object(0.4), "T_world_from_object": np.eye(4),
    "camera": Pinhole(200, 66, 103.6, 103.4, 100, 32), "scene_sha256": "", "policy_sha256": "", "config_sha256": "", "seed": 0,
    "predicted_total_cte_m": None, "software_version": "0",
}  # fmt: skip
START_NS = 1_800_000_000_000_000_000


@pytest.fixture
def call(monkeypatch, capsys):
    """Call the command: exit code, and what it says in one line."""

    def call(*arguments: object) -> tuple[object, str]:
        code, said = advnerf(monkeypatch, *arguments), capsys.readouterr()
        return code, " ".join((said.out + said.err).split())

    return call


@pytest.fixture
def folder(tmp_path):
    """An attack of 0.4 m, its print, and the lens of a phone."""
    theta = np.random.default_rng(0).normal(0.0, 2.0, (8, 8, 3)).astype(np.float32)
    attack = face_attack(theta=theta, size_m=(0.4, 0.4), **FACE)
    save_attack(tmp_path / "a.attack.safetensors", attack)
    save_calibration(LENS, tmp_path / "lens.yaml")
    return tmp_path


def poster(folder):
    return poster_of(load_attack(folder / "a.attack.safetensors")).with_markers()


def test_a_photograph_gives_pose_and_colours_and_with_one_length_the_size(call, folder):
    assert (
        call("attack", "print", folder / "a.attack.safetensors", "-o", folder / "p.png", "--dpi", 50)[0] == 0
    )
    T, scale = before_camera(0.9, 25, 8, 3, 0.03), 1.03  # the shop printed 3 % too large
    nominal = make_transform(T[:3, :3], T[:3, 3] / scale)
    picture = photograph(
        [(scaled(poster(folder), scale, scale, 75.0), T)], LENS, light=(0.9, 0.75, 0.6), slope=0.4
    )
    write_image(folder / "photo.jpg", picture)
    command = measure_command(folder, "photo.jpg")
    code, said = call(*command)
    assert code == 0
    assert "12 of 12" in said
    assert "unknown: one photograph gives the pose in units of the nominal size" in said
    found = json.loads((folder / "photo.measured.json").read_text())
    assert found["size_m"] is None
    assert np.array(found["T_camera_from_face"]) == pytest.approx(nominal, abs=0.003)
    assert found["colours"]["rms"] < 8.0  # of 255: the light is removed
    assert found["colours"]["far_share"] < 0.01
    assert found["colours"]["uneven"] > 0.1
    assert cv2.imread(str(folder / "photo.measured.png")).shape == (384, 1152, 3)
    code, said = call(*command, "--distance", float(np.linalg.norm(T[:3, 3])), "-o", folder / "m.json")
    assert code == 0
    found = json.loads((folder / "m.json").read_text())
    assert found["size_m"] == pytest.approx((0.412, 0.412), rel=0.004)
    assert np.array(found["T_camera_from_face"]) == pytest.approx(T, abs=0.004)
    assert "+3." in said or "+2.9" in said
    assert call(*command, "--width", 0.412)[0] == 0
    assert json.loads((folder / "photo.measured.json").read_text())["size_m"] == pytest.approx((0.412, 0.412))


def test_markers_outside_the_picture_are_not_called_covered(call, folder):
    assert (
        call("attack", "print", folder / "a.attack.safetensors", "-o", folder / "p.png", "--dpi", 50)[0] == 0
    )
    picture = photograph(
        [(scaled(poster(folder), 1.0, 1.0, 75.0), before_camera(0.6, 10, 3, 2, 0.19))],
        LENS,
        light=(0.8, 0.8, 0.8),
    )
    write_image(folder / "photo.jpg", picture)
    code, said = call(*measure_command(folder, "photo.jpg"))
    assert code == 0
    found = json.loads((folder / "photo.measured.json").read_text())
    assert found["markers_outside"] == 12 - len(found["markers_seen"]) > 0
    assert f"{found['markers_outside']} outside the picture" in said
    assert "may be covered" not in said


@pytest.mark.parametrize("cells", [8, 64])
@pytest.mark.parametrize(
    ("camera", "away_m"),
    [(LENS, 0.9), (LENS, 2.0), (lens(336, 188, 174.0), 0.8)],
    ids=["near", "far", "small"],
)
def test_a_right_print_is_right_from_afar_and_another_one_is_not(camera, away_m, cells):
    """Where neither the texture's cells nor those of the markers are a pixel wide, the photograph has their mean light."""

    def print_of(seed):
        theta = np.random.default_rng(seed).normal(0.0, 2.0, (cells, cells, 3)).astype(np.float32)
        return poster_of(face_attack(theta=theta, size_m=(0.4, 0.4), **FACE)).with_markers()

    right = print_of(0)
    T = before_camera(away_m, 10, 3, 2)
    picture = photograph([(scaled(right, 1.0, 1.0, 75.0), T)], camera, light=(0.9, 0.8, 0.7))
    error = print_colours(picture, camera, LaidPrint(T), right, right.frame.corners_m).error
    assert (error.rms < 12.0, error.far_share < 0.01) == (True, True), error
    if cells == 8:  # of finer ones little more than the mean is left
        other = print_of(1)
        wrong = print_colours(picture, camera, LaidPrint(T), other, right.frame.corners_m).error
        assert wrong.far_share > 0.3


@pytest.mark.parametrize("aspect", [1.0, 1.02, 0.96])
def test_a_stretched_print_has_its_colours_and_even_light(aspect):
    """Its points are not where the nominal ones are: beside their cells, all colours were wrong, and the light uneven."""
    theta = np.random.default_rng(0).normal(0.0, 2.0, (8, 8, 3)).astype(np.float32)
    sheet = poster_of(face_attack(theta=theta, size_m=(0.4, 0.4), **FACE)).with_markers()
    picture = photograph(
        [(scaled(sheet, aspect, 1.0, 75.0), before_camera(0.7, 10, 3, 2))], LENS, light=(0.8, 0.8, 0.8)
    )
    corners = sheet.frame.corners_m
    pose = fit_print(find_markers(picture, LENS, corners), corners, LENS.pinhole)
    assert pose.aspect == pytest.approx(aspect, abs=0.002)
    colours = print_colours(
        picture, LENS, pose.laid, sheet, {number: corners[number] for number in pose.seen}
    )
    assert colours.error.rms < 8.0
    assert colours.error.uneven < 0.05
    assert np.abs(colours.error.mean).max() < 3.0


def test_points_of_a_bent_print_are_off_its_plane():
    laid = LaidPrint(np.eye(4), 0.02, np.array([0.01, 0.0, 0.0]), 0.2)
    edge, middle = laid.in_camera(np.array([[0.0, 0.2, 0.1], [0.0, 0.0, 0.0]]))
    assert edge == pytest.approx([0.01 * 2.0 / 3.0, 0.2 * np.exp(0.01), 0.1 * np.exp(-0.01)])
    assert middle == pytest.approx([-0.01 / 3.0, 0.0, 0.0])


@pytest.mark.parametrize("blur_px", [0.0, 1.2, 2.5])
def test_a_soft_photograph_has_the_colours_of_the_print(blur_px):
    """Black cells are lit by their white neighbours then, which is not the ink's."""
    theta = np.random.default_rng(0).normal(0.0, 2.0, (8, 8, 3)).astype(np.float32)
    sheet = poster_of(face_attack(theta=theta, size_m=(0.4, 0.4), **FACE)).with_markers()
    T, light = before_camera(0.9, 10, 3, 2), (0.9, 0.8, 0.7)
    picture = photograph([(scaled(sheet, 1.0, 1.0, 75.0), T)], LENS, light=light, blur_px=blur_px)
    error = print_colours(picture, LENS, LaidPrint(T), sheet, sheet.frame.corners_m).error
    assert error.rms < 8.0
    assert np.abs(error.mean).max() < 6.0
    assert error.far_share < 0.01


def test_a_chart_beside_it_is_a_card(call, folder):
    call("attack", "print", folder / "a.attack.safetensors", "-o", folder / "p.png", "--dpi", 50)
    assert call("car", "calibrate", "printer-chart", "-o", folder / "chart.png", "--dpi", 100)[0] == 0
    T = before_camera(0.75, -15, 5, 0, -0.13)
    beside = T @ make_transform(np.eye(3), [0.0, 0.42, 0.0])
    sheets = [(make_chart("a4"), beside), (scaled(poster(folder), 0.98, 0.98, 75.0), T)]
    picture = photograph(sheets, LENS, dpi=100.0)
    write_image(folder / "photo.png", picture)
    command = measure_command(folder, "photo.png")
    code, said = call(*command, "--card", folder / "chart.print.json")
    assert code == 0, said
    found = json.loads((folder / "photo.measured.json").read_text())
    assert (found["size_m"], found["size_from"]) == (pytest.approx((0.392, 0.392), rel=0.005), "a card")
    assert np.array(found["T_camera_from_face"]) == pytest.approx(T, abs=0.006)
    assert call(*command, "--card", folder / "chart.print.json", "--width", 0.4)[0] == 2
    code, said = call(*command, "--card", folder / "p.print.json")  # it is 2 % smaller than it says
    assert (code, "expected the record of a chart, got that of a poster" in said) == (2, True)


def measure_command(folder, photograph):
    """The words that measure a photograph of the print ``p.png``."""
    files = folder / photograph, "--print", folder / "p.print.json", "--camera", folder / "lens.yaml"
    return "attack", "measure", *files


@pytest.fixture
def measuring(folder):
    """The words that measure a photograph of everything but the print."""
    save_record(*record_beside(poster(folder), folder / "a.attack.safetensors", folder / "p.png", 50.0))
    noise = np.random.default_rng(0).integers(0, 256, (720, 960, 3)).astype(np.uint8)
    write_image(folder / "photo.png", noise)
    return measure_command(folder, "photo.png")


def test_the_record_of_a_chart_is_refused_with_the_command_that_writes_the_right_one(call, folder, measuring):
    save_record(chart_record(make_chart("a4"), 50.0), folder / "p.print.json")
    for others in ((), ("--attack", folder / "a.attack.safetensors")):
        code, said = call(*measuring, *others)
        assert (code, said.count("error:")) == (2, 1)
        assert "p.print.json: expected the record of a poster, got that of a chart" in said, said
        assert "that 'advnerf attack print' wrote" in said


def test_a_photograph_without_the_print_is_refused(call, measuring):
    code, said = call(*measuring)
    assert code == 2
    assert "found none of its 12 markers" in said


def changed(file, **values):
    """Change values of a JSON file."""
    file.write_text(json.dumps(json.loads(file.read_text()) | values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda folder: (folder / "photo.png").write_bytes(b"no picture"), "photo.png"),
        (
            lambda folder: write_image(folder / "photo.png", np.zeros((720, 960, 3), np.uint8)),
            "check the exposure",
        ),
        (
            lambda folder: write_image(folder / "photo.png", np.zeros((72, 96, 3), np.uint8)),
            "expected 960 x 720 pixels",
        ),
        (lambda folder: (folder / "p.print.json").write_text("{}"), "written beside the print"),
        (lambda folder: (folder / "p.print.json").write_text("[1"), "written beside the print"),
        (lambda folder: changed(folder / "p.print.json", picture_m=[0.5, 0.4]), "the file was changed"),
        (lambda folder: changed(folder / "p.print.json", attack_id="0" * 12), "give its file with --attack"),
        (
            lambda folder: changed(folder / "p.print.json", object="car"),
            "expected an object of face; got 'car'",
        ),
        (lambda folder: (folder / "lens.yaml").write_text("kind: board\n"), "lens.yaml"),
        (lambda folder: (folder / "a.attack.safetensors").unlink(), "expected an attack file"),
    ],
)
def test_damaged_and_irrelevant_files_are_refused_in_one_line(call, folder, measuring, change, message):
    change(folder)
    code, said = call(*measuring)
    assert code == 2
    assert message in said
    assert said.count("error:") == 1
    assert not list(folder.glob("*.measured.*"))


@pytest.mark.parametrize("name", ["photo.webp", "IMG_1.HEIC", "photo"])
def test_a_picture_of_any_kind_is_no_bag(call, folder, name):
    call("attack", "print", folder / "a.attack.safetensors", "-o", folder / "p.png", "--dpi", 20)
    (folder / name).write_bytes(b"no picture")
    code, said = call(*measure_command(folder, name), "--distance", "1")
    assert (code, "expected a readable image" in said) == (2, True), said


@pytest.fixture(scope="module")
def searched(tmp_path_factory):
    """A request of the simulated lab's camera, and its attack."""
    file = tiny_request(tmp_path_factory.mktemp("request"), evaluations=2)
    (attack,) = run_attack(loaded(file), file.parent / "run", ProgressDisplay())
    return file, attack


def seen_by_car(sheets, car, camera):
    """A picture of sheets at their ``T_world_from_face``."""
    T_camera_from_world = invert_transform(planar_pose(*car) @ camera.mount)
    before = [(sheet, T_camera_from_world @ T) for sheet, T in sheets]
    return photograph(before, camera, noise=1.0, blur_px=0.5, supersampling=3, light=(0.9, 0.9, 0.9))


def write_drive(bag, frames, paint):
    """A bag of a drive towards the print, with what ``paint`` makes of the car's poses."""
    with BagWriter(bag) as writer:
        for k, s in enumerate(np.linspace(0.0, 1.0, frames)):
            car = (-0.9 + 0.7 * s, -1.9 + 0.5 * s, 0.1 - 0.15 * s)
            stamp = START_NS + round(1e8 * k)
            writer.write(
                "/camera/image_raw", encode(image_message(paint(car), stamp, "camera")), stamp, stamp, k
            )
            for step in (-1, 1):
                pose = encode(pose_message(planar_pose(*car), stamp + step * 1000))
                writer.write("/vicon/car", pose, stamp + step * 1000, stamp + step * 1000, 2 * k + (step > 0))


def test_a_drive_past_two_copies_of_a_print_is_refused(call, folder):
    """Also where a half of the pictures shows one of them only."""
    assert (
        call(
            "attack",
            "print",
            folder / "a.attack.safetensors",
            "-o",
            folder / "p.png",
            "--dpi",
            50,
            "--marker-mm",
            100,
        )[0]
        == 0
    )
    camera = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
    sheet = scaled(poster_of(load_attack(folder / "a.attack.safetensors")).with_markers(0.1), 1.0, 1.0, 60.0)
    copies = [(sheet, make_transform(rotation_z(3.1), [1.0, y_m, 0.4])) for y_m in (-1.3, -2.1)]

    def paint(car):
        return seen_by_car(copies if car[0] < -0.5 else copies[:1], car, camera)

    write_drive(folder / "bag", 4, paint)
    files = "--print", folder / "p.print.json", "--camera", CALIBRATION / "camera.yaml"
    code, said = call("attack", "measure", folder / "bag", *files)
    assert (code, "expected one print, got marker" in said) == (2, True), said
    assert "cover the other one" in said


def test_a_drive_gives_size_pose_flatness_and_the_effect_where_it_hangs(call, searched, tmp_path):
    request, file = searched
    camera = load_calibration(CameraCalibration, CALIBRATION / "camera.yaml")
    assert call("attack", "print", file, "-o", tmp_path / "p.png", "--dpi", 50, "--marker-mm", 150)[0] == 0
    sheet = poster_of(load_attack(file)).with_markers(0.15)
    scale, T = 1.02, make_transform(rotation_z(3.0), [1.3, -1.6, 0.45])
    printed = scaled(sheet, scale, scale, 60.0)
    write_drive(tmp_path / "bag", 9, lambda car: seen_by_car([(printed, T)], car, camera))
    code, said = call(
        "attack", "measure", tmp_path / "bag", "--print", tmp_path / "p.print.json", "--camera", CALIBRATION / "camera.yaml",
        "--request", request, "-o", tmp_path / "found.json",
    )  # fmt: skip
    assert code == 0, said
    found = json.loads((tmp_path / "found.json").read_text())
    assert found["size_m"] == pytest.approx(np.multiply(scale, sheet.size_m), rel=0.01)
    pose = np.array(found["T_world_from_face"])
    assert np.degrees(rotation_angles((pose[:3, :3].T @ T[:3, :3])[None])[0]) < 1.0
    assert pose[:3, 3] == pytest.approx(T[:3, 3], abs=0.015)
    assert found["flatness_mm"] < 4.0 * found["flatness_sd_mm"] + 2.0
    effect = found["effect"]
    assert effect["at_measured_pose"]
    assert "where it hangs" in said
    assert min(effect[key] for key in ("clean_m", "nominal_m", "print_m")) >= 0.0


def test_a_print_has_the_border_that_its_search_had(tmp_path):
    """The scene's cells are the areas of the printed poster that they stand for."""
    file = with_objects(
        tiny_request(tmp_path, evaluations=1),
        "{name: board, kind: panel, x_m: 1.2, y_m: -1.7, z_m: 0.3, yaw_rad: 3.1, scale: 0.5, face: {resolution: 16, marker_m: 0.12}}",
    )
    request = loaded(file)
    (found,) = run_attack(request, tmp_path / "run", ProgressDisplay())
    poster = poster_of(load_attack(found)).with_markers()
    assert poster.size_m == pytest.approx((1.0, 1.0))
    assert poster.frame.marker_m == pytest.approx(0.12, abs=0.03)
    (own,) = own_objects(request)
    field = own.field
    assert field.scale * (field.box_max - field.box_min)[1:] == pytest.approx(poster.frame.sheet_m)
    cells = field.slots.shape[1]
    numbered = replace(
        poster, frame=replace(poster.frame, first=0)
    )  # which print it is, is not known in the search
    picture = numbered.pixels((0.0, 0.0, *poster.sheet_mm), (cells * 40, cells * 40))
    expected = cv2.resize(picture, (cells, cells), interpolation=cv2.INTER_AREA) / 255.0
    shown = field.colours(torch.zeros(16, 16, 3)).numpy()[field.slots[-1]][:, ::-1].transpose(1, 0, 2)
    around = np.ones((cells, cells), bool)
    around[(cells - 16) // 2 : (cells + 16) // 2, (cells - 16) // 2 : (cells + 16) // 2] = False
    assert np.abs(shown - expected)[around].max() < 0.12
    assert np.abs(shown - expected)[around].mean() < 0.015
    file.write_text(file.read_text().replace(", marker_m: 0.12", ""))
    (bare,) = own_objects(loaded(file))
    assert (bare.named.marker_m, bare.field.slots.shape[1]) == (None, 16)


@pytest.mark.parametrize(
    ("thing", "told"),
    [
        ("kind: cube, face: {marker_m: 0.1}", "expected marker_m of a panel"),
        ("kind: panel, face: {marker_m: 0.1, subject: board}", "expected no marker_m, which is of a print"),
    ],
)
def test_a_border_of_what_is_no_print_is_refused(tmp_path, thing, told):
    file = with_objects(tiny_request(tmp_path), f"{{name: board, x_m: 1.2, y_m: -1.7, {thing}}}")
    with pytest.raises(ConfigError, match=told):
        loaded(file)


def test_a_yaw_in_degrees_is_refused(call, measuring):
    numbers = "3 finite numbers X,Y,YAW in metres and radians"
    for car, wanted in (("1,2,90", "radians, at most a turn"), ("1,nan,0", numbers), ("inf,2,0", numbers)):
        code, said = call(*measuring, "--car", car)
        assert (code, f"--car {car}: expected {wanted}" in said) == (2, True), said
    for option in ("--width", "--distance"):  # Python reads it as a number
        code, said = call(*measuring, option, "inf")
        assert (code, f"expected finite numbers for {option}, got inf" in said) == (2, True), said


def test_no_picture_of_an_earlier_measurement_stays(tmp_path):
    pose = PrintPose(LaidPrint(before_camera(0.9)), (1, 2, 3), (), dict.fromkeys((1, 2, 3), 0.0), *[0.0] * 6)
    measurement = of_photograph("p.png", (0.4, 0.4), 12, pose, None, None)
    (tmp_path / "p.measured.png").touch()
    target = tmp_path / "p.measured.json"
    assert write_measured(MeasuredPrint(measurement, None, False), None, target) == [target]
    assert list(tmp_path.iterdir()) == [target]


def test_no_input_is_overwritten(call, folder):
    call("attack", "print", folder / "a.attack.safetensors", "-o", folder / "p.png", "--dpi", 50)
    (folder / "photo.png").touch()
    before = {file: file.read_bytes() for file in folder.iterdir()}
    command = *measure_command(folder, "photo.png"), "-o"
    given = ("photo.png", "photo.json", "p.print.json", "lens.yaml", "a.attack.safetensors")
    for output, refusal in [*((name, "would be overwritten") for name in given), ("new.png", "two files")]:
        code, said = call(*command, folder / output)
        assert (code, refusal in said) == (2, True), said
    assert {file: file.read_bytes() for file in folder.iterdir()} == before


@pytest.mark.parametrize(("roll_deg", "tilt_deg"), [(179, 0), (90, 5), (-90, 0), (30, 10), (0, 20), (4, 0)])
def test_a_print_that_does_not_hang_upright_is_said_to_be_turned(roll_deg, tilt_deg):
    T = before_camera(0.9, 35, tilt_deg) @ make_transform(rotation_x(np.radians(roll_deg)), np.zeros(3))
    level = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_world_from_camera = planar_pose(1.0, 2.0, 0.7) @ make_transform(level, [0.1, 0.0, 0.2])
    pose = PrintPose(LaidPrint(T), (1, 2, 3), (), dict.fromkeys((1, 2, 3), 0.0), *[0.0] * 6)
    for known, where in ((None, "of the photograph"), ((WIDTH, 1.0, 0.0), "the horizontal: ")):
        found = of_photograph("p.png", (0.4, 0.4), 12, pose, known, T_world_from_camera)
        said = dict(found.lines).get("turned", "")
        # For a viewer, x of the face points at them: a positive turn about it is anticlockwise.
        assert (f"{abs(roll_deg)} degrees" in said) == (abs(roll_deg) > 10), said
        assert ("anticlockwise" in said) == (10 < roll_deg < 180)
        assert not said or (where in said and "not as it was searched" in said)


def test_what_cannot_be_right_or_is_not_known_is_said():
    pose = PrintPose(LaidPrint(before_camera(0.9)), (1, 2, 3), (), dict.fromkeys((1, 2, 3), 0.0), *[0.0] * 6)
    for scale, doubtful in ((0.8, False), (1.2, False), (9.99, True), (3.28, True), (0.1, True)):
        found = of_photograph("p.png", (0.4, 0.4), 12, pose, (WIDTH, scale, 0.0), None)
        assert ("in m?" in dict(found.lines)["size"]) == doubtful
        assert "--car X,Y,YAW" in dict(found.lines)["in the world"]
    for share, words in ((0.2, "covered, or colours that the printer has not?"), (0.99, "wrong --print")):
        colours = ColourError(rms=30.0, mean=(0.0, 0.0, 0.0), uneven=0.0, far_share=share, seen_share=1.0)
        assert words in dict(replace(found, colours=colours).lines)["colours"]


def test_a_camera_that_moved_is_named(folder):
    sharp = photograph([(poster(folder), before_camera(0.9, 10))], LENS)
    assert "not in view" in why_none(sharp)
    across = np.zeros((25, 25), np.float32)
    across[12] = 1.0
    for way_deg in (0, 33, 90):
        kernel = cv2.warpAffine(across, cv2.getRotationMatrix2D((12, 12), way_deg, 1.0), (25, 25))
        assert "the camera moved" in why_none(cv2.filter2D(sharp, -1, kernel / kernel.sum()))
