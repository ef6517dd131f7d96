import json
import signal
import subprocess
import sys

import cv2
import psutil
import pytest

from advnerf_core.data.lens import Lens
from advnerf_core.data.transforms import load_transforms
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole
from benchmarks.painted_corner import poses_of, write_photographs
from nodes.bags.writer import BagWriter
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.staging import build_beside, work_folder
from tests.support.waiting import wait_for

CAMERA = Pinhole(320, 240, 290.0, 290.0, 160.0, 120.0)


def command(*arguments):
    return [sys.executable, "-m", "nodes.cli", "scene", *map(str, arguments)]


def whole(folder):
    """Build a data set of one file each."""
    (folder / "images" / "a").mkdir()
    (folder / "images" / "a" / "1.png").write_bytes(b"picture")
    (folder / "transforms.json").write_text("{}")
    (folder / "import.json").write_text("{}")
    return 7


def listing(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def test_a_data_set_appears_whole_and_what_else_lies_there_stays(tmp_path):
    output = tmp_path / "scene"
    (output / "learned").mkdir(parents=True)
    (output / "learned" / "scene.safetensors").write_bytes(b"hours of work")
    assert build_beside(output, (), whole) == 7
    expected = [
        "images/.made_by_advnerf",
        "images/a/1.png",
        "import.json",
        "learned/scene.safetensors",
        "transforms.json",
    ]
    assert listing(output) == expected
    assert [path.name for path in tmp_path.iterdir()] == ["scene"]


def test_a_data_set_that_becomes_another_is_said(tmp_path, capsys):
    for content, told in (
        ("{}", ""),
        ("{}", ""),
        ('{"a": 1}', "replaced an earlier data set; what was learned"),
    ):

        def build(folder, content=content):
            whole(folder)
            (folder / "transforms.json").write_text(content)

        build_beside(tmp_path / "scene", (), build, resumes=False)
        assert told in (said := capsys.readouterr().out)
        assert bool(told) == bool(said)


@pytest.mark.parametrize("resumes", [True, False])
def test_a_failed_import_leaves_nothing_and_the_earlier_one_whole(tmp_path, resumes):
    def fail(folder):
        whole(folder)
        raise AdvnerfError("no")

    with pytest.raises(AdvnerfError, match=r"^no$"):
        build_beside(tmp_path / "new", (), fail, resumes)
    assert not any(tmp_path.iterdir())
    build_beside(tmp_path / "old", (), whole)
    before = listing(tmp_path)

    def spoil(folder):
        for image in (folder / "images").glob("*/*.png"):
            image.unlink()
        raise AdvnerfError("no")

    with pytest.raises(AdvnerfError, match=r"^no$"):
        build_beside(tmp_path / "old", (), spoil, resumes)
    assert listing(tmp_path) == before


def test_work_worth_keeping_is_named_and_taken_up(tmp_path):
    def stop(folder):
        (folder / "colmap").mkdir()
        (folder / "colmap" / "database.db").write_bytes(b"features")
        raise AdvnerfError("no")

    output = tmp_path / "scene"
    with pytest.raises(
        ImportRecordingError, match=r"no\. Finished work is kept in .*scene\.part: run the same command"
    ):
        build_beside(output, (), stop)
    assert not output.exists()

    def go_on(folder):
        assert (folder / "colmap" / "database.db").read_bytes() == b"features"
        return whole(folder)

    build_beside(output, (), go_on)
    assert not work_folder(output).exists()
    assert (output / "colmap" / "database.db").exists()

    def again(folder):
        assert (folder / "colmap" / "database.db").read_bytes() == b"features"
        assert (folder / "images" / "a" / "1.png").read_bytes() == b"picture"

    build_beside(output, (), again)


def test_folders_of_others_are_refused(tmp_path):
    (tmp_path / "scene.part").mkdir()
    (tmp_path / "scene.part" / "mine.txt").write_text("mine")
    with pytest.raises(ImportRecordingError, match="that folder has other files"):
        build_beside(tmp_path / "scene", (), whole)

    def inside(folder):
        with pytest.raises(ImportRecordingError, match=r"no other import into .*process \d+ is using"):
            build_beside(tmp_path / "other", (), whole)
        return whole(folder)

    assert build_beside(tmp_path / "other", (), inside) == 7


def test_a_bag_that_cannot_be_imported_leaves_nothing(tmp_path):
    with BagWriter(tmp_path / "bag"):
        pass
    result = subprocess.run(
        command("from-bag", tmp_path / "bag", "-o", tmp_path / "scene"),
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert result.returncode == 2
    assert result.stderr.startswith("error: expected the camera's calibration")
    assert [path.name for path in tmp_path.iterdir()] == ["bag"]


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_stopped_import_ends_in_one_line_and_goes_on(tmp_path, number, code):
    poses = poses_of(6, 2.6, 1.4, 0.4, 1.1)
    truth = write_photographs(tmp_path / "photos", poses, [(CAMERA, Lens())] * len(poses))
    arguments = command("from-images", tmp_path / "photos", "-o", tmp_path / "scene")
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    matching = tmp_path / "scene.part" / "colmap" / "pairs.txt"
    wait_for(lambda: matching.exists() or process.poll() is not None, "COLMAP to match pairs", 600.0)
    children = psutil.Process(process.pid).children()
    assert len(children) == 1, "COLMAP has its own process"
    process.send_signal(number)
    _, errors = process.communicate(timeout=600)
    assert (process.returncode, errors.count("\n")) == (code, 1)
    assert errors.startswith("error: stopped; finished work is kept in ")
    assert not children[0].is_running()
    assert not (tmp_path / "scene").exists()
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=600, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "6 of 6 images placed" in result.stdout
    assert not (tmp_path / "scene.part").exists()
    assert len(load_transforms(tmp_path / "scene", require_all=True).frames) == len(truth)
    camera = json.loads((tmp_path / "scene" / "import.json").read_text())["structure_from_motion"]["cameras"][
        "photos"
    ]
    assert camera["registered"] == 6
    assert camera["why"] in result.stdout


def test_a_photograph_that_is_turned_upright_keeps_its_exif_data(tmp_path):
    from PIL import Image

    from nodes.lab.importing.media import MediaConfig, gather

    image = Image.new("RGB", (64, 48), (200, 40, 40))
    exif = Image.Exif()
    exif[0x0110], exif[0x0112] = "Model 7", 6  # a quarter turn
    (tmp_path / "photos").mkdir()
    image.save(tmp_path / "photos" / "a.jpg", exif=exif)
    (source,) = gather([tmp_path / "photos"], tmp_path / "out", MediaConfig(), lambda share, text="": None)
    copy = tmp_path / "out" / source.images[0]
    with Image.open(copy) as turned:
        assert turned.size == (48, 64)
        assert (turned.getexif()[0x0110], turned.getexif()[0x0112]) == ("Model 7", 1)
    assert cv2.imread(str(copy)).shape[:2] == (64, 48), "readers that know EXIF do not turn it again"
