"""`advnerf attack print` as people call it."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack, save_attack
from advnerf_core.attack.printing.record import load_record
from advnerf_core.fields.voxel_grid import face_corners_in_object
from advnerf_core.geometry import Pinhole
from nodes.experiment.node.printed import stem_of
from tests.support.commands import advnerf
from tests.support.faces import face_attack


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "seed_0.attack.safetensors"
    attack = face_attack(
        method="gradient",
        theta=np.random.default_rng(0).normal(size=(8, 8, 3)).astype(np.float32),
        size_m=(0.4, 0.4),
        subject="board",
        corners_in_subject=face_corners_in_object(0.4),
        T_world_from_object=np.eye(4),
        camera=Pinhole(200, 66, 103.6, 103.4, 100, 32),
        scene_sha256="",
        policy_sha256="",
        config_sha256="",
        seed=0,
        predicted_total_cte_m=None,
        software_version="0",
    )
    save_attack(path, attack)
    return path


@pytest.fixture
def printed(monkeypatch, capsys, file):
    """Call the command: exit code, and what it says in one line."""

    def call(*arguments: object) -> tuple[object, str]:
        code, said = advnerf(monkeypatch, "attack", "print", file, *arguments), capsys.readouterr()
        return code, " ".join((said.out + said.err).split())

    return call


def test_the_pdf_lies_beside_the_file(printed, file):
    code, said = printed("--dpi", 40, "--no-markers")
    assert (code, said.split(", ", 1)[1]) == (
        0,
        "0.400 x 0.400 m, 6 pages of A4 and an overview; print at 100 %, no fit to page",
    )
    assert (file.parent / "seed_0.poster.pdf").read_bytes().count(b"/MediaBox") == 7
    assert list(file.parent.glob("*.json")) == []


def test_markers_and_their_record_lie_beside_the_print(printed, file):
    code, said = printed("-o", file.parent / "poster.png", "--dpi", 100, "--marker-mm", 50)
    assert code == 0
    assert "0.400 x 0.400 m, 0.538 x 0.538 m with its markers; print at 100 %" in said
    record = load_record(file.parent / "poster.print.json")
    assert (record.picture_m, record.attack_id) == ((0.4, 0.4), load_attack(file).attack_id)
    assert file.parent / record.attack_file == file
    picture = cv2.imread(str(file.parent / "poster.png"))
    assert picture.shape == (2116, 2116, 3)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    assert sorted(numbers.ravel()) == sorted(record.markers)
    for number, pixels in zip(numbers.ravel(), corners, strict=True):
        place_m = (pixels[0] + 0.5 - 2116 / 2) * 0.0254 / 100 * [1, -1]
        assert place_m == pytest.approx(record.markers[number][:, 1:], abs=3e-4)


def test_a_png_and_a_page_of_the_posters_size(printed, tmp_path):
    assert printed("-o", tmp_path / "poster.png", "--dpi", 127, "--no-markers")[0] == 0
    assert cv2.imread(str(tmp_path / "poster.png")).shape == (2000, 2000, 3)
    assert printed("-o", tmp_path / "shop.pdf", "--paper", "none", "--dpi", 40, "--no-markers")[0] == 0
    assert b"/MediaBox [0 0 1133.858268 1133.858268]" in (tmp_path / "shop.pdf").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-o", "poster.jpg"], "expected a .pdf or .png file to write, got poster.jpg; correct --output"),
        (
            ["--marker-mm", 500],
            "expected markers of at most 400 mm, the texture's shorter side, as larger ones would touch, got 500 mm",
        ),
        (["--object-size", "inf"], "expected finite numbers for --object-size, got inf"),
        (["--marker-mm", 5], "expected a value greater than or equal to 8, got '5'"),
        (["--margin-mm", 1], "expected a margin of 4 to 40 mm"),
        (["--object", "car"], "expected an object of face; got 'car'"),
        (["--object-size", 1], "whose attack file says 0.4 x 0.4 m"),
        (["--paper", "a7"], "'a7' is not one of"),
    ],
)
def test_mistakes_are_told_in_one_line(printed, arguments, message):
    code, said = printed(*arguments)
    assert code == 2
    assert message in said


def test_the_record_of_another_print_is_never_replaced(printed, file):
    poster, record = file.parent / "p.png", file.parent / "p.print.json"
    assert printed("-o", poster, "--dpi", 40)[0] == 0
    before = record.read_text(), poster.read_bytes()
    for output in ("p.png", "p.pdf"):
        code, said = printed("-o", file.parent / output, "--dpi", 40, "--marker-mm", 60)
        assert (code, "record of another print" in said) == (2, True)
    assert (record.read_text(), poster.read_bytes()) == before
    assert not (file.parent / "p.pdf").exists()
    assert printed("-o", file.parent / "p.pdf", "--dpi", 50)[0] == 0  # the same print, in another file
    record.write_text("{}")
    assert printed("-o", poster, "--dpi", 40)[0] == 2


def test_nor_that_of_another_chart(monkeypatch, tmp_path, capsys):
    def chart(*arguments):
        return advnerf(monkeypatch, "car", "calibrate", "printer-chart", *arguments)

    assert chart("-o", tmp_path / "chart.png", "--dpi", 50) == 0
    before = (tmp_path / "chart.print.json").read_text()
    assert chart("-o", tmp_path / "chart.pdf", "--dpi", 50, "--paper", "a3") == 2
    assert "record of another print" in capsys.readouterr().err
    assert [file.name for file in tmp_path.glob("*.pdf")] == []
    assert (tmp_path / "chart.print.json").read_text() == before
    assert chart("-o", tmp_path / "chart.pdf", "--dpi", 60) == 0


@pytest.mark.parametrize(
    ("name", "stem"),
    [
        ("run.v1.attack.safetensors", "run.v1"),
        ("run.v2.attack.safetensors", "run.v2"),
        ("a.b.safetensors", "a.b"),
    ],
)
def test_files_that_are_made_of_an_attack_have_its_whole_name(tmp_path, name, stem):
    assert stem_of(tmp_path / name) == stem
