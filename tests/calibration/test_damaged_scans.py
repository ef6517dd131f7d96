"""Scans with something wrong: what can be used is used, and anything else is one line that says what to do."""

import json
import random
import zipfile

import cv2
import numpy as np
import pytest

from advnerf_core.errors import AdvnerfError
from calibration.scans.reading import read_scan
from calibration.scans.scan import Picture, ScanError, ScanOptions
from tests.support import scan_samples
from tests.support.damaged_bytes import mutate
from tests.support.scan_damage import ScanFiles


def test_damaged_files_are_read_or_refused(tmp_path):
    files, random_ = ScanFiles(tmp_path), random.Random(0)
    for data in files.good:
        files.read(data)
    refused = 0
    for _ in range(300):
        good = random_.choice(files.good)
        try:
            files.read(good[:1] + mutate(random_, good[1:]))
        except AdvnerfError:
            refused += 1
    assert refused > 20


def json_edit(pattern, edit):
    def change(scan):
        for file in scan.rglob(pattern):
            content = json.loads(file.read_text())
            edit(content)
            file.write_text(json.dumps(content))

    return change


def repacked(edit, drop=()):
    def change(scan):
        with zipfile.ZipFile(scan) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        metadata = json.loads(files["metadata"])
        edit(metadata)
        with zipfile.ZipFile(scan, "w") as archive:
            for name, data in {**files, "metadata": json.dumps(metadata).encode()}.items():
                if not name.startswith(drop or "/"):
                    archive.writestr(name, data)

    return change


def rows_edit(edit):
    def change(scan):
        rows = np.load(scan / "poses_bounds.npy")
        np.save(scan / "poses_bounds.npy", edit(rows))

    return change


def text_edit(pattern, old, new):
    def change(scan):
        for file in scan.rglob(pattern):
            file.write_text(file.read_text().replace(old, new))

    return change


def cut(scan):
    scan.write_bytes(scan.read_bytes()[: scan.stat().st_size // 2])


def without(pattern):
    def change(scan):
        for file in list(scan.rglob(pattern)):
            file.unlink()

    return change


def clocks_apart(scan):
    lines = (scan / "rgb.txt").read_text().splitlines()
    (scan / "rgb.txt").write_text("\n".join(line.replace("1305031", "1305032", 1) for line in lines))


CASES = [
    ("Polycam", without("*.jpg"), r"expected at least 3 images with a pose, got 0; .*found none"),
    ("Polycam", json_edit("*.json", lambda each: each.pop("t_12", None)), "expected the keys t_00"),
    (
        "Polycam",
        json_edit("*.json", lambda each: each.update(t_00=float("nan"))),
        "expected finite numbers, got NaN",
    ),
    ("Polycam", json_edit("*.json", lambda each: each.update(t_00=3.0)), "a stretch by"),
    ("Polycam", json_edit("*.json", lambda each: each.update(fx=0)), "focal lengths above 0 px"),
    ("Record3D", cut, r"expected a whole archive of Record3D, got: .*; copy it from the phone again"),
    ("Record3D", repacked(lambda each: each.pop("poses")), "expected the keys poses, w, h and K"),
    ("Record3D", repacked(lambda each: each.update(K=[1.0])), "expected 9 numbers"),
    (
        "Record3D",
        repacked(lambda each: each.update(poses=[[0.0] * 7] * 8)),
        "expected a quaternion of unit length",
    ),
    ("Record3D", repacked(lambda each: None, drop="rgbd"), r"rgbd/0\.jpg is not in the recording"),
    ("LLFF", rows_edit(lambda rows: rows[:5]), "got 5 rows and 8 images; give the images of the poses"),
    ("LLFF", rows_edit(lambda rows: rows * np.nan), "expected finite numbers, got NaN or infinity"),
    ("LLFF", rows_edit(lambda rows: rows[:, :15]), r"expected numbers \[N, 17\], got float64 \[8, 15\]"),
    (
        "LLFF",
        rows_edit(lambda rows: rows / np.where(np.arange(17) == 14, 64.0, 1.0)),
        "if they are normalised",
    ),
    ("LLFF", without("*.png"), "expected the folder images beside poses_bounds.npy"),
    ("EuRoC", text_edit("sensor.yaml", "radial-tangential", "fov"), "undistort the images first"),
    (
        "EuRoC",
        text_edit("sensor.yaml", "camera_model: pinhole", "camera_model: omni"),
        "undistort the images first",
    ),
    ("EuRoC", text_edit("cam*/sensor.yaml", "data: [", "data: [9, "), r"T_BS: expected 16 numbers"),
    (
        "EuRoC",
        text_edit("cam*/data.csv", "14036", "15036"),
        "expected poses within 20 ms of the images, got poses at",
    ),
    ("EuRoC", without("state*/data.csv"), "expected poses in state_groundtruth_estimate0 or mocap0"),
    ("EuRoC", without("cam*/sensor.yaml"), "give its lens with --calibration camera.yaml"),
    (
        "TUM",
        text_edit("calibration.txt", "50.0 51.0", "0.78 1.06"),
        r"calibration\.txt: .*if they are normalised",
    ),
    ("TUM", clocks_apart, "expected poses within 20 ms of the images, got poses at 1305031102"),
    ("TUM", without("calibration.txt"), r"expected the camera's lens in calibration\.txt"),
    ("TUM", without("*.png"), "got 8 names and none of the files"),
    ("TUM", text_edit("rgb.txt", "rgb/", "../rgb/"), r"rgb\.txt:2: expected a time stamp and a file in"),
    (
        "TUM",
        lambda scan: (
            (scan / "groundtruth.txt").rename(scan / "a.txt").with_name("b.txt").write_text("1 2 3 4 5 6 7 8")
        ),
        "expected one trajectory, got a.txt, b.txt",
    ),
    (
        "nerfstudio",
        json_edit("transforms.json", lambda each: each.update(camera_model="EQUIRECTANGULAR")),
        "camera_model: expected",
    ),
    (
        "nerfstudio",
        json_edit("transforms.json", lambda each: each.update(fl_x=0.78, fl_y=1.06, cx=0.5, cy=0.5)),
        "if they are normalised",
    ),
    (
        "nerfstudio",
        json_edit("transforms.json", lambda each: each.update(k1=-9.0)),
        "expected a distortion that can be undone",
    ),
]


@pytest.mark.parametrize(("kind", "change", "message"), CASES)
def test_wrong_scans_are_refused_with_what_to_do(tmp_path, kind, change, message):
    scan = scan_samples.write(kind, tmp_path / "scan")
    change(scan)
    with pytest.raises(AdvnerfError, match=message) as error:
        read_scan(scan, ScanOptions())
    assert kind == "nerfstudio" or "\n" not in str(error.value)


def test_what_is_wrong_with_one_image_leaves_the_others(tmp_path):
    scan = scan_samples.polycam(tmp_path / "scan")
    first, second, third = sorted((scan / "keyframes" / "corrected_cameras").iterdir())[:3]
    first.write_text("{")
    (scan / "keyframes" / "corrected_images" / f"{second.stem}.jpg").unlink()
    third.write_text(third.read_text().replace('"t_00": ', '"t_00": 1'))
    _, found = read_scan(scan, ScanOptions())
    assert len(found.model.images) == 5
    assert len(found.model.left_out) == 3


def test_rows_where_the_tracker_lost_the_body_are_dropped(tmp_path):
    scan = scan_samples.tum(tmp_path / "scan")
    lines = (scan / "groundtruth.txt").read_text().splitlines()
    lines[40] = lines[40].split()[0] + " 0 0 0 0 0 0 0"
    lines[50] = lines[50].split()[0] + " nan nan nan 0 0 0 1"
    (scan / "groundtruth.txt").write_text("\n".join(lines))
    _, found = read_scan(scan, ScanOptions())
    assert found.facts["rows_without_pose"] == 2
    assert len(found.model.images) == 8


def test_a_large_picture_in_an_archive_is_not_unpacked(tmp_path):
    scan = scan_samples.write("Record3D", tmp_path)
    with (
        zipfile.ZipFile(scan, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("rgbd/8.jpg", "w", force_zip64=True) as stream,
    ):
        for _ in range(65):
            stream.write(bytes(2**20))
    from calibration.scans.record3d import _content

    with pytest.raises(AdvnerfError, match="expected files below 64 MiB"):
        _content(scan, "rgbd/8.jpg")


def test_a_header_that_promises_more_than_the_file_has_takes_no_memory(tmp_path):
    scan = scan_samples.llff(tmp_path)
    good = (scan / "poses_bounds.npy").read_bytes()
    (scan / "poses_bounds.npy").write_bytes(good.replace(b"(8, 17), }      ", b"(9999999999,17),}"[:16]))
    with pytest.raises(AdvnerfError, match="expected an array of numpy"):
        read_scan(scan, ScanOptions())


def test_a_folder_of_no_format_names_all(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((4, 4), np.uint8))
    with pytest.raises(AdvnerfError, match=r"Polycam \(keyframes.*TUM .*, got a\.png; .*scene from-images"):
        read_scan(tmp_path, ScanOptions())


def test_an_image_outside_the_scan_is_not_copied_to_elsewhere():
    with pytest.raises(
        ScanError, match=r"inside the folder of the scan, got one called '\.\./\.\./mine\.png'"
    ):
        Picture("../../mine.png", bytes, 4, 4)
    assert Picture("left/0001.png", bytes, 4, 4).name == "left/0001.png"
