"""Printed attacks, read back by poppler and Pillow, which know nothing of how they were written."""

import dataclasses
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from advnerf_core.attack.artifact import AttackedObject, AttackFile
from advnerf_core.attack.printing.pages import pdf_bytes
from advnerf_core.attack.printing.poster import Poster, PrintError, png_bytes, poster_of
from advnerf_core.attack.printing.tiles import layout_of
from advnerf_core.fields.voxel_grid import face_corners_in_object
from advnerf_core.geometry import make_transform, rotation_z
from tests.support.faces import face_attack

POPPLER = pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="needs pdftoppm: poppler-utils")
THETA = np.random.default_rng(3).normal(0.0, 2.0, (16, 16, 3)).astype(np.float32)
POSE = make_transform(rotation_z(np.radians(-172.0)), [3.04, -1.8, 0.52])
PAGES_MM = {"a4": (210, 297), "a1": (594, 841), "letter": (215.9, 279.4), "tabloid": (279.4, 431.8)}


def attack(**changes) -> AttackFile:
    base = face_attack(
        method="gradient",
        theta=THETA,
        size_m=(0.5, 0.35),
        subject="board",
        corners_in_subject=face_corners_in_object(0.5),
        T_world_from_object=POSE,
        scene_sha256="a" * 64,
        policy_sha256="b" * 64,
        config_sha256="c" * 64,
        seed=3,
        predicted_total_cte_m=9.25,
        software_version="0.1.0",
        extra={"victim": "hardened"},
    )
    return dataclasses.replace(base, **changes)


def panel(name: str, size_m: tuple[float, float] | None = None) -> AttackedObject:
    return AttackedObject(name, THETA, POSE, 1.0, "", size_m=size_m)


SOLID = AttackedObject("car", np.ones((12, 3), np.float32), POSE, 1.0, "")
BALL = AttackedObject("ball", np.ones((12, 3), np.float32), POSE, 1.0, "", b"glTF")


def of(*objects: AttackedObject) -> AttackFile:
    return attack(objects=objects, face=None)


def written(folder: Path, poster: Poster, paper="a4", dpi=100.0, margin_mm=8.0, overlap_mm=5.0) -> Path:
    layout = layout_of(poster.sheet_mm, paper, margin_mm, overlap_mm)
    (folder / "poster.pdf").write_bytes(pdf_bytes(poster, layout, paper, dpi))
    return folder / "poster.pdf"


def rasterised(file: Path, dpi: int) -> list[np.ndarray]:
    """All pages, ``[H, W, 3]`` RGB, by poppler."""
    command = [
        "pdftoppm",
        "-r",
        str(dpi),
        "-aa",
        "no",
        "-aaVector",
        "no",
        str(file),
        str(file.parent / "page"),
    ]
    run = subprocess.run(command, check=True, capture_output=True, text=True)
    assert not run.stderr  # poppler says what is wrong with a file, and goes on
    return [cv2.imread(str(page))[..., ::-1] for page in sorted(file.parent.glob("page*.ppm"))]


def spoken(file: Path) -> str:
    return subprocess.run(
        ["pdftotext", "-layout", str(file), "-"], check=True, capture_output=True, text=True
    ).stdout


def boxes_mm(file: Path, kind: str) -> list[tuple[float, ...]]:
    """Width and height of the boxes of all pages [mm]."""
    found = re.findall(rf"/{kind} \[([^\]]*)\]".encode(), file.read_bytes())
    corners = [[float(each) / 72.0 * 25.4 for each in box.split()] for box in found]
    return [(right - left, top - bottom) for left, bottom, right, top in corners]


def between_crop_marks(page: np.ndarray, mm: float, margin_mm: float = 8.0) -> np.ndarray:
    """The part of a page that its crop marks enclose; ``mm`` are pixels per millimetre."""
    dark = (page < 100).all(axis=2)
    above = dark[round((0.6 * margin_mm) * mm) : round((margin_mm - 2.0) * mm)].all(axis=0)
    beside = dark[:, round((0.6 * margin_mm) * mm) : round((margin_mm - 2.0) * mm)].all(axis=1)
    columns, rows = np.flatnonzero(above), np.flatnonzero(beside)
    return page[rows[0] : rows[-1], columns[0] : columns[-1]]


@pytest.mark.parametrize("paper", PAGES_MM)
def test_pages_are_of_the_paper_and_tiles_add_up(tmp_path, paper):
    poster = poster_of(attack())
    file = written(tmp_path, poster, paper, dpi=30)
    layout = layout_of(poster.sheet_mm, paper, 8.0, 5.0)
    *pages, overview = boxes_mm(file, "MediaBox")
    *tiles, _ = boxes_mm(file, "TrimBox")
    assert len(pages) == layout.rows * layout.columns == len(tiles)
    for page, tile in zip(pages, tiles, strict=True):
        assert sorted(page) == pytest.approx(PAGES_MM[paper], abs=0.01)
        assert tile[0] <= page[0] - 16.0
        assert tile[1] <= page[1] - 16.0
    covered = [
        layout.columns * tiles[0][0] - (layout.columns - 1) * 5.0,
        layout.rows * tiles[0][1] - (layout.rows - 1) * 5.0,
    ]
    assert covered == pytest.approx([500.0, 350.0], abs=0.01)
    assert overview == pytest.approx(PAGES_MM["a4" if paper.startswith("a") else "letter"], abs=0.01)


@POPPLER
@pytest.mark.parametrize("overlap_mm", [0.0, 12.0])
def test_tiles_cut_at_their_marks_and_put_together_are_the_texture(tmp_path, overlap_mm):
    poster, dpi = poster_of(attack()), 127
    mm, layout = dpi / 25.4, layout_of(poster.sheet_mm, "a4", 8.0, overlap_mm)
    pages = rasterised(written(tmp_path, poster, dpi=150.0, overlap_mm=overlap_mm), dpi)
    together = np.zeros((round(350 * mm), round(500 * mm), 3), np.uint8)
    for number, page in enumerate(pages[:-1]):
        cut = between_crop_marks(page, mm)
        row, column = divmod(number, layout.columns)
        assert cut.shape[:2] == pytest.approx([layout.tile_mm[1] * mm, layout.tile_mm[0] * mm], abs=1.5)
        y, x = (
            round(index * (size - overlap_mm) * mm)
            for index, size in zip((row, column), layout.tile_mm[::-1], strict=True)
        )
        there = together[y : y + cut.shape[0], x : x + cut.shape[1]]
        there[:] = cut[: there.shape[0], : there.shape[1]]
    expected = cv2.resize(poster.texture, together.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    difference = np.abs(together.astype(int) - expected)[:-2, :-2]
    # A tile that is wrong by a millimetre differs by 7 levels, where the picture is steep.
    assert difference.mean() < 1.1
    assert np.percentile(difference, 99.9) < 5


@POPPLER
def test_rulers_are_100_mm_and_the_strip_has_its_colours(tmp_path):
    pages = rasterised(written(tmp_path, poster_of(attack()), dpi=50.0), 254)
    for page in (pages[0], pages[-1]):
        dark = (page < 100).all(axis=2)
        longest = max(_longest_run(row) for row in dark[page.shape[0] // 2 :])
        assert longest == pytest.approx(1000, abs=3)
    sheet = pages[-1]
    for colour in ((255, 0, 0), (0, 255, 0), (0, 0, 255), (128, 128, 128), (64, 64, 64)):
        assert (sheet == colour).all(axis=2).sum() > 0.9 * 200 * 200  # 20 mm


def _longest_run(row: np.ndarray) -> int:
    ends = np.flatnonzero(np.diff(np.concatenate([[0], row.astype(int), [0]])))
    return int((ends[1::2] - ends[::2]).max(initial=0))


@POPPLER
def test_the_sheet_says_what_and_where(tmp_path):
    said = spoken(written(tmp_path, poster_of(attack()), dpi=30.0))
    for part in (
        f"Attack {attack().attack_id}: face",
        "0.500 x 0.350 m at true size, against policy bbbbbbbbbbbb (hardened)",
        "row 2 of 2, column 2 of 2",
        "x = 3.040 m, y = -1.800 m in the scene's frame, 0.520 m above",
        "Lower edge at 0.345 m, upper edge at 0.695 m.",
        "It faces -172.0 degrees",
        "100 % (actual size), no fit to page",
    ):
        assert part in said, part
    on_the_floor = np.eye(4)
    on_the_floor[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]).T
    lying = dataclasses.replace(poster_of(attack()), T_world_from_face=on_the_floor)
    assert "Not upright. It faces (0.000, 0.000, 1.000), and its upper edge points to (-1.000" in spoken(
        written(tmp_path, lying, dpi=30.0)
    )


@POPPLER
def test_without_paper_the_page_is_the_poster(tmp_path):
    poster = poster_of(attack())
    file = written(tmp_path, poster, "none", dpi=127.0)
    assert boxes_mm(file, "MediaBox")[0] == pytest.approx((500.0, 350.0), abs=0.01)
    page, _ = rasterised(file, 127)
    expected = cv2.resize(poster.texture, page.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    assert np.abs(page.astype(int) - expected).max() <= 3


def test_a_png_opens_at_true_size(tmp_path):
    (tmp_path / "poster.png").write_bytes(png_bytes(poster_of(attack()), 150.0))
    with Image.open(tmp_path / "poster.png") as picture:
        assert picture.info["dpi"] == pytest.approx((150.0, 150.0), abs=0.02)
        size_mm = [pixels / dpi * 25.4 for pixels, dpi in zip(picture.size, picture.info["dpi"], strict=True)]
        assert size_mm == pytest.approx((500.0, 350.0), abs=0.1)
        expected = cv2.resize(attack().required_face().texture, picture.size, interpolation=cv2.INTER_LINEAR)
        assert np.abs(np.asarray(picture).astype(int) - expected).max() <= 1


def test_a_panel_has_the_size_of_its_file_or_the_given_one():
    assert poster_of(of(panel("board", (2.8, 2.8)))).size_m == (2.8, 2.8)
    assert poster_of(of(panel("board")), edge_m=2.8).size_m == (2.8, 2.8)
    assert poster_of(of(SOLID, panel("board", (1.0, 1.0)))).name == "board"
    two = of(panel("left", (1.0, 1.0)), panel("right", (2.0, 2.0)))
    assert poster_of(two, "right").size_m == poster_of(two, "1").size_m == (2.0, 2.0)


@pytest.mark.parametrize(
    ("objects", "name", "edge_m", "message"),
    [
        ((SOLID,), None, None, "solid object car, which has no flat texture; attack one of these$"),
        ((SOLID, BALL), None, None, "car, ball.*attack show' writes its meshes as GLB"),
        ((SOLID, panel("board", (1.0, 1.0))), "car", None, "solid object car.*print one of board"),
        (
            (panel("a", (1.0, 1.0)), panel("b", (1.0, 1.0))),
            None,
            None,
            r"--object and its number: 0 \(a\), 1 \(b\)",
        ),
        ((panel("board", (1.0, 1.0)),), "bord", None, r"--object: .*board.*did you mean board"),
        ((panel("board"),), None, None, "--object-size"),
        ((panel("board", (1.0, 1.0)),), None, 2.0, "whose attack file says 1 x 1 m; leave it out"),
    ],
)
def test_what_cannot_be_printed_is_named(objects, name, edge_m, message):
    with pytest.raises(PrintError, match=message):
        poster_of(of(*objects), name, edge_m)


def test_impossible_measures_are_refused():
    with pytest.raises(PrintError, match="margin of 4 to 40 mm"):
        layout_of((500.0, 350.0), "a4", 2.0, 5.0)
    with pytest.raises(PrintError, match="overlap of 0 to 50 mm"):
        layout_of((500.0, 350.0), "a4", 8.0, 60.0)
    with pytest.raises(PrintError, match=r"at most 5\.08 m"):
        layout_of((6000.0, 350.0), "none", 8.0, 5.0)
    with pytest.raises(
        PrintError, match=r"at most 1000 pages, got \d+ of A4 for 60 x 40 m; .* which is in metres"
    ):
        layout_of((60_000.0, 40_000.0), "a4", 8.0, 5.0)
    big = poster_of(of(panel("board", (3.0, 3.0))))
    with pytest.raises(PrintError, match=r"at most 200 million pixels .* use --dpi (\d+)") as refused:
        png_bytes(big, 600.0)
    fits = int(re.findall(r"--dpi (\d+)", str(refused.value))[0])
    assert 115 <= fits <= 119


@pytest.mark.parametrize(("edge_m", "marker_m", "most"), [(0.3, 0.31, "300 mm"), (0.015, None, "15 mm")])
def test_markers_that_would_touch_are_refused(edge_m, marker_m, most):
    small = poster_of(of(panel("board", (edge_m, 2.0 * edge_m))))
    with pytest.raises(PrintError, match=f"expected markers of at most {most}, .* or add --no-markers"):
        small.with_markers(marker_m)
    assert small.with_markers(0.5 * edge_m).frame.marker_m == 0.5 * edge_m
