"""Logs of other software: what their frames are, what is left out, what must be asked, and one line for what is damaged."""

import contextlib
import json
import math
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.data.logs.choice import LogChoice, LogError, LogRequest
from advnerf_core.data.logs.lerobot_write import write_lerobot
from advnerf_core.errors import AdvnerfError, ConfigError
from nodes.lab.policy_data.frames import frames_of, view_for_size
from nodes.lab.policy_data.log_facts import read_facts
from nodes.lab.policy_data.logs import open_log, open_logs
from nodes.lab.policy_data.recordings import steering_bound_rad
from tests.support.commands import advnerf
from tests.support.foreign_samples import WRITERS
from tests.support.logs import (
    CAMERA,
    COUNT,
    FPS,
    GREY,
    value,
    write_lerobot_2,
    write_lerobot_3,
    write_tub_1,
    write_tub_2,
    write_udacity,
)

SHARED = Path(__file__).parents[4] / "shared/data/logs"
FORMATS = {
    "tub 2": write_tub_2,
    "tub 1": write_tub_1,
    "udacity": lambda folder: write_udacity(folder, True, "IMG/"),
    "lerobot 2": write_lerobot_2,
    "lerobot 3": write_lerobot_3,
    "lerobot images": lambda folder: write_lerobot_3(folder, images="image"),
}


@pytest.fixture(autouse=True)
def _lerobot_is_an_extra(request):
    if (
        "lerobot"
        in str(getattr(request.node, "callspec", None) and request.node.callspec.params) + request.node.name
    ):
        pytest.importorskip("pyarrow")
        pytest.importorskip("av")


def greys(log):
    return [round(float(frame.image.mean()) / GREY, 1) for frame in log.frames()]


@pytest.mark.parametrize("form", FORMATS)
def test_frames_have_their_image_their_steering_and_their_time(tmp_path, form):
    log = open_log(FORMATS[form](tmp_path / "log"))
    frames = list(log.frames())
    assert (log.count, len(frames)) == (COUNT, COUNT)
    assert greys(log) == pytest.approx(range(COUNT), abs=0.2)
    assert [frame.steering for frame in frames] == pytest.approx([value(k) for k in range(COUNT)], abs=1e-6)
    assert log.steering() == pytest.approx([value(k) for k in range(COUNT)], abs=1e-6)
    if form != "udacity":
        times_s = [1e-9 * (frame.stamp_ns - frames[0].stamp_ns) for frame in frames]
        pauses_s = 10.0 * (np.arange(COUNT) // 4) if "lerobot" in form else 0.0  # between episodes
        assert times_s == pytest.approx(np.arange(COUNT) / FPS + pauses_s)
        assert log.rate_hz == pytest.approx(FPS)


def test_deleted_records_and_those_of_a_pilot_are_left_out(tmp_path):
    log = open_log(write_tub_2(tmp_path / "two", deleted=(2, 11), piloted=(5,)))
    assert greys(log) == pytest.approx([0, 1, 3, 4, 6, 7, 8, 9, 10], abs=0.2)
    assert log.left_out == {"deleted": 2, "not driven by the user": 1}
    log = open_log(write_tub_1(tmp_path / "one", removed=(3,), excluded=(5,)))
    assert greys(log) == pytest.approx([0, 1, 3, 5, 6, 7, 8, 9, 10, 11], abs=0.2)
    assert log.left_out == {"deleted": 1}


@pytest.mark.parametrize("header", [True, False])
@pytest.mark.parametrize(
    "prefix", ["IMG/", r"C:\Users\Ann\Desktop\run 1\IMG\\"[:-1], "/Users/ann/Desktop/IMG/", " IMG/", ""]
)
def test_a_udacity_log_is_read_as_it_was_downloaded(tmp_path, header, prefix):
    log = open_log(write_udacity(tmp_path / "log", header, prefix))
    assert (log.images, log.cameras, log.count) == ("center", ("center", "left", "right"), COUNT)
    assert greys(log) == pytest.approx(range(COUNT), abs=0.2)
    # 25 degrees at 1, to the right.
    assert log.unit.wheel_rad(0.5, "here") == pytest.approx(-math.radians(12.5))


@pytest.mark.parametrize("form", FORMATS)
def test_one_log_under_two_spellings_is_refused_and_two_cameras_of_it_are_not(tmp_path, form):
    folder = FORMATS[form](tmp_path / "log")
    (tmp_path / "link").symlink_to(folder)
    if form == "udacity":
        folder /= "driving_log.csv"
    common = LogChoice(steering_full_rad=0.4)
    with pytest.raises(LogError, match=r"every log once.* got .*/log\S* and .*/link, which are the same"):
        open_logs([LogRequest(folder), LogRequest(tmp_path / "link")], common)
    assert len(open_logs([LogRequest(folder), LogRequest(folder, "steering-offset-rad=-0.1")], common)) == 2


def test_a_camera_at_the_side_needs_an_offset(tmp_path):
    folder = write_udacity(tmp_path / "log", False)
    with pytest.raises(LogError, match=r"steering belongs to the center camera.*steering-offset-rad"):
        open_log(folder, LogChoice(images="left"))
    log = open_log(folder, LogChoice(images="left", steering_offset_rad=-0.1))
    assert log.unit.wheel_rad(0.0, "here") == pytest.approx(-0.1)
    assert next(iter(log.frames())).image.max() == 1


def write_cameras(folder, frame_ids, folders=("left", "center", "right")):
    """One row for each time and camera, as ``interpolated.csv`` of Udacity's challenge; the center image is uniform ``GREY * k``."""
    rows = [f"timestamp,{'frame_id,' if frame_ids else ''}filename,angle"]
    for k in range(COUNT):
        for n, camera in enumerate(folders):
            (folder / camera).mkdir(parents=True, exist_ok=True)
            shade = GREY * k + (0 if camera == "center" else n + 1)
            cv2.imwrite(str(folder / camera / f"{k}.png"), np.full((48, 64, 3), shade, np.uint8))
            named = f"{camera}_camera," if frame_ids else ""
            rows.append(f"{1000 * k + n},{named}{camera}/{k}.png,{value(k)}")
    (folder / "interpolated.csv").write_text("\n".join(rows) + "\n")
    return folder / "interpolated.csv"


@pytest.mark.parametrize("ending", ["_camera", ""])
def test_of_the_rows_of_several_cameras_one_s_are_taken_and_it_is_said(tmp_path, ending):
    file = write_cameras(tmp_path / "log", bool(ending))
    column = {"images": "filename", "steering": "angle"}
    log = open_log(file, LogChoice(**column))
    cameras = tuple(f"filename:{each}{ending}" for each in ("center", "left", "right"))
    assert (log.images, log.cameras, log.count) == (cameras[0], cameras, COUNT)
    assert greys(log) == list(range(COUNT))
    assert log.steering() == pytest.approx([value(k) for k in range(COUNT)])
    assert log.notes == (
        f"images of {cameras[0]}, the first of {', '.join(cameras)}; --images chooses others",
    )
    left = column | {"images": cameras[1]}
    with pytest.raises(
        LogError, match=rf"for images={cameras[1]} give .*steering-offset-rad.* use images={cameras[0]}"
    ):
        open_log(file, LogChoice(**left))
    side = open_log(file, LogChoice(**left, steering_offset_rad=-0.1))
    assert (side.count, next(iter(side.frames())).image.max(), side.notes) == (COUNT, 1, ())
    with pytest.raises(LogError, match=f"expected images filename:rear in .*, it has {', '.join(cameras)}"):
        open_log(file, LogChoice(**column | {"images": "filename:rear"}))


@pytest.mark.parametrize("folders", [("left",), ("center",), ("left", "right"), ("center", "rear")])
def test_folders_that_are_not_those_of_cameras_are_one_log(tmp_path, folders):
    """Such as drives to the left and drives to the right."""
    file = write_cameras(tmp_path / "log", False, folders)
    log = open_log(file, LogChoice("filename", "angle"))
    assert (log.images, log.cameras, log.count) == ("filename", ("filename",), len(folders) * COUNT)
    with pytest.raises(LogError, match=r"expected images filename:center in .*, it has filename; choose"):
        open_log(file, LogChoice("filename:center", "angle"))


def test_numbers_of_frames_are_no_cameras(tmp_path):
    file = write_timed(tmp_path / "log", "frame_id", range(8))
    assert (open_log(file).images, open_log(file).count) == ("image", 8)


@pytest.mark.parametrize(
    ("form", "needed"),
    [
        ("tub 2", "--steering-full-rad"),
        ("lerobot 3", "--steering-full-rad and --steering-positive"),
        ("udacity", ""),
    ],
)
def test_the_unit_of_steering_is_asked_where_the_format_does_not_state_it(tmp_path, form, needed):
    folder = FORMATS[form](tmp_path / "log")
    log = open_log(folder)
    assert log.unit.unknown == needed
    if needed:
        with pytest.raises(LogError, match=f"expected the unit of .*give {needed}"):
            frames_of(log, view_for_size(64, 48), None, "recorded")
    known = open_log(folder, LogChoice(steering_full_rad=0.4, steering_positive="left"))
    labels = frames_of(known, view_for_size(64, 48), None, "recorded").frames.steering_rad
    assert labels == pytest.approx([0.4 * value(k) for k in range(COUNT)], abs=1e-6)


def test_which_number_of_a_lerobot_data_set_is_the_steering_is_not_guessed(tmp_path):
    folder = write_lerobot_3(tmp_path / "log", names=("curvature", "speed"))
    log = open_log(folder)
    assert (log.unit, log.controls) == (None, ("action:curvature", "action:speed"))
    with pytest.raises(LogError, match="name it with --steering: action:curvature, action:speed"):
        frames_of(log, view_for_size(64, 48), None, "recorded")
    assert open_log(folder, LogChoice(steering="action:curvature")).steering()[0] == pytest.approx(value(0))
    with pytest.raises(LogError, match="expected steering action:7"):
        open_log(folder, LogChoice(steering="action:7"))
    radians = open_log(write_lerobot_3(tmp_path / "radians", names=("steering_rad", "speed")))
    assert radians.unit.unknown == "--steering-positive"


def test_a_comma_in_a_folders_name_is_no_setting(tmp_path):
    file = tmp_path / "odd,a=b" / "ok.csv"
    file.parent.mkdir()
    file.touch()
    (tmp_path / "odd").mkdir()
    for settings in ("", "steering-positive=left", "images=a,steering=b"):
        assert LogRequest.parsed(f"{file},{settings}".rstrip(",")) == LogRequest(file, settings)


def test_a_misspelt_steering_of_a_tub_is_answered_with_its_names(tmp_path):
    folder = write_tub_2(tmp_path / "log")
    with pytest.raises(
        LogError, match=r"expected steering user/angel in .*, it has user/angle, user/throttle"
    ):
        open_log(folder, LogChoice(steering="user/angel"))


def cut(file, share=0.5):
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])


def edit(file, values):
    """Replace values of the object in the last line of a file."""
    *before, last = file.read_text().strip().split("\n")
    file.write_text("\n".join([*before, json.dumps(json.loads(last) | values)]))


def describe(folder, feature=None, **values):
    """Replace values in the description of a data set, or of one of its features."""
    info = json.loads((folder / "meta/info.json").read_text())
    (info["features"][feature] if feature else info).update(values)
    (folder / "meta/info.json").write_text(json.dumps(info))


def change_table(folder, change):
    """Change the table of a data set."""
    pq = pytest.importorskip("pyarrow.parquet")
    file = folder / "data/chunk-000/file-000.parquet"
    pq.write_table(change(pq.read_table(file)), file)


DAMAGED = {
    "a catalog that was cut": ("tub 2", lambda f: cut(f / "catalog_1.catalog"), r"catalog_1\.catalog:\d: expected valid JSON"),
    "a missing catalog": ("tub 2", lambda f: (f / "catalog_1.catalog").unlink(), r"catalog_1\.catalog: expected a file, found none"),
    "a manifest without catalogs": ("tub 2", lambda f: (f / "manifest.json").write_text("[]\n[]\n"), "expected the catalogs"),
    "a missing image": ("tub 2", lambda f: (f / "images/3_cam_image_array_.jpg").unlink(), r"catalog_0\.catalog:4: .*No such file.*delete the record"),
    "a damaged image": ("tub 2", lambda f: cut(f / "images/3_cam_image_array_.jpg"), r"catalog_0\.catalog:4: expected a readable image"),
    "a record that was cut": ("tub 1", lambda f: cut(f / "record_4.json"), r"record_4\.json:1: expected valid JSON"),
    "a record without an angle": ("tub 1", lambda f: (f / "record_4.json").write_text('{"cam/image_array": "4_cam-image_array_.jpg"}'), "user/angle: expected a number, got None"),
    "an angle that no float holds": ("tub 1", lambda f: edit(f / "record_4.json", {"user/angle": 10**400}), "user/angle: expected a number, got 1000"),
    "deleted records as text": ("tub 2", lambda f: edit(f / "manifest.json", {"deleted_indexes": ["4"]}), r"manifest\.json: deleted_indexes: expected the numbers of deleted records"),
    "all records deleted": ("tub 2", lambda f: edit(f / "manifest.json", {"deleted_indexes": list(range(12))}), "that are not deleted, got 12 deleted ones"),
    "an index twice": ("tub 2", lambda f: edit(f / "catalog_1.catalog", {"_index": 4}), r"catalog_1\.catalog:5: _index: expected one .* got 4, which .*catalog_0\.catalog:5 has"),
    "no list of deleted records": ("tub 2", lambda f: edit(f / "manifest.json", {"deleted_indexes": None}), "such as .4, 5., got None"),
    "excluded records in objects": ("tub 1", lambda f: (f / "exclude.json").write_text('[{"a": 1}]'), r"exclude\.json: expected the numbers of deleted records"),
    "a catalog named twice": ("tub 2", lambda f: edit(f / "manifest.json", {"paths": ["catalog_0.catalog"] * 2}), r"expected each catalog once, got catalog_0\.catalog again"),
    "a row that was cut": ("udacity", lambda f: cut(f / "driving_log.csv", 0.97), r"driving_log\.csv:13: "),
    "rows without images": ("udacity", lambda f: [each.unlink() for each in (f / "IMG").glob("*")], r"driving_log\.csv:2: center: expected an image, found no file"),
    "a table that was cut": ("lerobot 3", lambda f: cut(f / "data/chunk-000/file-000.parquet"), r"file-000\.parquet: expected a Parquet file"),
    "no table": ("lerobot 3", lambda f: (f / "data/chunk-000/file-000.parquet").unlink(), "expected tables data"),
    "a video that was cut": ("lerobot 3", lambda f: cut(f / f"videos/{CAMERA}/chunk-000/file-000.mp4"), r"file-000\.mp4"),
    "a missing video": ("lerobot 2", lambda f: (f / f"videos/chunk-000/{CAMERA}/episode_000001.mp4").unlink(), r"episode_000001\.mp4: No such file"),
    "a description that was cut": ("lerobot 2", lambda f: cut(f / "meta/info.json"), r"info\.json:1: expected valid JSON"),
    "another version": ("lerobot 2", lambda f: (f / "meta/info.json").write_text('{"codebase_version": "v1.6", "features": {}}'), "expected codebase_version v2 or v3, got v1.6"),
    "a description of slower images": ("lerobot 3", lambda f: describe(f, fps=1), r"info\.json: fps: expected 10, as the column timestamp .*, got 1; correct it"),
    "a description of faster images": ("lerobot images", lambda f: describe(f, fps=30), r"info\.json: fps: expected 10, as"),
    "a rate that is no number": ("lerobot 2", lambda f: describe(f, fps=True), r"info\.json: fps: expected images per second, got True"),
    "a table that was not copied": ("lerobot 2", lambda f: (describe(f, total_frames=12), (f / "data/chunk-000/episode_000001.parquet").unlink()), r"total_frames .*, got 12 for 8 rows; a table is missing"),
    "times that repeat": ("lerobot 3", lambda f: change_table(f, lambda rows: rows.take([0, *range(11)])), "timestamp: expected times that go forward in each episode"),
    "names of more numbers": ("lerobot 3", lambda f: describe(f, "action", shape=[3], names=["a", "b", "steering"]), r"features\.action\.shape: expected 2 numbers, as the tables have, got \[3\]"),
    "a shape that is no list": ("lerobot 3", lambda f: describe(f, "action", shape=2), r"features\.action\.shape: expected a list such as \[2\], got 2"),
    "a table without rows": ("lerobot 3", lambda f: change_table(f, lambda rows: rows.slice(0, 0)), r"file-000\.parquet: expected rows, got none"),
    "an image in two records": ("tub 2", lambda f: edit(f / "catalog_1.catalog", {"cam/image_array": "3_cam_image_array_.jpg"}), r"catalog_1\.catalog:5: expected an image that nothing else has, got \S*3_cam_image_array_\.jpg, which \S*catalog_0\.catalog:4 has"),
    "a row twice": ("udacity", lambda f: (f / "driving_log.csv").write_text((f / "driving_log.csv").read_text() + (f / "driving_log.csv").read_text().split("\n")[1]), r"driving_log\.csv:14: expected an image that nothing else has, got .* which \S*driving_log\.csv:2 has"),
    "an index as text": ("tub 2", lambda f: (edit(f / "catalog_1.catalog", {"_index": "9"}), edit(f / "manifest.json", {"deleted_indexes": [9]})), r"catalog_1\.catalog:5: _index: expected a number, as records are deleted by theirs, got '9'"),
    "missing episodes": ("lerobot 3", lambda f: (f / "meta/episodes/chunk-000/file-000.parquet").unlink(), "expected episode 0, found none"),
}  # fmt: skip


@pytest.mark.parametrize(("unit", "per_s"), [("milliseconds", 1000), ("microseconds", 1000000)])
def test_a_lerobot_data_set_in_another_unit_of_time_is_not_blamed_on_its_rate(tmp_path, unit, per_s):
    folder = write_lerobot_3(tmp_path / "log")

    def scaled(rows):
        values = [per_s * each for each in rows["timestamp"].to_pylist()]
        return rows.set_column(rows.column_names.index("timestamp"), "timestamp", [values])

    change_table(folder, scaled)
    said = rf"timestamp: expected seconds, got what looks like {unit}, as fps is 10; divide the column by"
    with pytest.raises(LogError, match=said):
        open_log(folder)


@pytest.mark.parametrize("images", ["video", "image"])
@pytest.mark.parametrize("rows", [[*range(8, 12), *range(8)], [0, 4, 1, 5, 2, 6, 3, 7, *range(8, 12)]])
def test_rows_of_a_lerobot_data_set_keep_their_images_in_any_order(tmp_path, images, rows):
    """A table with episode 2 before 0 and 1, and one with rows of 0 and 1 by turns."""
    folder = write_lerobot_3(tmp_path / "log", images=images)
    change_table(folder, lambda table: table.take(rows))
    log = open_log(folder)
    frames = list(log.frames())
    numbers = [round(float(frame.image.mean()) / GREY) for frame in frames]
    assert numbers == (list(range(COUNT)) if images == "video" else rows)
    assert [frame.steering for frame in frames] == pytest.approx([value(k) for k in numbers])
    assert log.steering() == pytest.approx([value(k) for k in numbers])
    assert (np.diff([frame.stamp_ns for frame in frames]) > 0).all()
    at = [f"{folder}, frame {rows.index(k)}" for k in numbers]
    assert [frame.place for frame in frames] == at


@pytest.mark.parametrize("form", ["lerobot 2", "lerobot 3", "lerobot images"])
def test_only_the_episodes_of_one_split_of_a_lerobot_data_set_are_taken(tmp_path, form):
    folder = FORMATS[form](tmp_path / "log")
    describe(folder, splits={"train": "0:3"})
    assert (open_log(folder).count, open_log(folder).notes) == (COUNT, ())
    describe(folder, splits={"val": "1:2", "test": "3:4", "train": "0:1", "odd": "10 %"})
    for split, numbers in (
        (None, range(4)),
        ("train", range(4)),
        ("val", range(4, 8)),
        ("all", range(COUNT)),
    ):
        log = open_log(folder, LogChoice(split=split))
        assert greys(log) == pytest.approx(numbers, abs=0.2)
        assert log.steering() == pytest.approx([value(k) for k in numbers])
        assert log.count == len(numbers)
        assert log.left_out == ({"of another split": 8} if log.count == 4 else {})
        assert [f"split {split or 'train'}, of train, val, test, odd; " in note for note in log.notes] == (
            [True] if log.left_out else []
        )
    for split, said in (
        ("test", "expected frames of the split test, episodes 3:4, got none"),
        ("odd", r"info\.json: splits\.odd: expected episodes such as 0:50, got '10 %'"),
        ("dev", "expected the split dev in .*, it has train, val, test, odd, all"),
    ):
        with pytest.raises(LogError, match=said):
            open_log(folder, LogChoice(split=split))


def test_a_split_of_another_format_is_refused(tmp_path):
    with pytest.raises(LogError, match=r"split: expected a LeRobot data set, got .*tub; leave it out"):
        open_log(write_tub_2(tmp_path / "tub"), LogChoice(split="val"))


@pytest.mark.parametrize("case", DAMAGED)
def test_what_is_damaged_is_one_line(tmp_path, case):
    form, damage, said = DAMAGED[case]
    if "lerobot" in form:
        pytest.importorskip("pyarrow")
    folder = FORMATS[form](tmp_path / "log")
    damage(folder)
    with pytest.raises(AdvnerfError, match=said) as caught:
        list(open_log(folder, LogChoice(steering_full_rad=0.4)).frames())
    assert "\n" not in str(caught.value).split("\n", 1)[0]
    assert len(str(caught.value).split("\n")[0]) < 500


def test_random_damage_never_escapes_as_another_error(tmp_path):
    rng = np.random.default_rng(0)
    for form, name in (
        ("tub 2", "manifest.json"),
        ("tub 1", "record_4.json"),
        ("udacity", "driving_log.csv"),
    ):
        folder = FORMATS[form](tmp_path / name)
        content = (folder / name).read_bytes()
        for _ in range(100):
            spoiled = bytearray(content)
            for place in rng.integers(0, len(spoiled), 3):
                spoiled[place] = rng.integers(256)
            (folder / name).write_bytes(bytes(spoiled))
            with contextlib.suppress(AdvnerfError):
                list(open_log(folder, LogChoice(steering_full_rad=0.4)).frames())


def test_random_damage_of_a_lerobot_data_set_never_escapes_as_another_error(tmp_path):
    rng = np.random.default_rng(0)
    folder = write_lerobot_3(tmp_path / "log")
    for name in (
        "meta/info.json",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
    ):
        content = (folder / name).read_bytes()
        for _ in range(60):
            spoiled = bytearray(content)
            for place in rng.integers(0, len(spoiled), 3):
                spoiled[place] = rng.integers(256)
            (folder / name).write_bytes(bytes(spoiled))
            with contextlib.suppress(AdvnerfError):
                list(open_log(folder).frames())
        (folder / name).write_bytes(content)


@pytest.mark.parametrize("form", ["lerobot 2", "lerobot 3", "lerobot images"])
def test_the_episodes_of_a_lerobot_data_set_are_kept_apart(tmp_path, form):
    log = open_log(
        FORMATS[form](tmp_path / "log"), LogChoice(steering_full_rad=0.4, steering_positive="left")
    )
    assert write_lerobot(log, tmp_path / "out").episodes == 3
    view = view_for_size(64, 48)
    for each in (log, open_log(tmp_path / "out")):
        frames = frames_of(each, view, None, "recorded")
        assert (frames.has_times, frames.drive_starts()) == (True, [0, 4, 8])


def test_times_that_go_back_start_another_drive_and_rows_without_times_do_not(tmp_path):
    pytest.importorskip("pyarrow")
    choice, view = LogChoice(steering_full_rad=0.4), view_for_size(64, 48)
    folder = write_tub_2(tmp_path / "tub")
    second = folder / "catalog_1.catalog"
    second.write_text(second.read_text().replace("17000000", "16999990"))
    log = open_log(folder, choice)
    assert write_lerobot(log, tmp_path / "out").episodes == 3
    assert frames_of(log, view, None, "recorded").drive_starts() == [0, 5, 10]
    rows = frames_of(open_log(write_udacity(tmp_path / "rows", True, "IMG/")), view, None, "recorded")
    assert (rows.has_times, rows.drive_starts()) == (False, [0])


@pytest.mark.parametrize(
    ("write", "episodes"),
    [
        (lambda folder: write_tub_2(folder, step_ms=None), 1),
        (lambda folder: write_tub_2(folder, step_ms=None, deleted=[0, 5, 11]), 2),
        (lambda folder: write_tub_2(folder, step_ms=None, piloted=[3, 4, 9]), 3),
        (lambda folder: write_tub_2(folder, deleted=[5]), 2),
        (lambda folder: write_tub_1(folder, removed=[4]), 2),
        (lambda folder: write_tub_1(folder, excluded=[4, 9]), 3),
    ],
)
def test_records_that_were_deleted_end_an_episode(tmp_path, write, episodes):
    pytest.importorskip("pyarrow")
    log = open_log(write(tmp_path / "tub"), LogChoice(steering_full_rad=0.4))
    assert write_lerobot(log, tmp_path / "out", 10).episodes == episodes


@pytest.mark.parametrize(
    ("step_ms", "rate_hz", "said"),
    [
        (100, 30, "--rate: expected about 10, the images per second of .*tub, got 30; leave it out"),
        (100, 12, ""),
        (3, 20, ""),
        (8, 20, "--rate: expected about 125, the images"),
        (2000, None, ""),
        (None, 5000, "--rate: expected 1 to 1000 images per second, got 5000"),
    ],
)
def test_an_export_keeps_the_speed_of_the_drive(tmp_path, step_ms, rate_hz, said):
    pytest.importorskip("pyarrow")
    log = open_log(write_tub_2(tmp_path / "tub", step_ms=step_ms), LogChoice(steering_full_rad=0.4))
    with pytest.raises(LogError, match=said) if said else contextlib.nullcontext():
        assert write_lerobot(log, tmp_path / "out", rate_hz).rate_hz == (rate_hz or 1)
    assert (tmp_path / "out").exists() == (not said)


def test_an_export_keeps_the_notes_about_its_log(tmp_path):
    pytest.importorskip("pyarrow")
    choice = LogChoice(steering_full_rad=0.4)
    log = open_log(write_tub_2(tmp_path / "tub", step_ms=4, deleted=(2,), piloted=(5, 6)), choice)
    write_lerobot(log, tmp_path / "out", 20)
    first, _, *said = (tmp_path / "out/README.md").read_text().splitlines()
    assert first.startswith("9 images of cam/image_array in tub, a Donkeycar tub, version 2; ")
    assert said == [
        "- left out: 1 deleted",
        "- left out: 2 not driven by the user",
        f"- {log.notes[0]}",
    ]


def test_what_is_no_log_is_told_apart(tmp_path):
    (tmp_path / "segment").mkdir()
    (tmp_path / "segment" / "video.hevc").write_bytes(b"x")
    with pytest.raises(LogError, match=r"segment of comma\.ai's logs.*convert it to a LeRobot data set"):
        open_log(tmp_path / "segment")
    with pytest.raises(LogError, match=r"expected a bag .*, got .*\(segment\); name the folder of one log"):
        open_log(tmp_path)


def test_a_log_has_settings_of_its_own(tmp_path):
    tub, drive = write_tub_2(tmp_path / "a,b=c"), write_udacity(tmp_path / "drive", False)
    requests = [
        LogRequest.parsed(f"{tub}"),
        LogRequest.parsed(f"{drive},images=right,steering-offset-rad=0.1"),
    ]
    one, other = open_logs(requests, LogChoice(steering_full_rad=0.4))
    assert (one.log.unit.full_rad, one.log.images) == (0.4, "cam/image_array")
    assert (other.log.unit.offset_rad, other.log.images) == (0.1, "right")
    assert steering_bound_rad([one, other]) == pytest.approx(1.1 * (0.6 * 0.4 + 0.1))
    for text, said in [
        (f"{drive},image=left", "expected settings of a log among images, steering"),
        (f"{drive},steering-full-rad=-1", "expected a positive wheel angle"),
        (f"{drive},steering-full-rad=wide", "steering-full-rad: expected a number"),
        (f"{drive},steering-positive=up", "expected left or right, got 'up'"),
        (f"{tmp_path / 'nope'}", "expected a log at .*nope, found none"),
    ]:
        with pytest.raises(LogError, match=said):
            LogRequest.parsed(text)


@pytest.mark.parametrize(
    ("form", "change", "policy", "scene", "evaluation"),
    [
        ("tub 2", {}, "no: give --steering-full-rad", "no: 12 images are too few", "no: give --steering-full-rad"),
        ("tub 2", {"steering_full_rad": 0.4}, "yes: labels are the recorded steering; 12 images are few, expect a weak policy", "no: 12 images are too few", "yes: against the recorded steering; too short for --held-out"),
        ("tub 2", {"steering": "user/throttle", "steering_full_rad": 0.4}, "no: the steering is always 0.4", "no: 12 images are too few", "no: the steering is always 0.4"),
        ("lerobot 3", {"steering": "action:throttle"}, "no: the steering is always 0.4", "no: 12 images are too few", "no: the steering is always 0.4"),
    ],
)  # fmt: skip
def test_what_a_log_allows_is_said(tmp_path, form, change, policy, scene, evaluation):
    facts = read_facts(open_log(FORMATS[form](tmp_path / "log"), LogChoice(**change)))
    said = [f"{'yes' if each.possible else 'no'}: {each.why}" for each in facts.verdicts()]
    assert said == [policy, scene, evaluation]


def test_a_log_of_one_image_allows_nothing(tmp_path):
    folder = write_tub_2(tmp_path / "log")
    first = (folder / "images/0_cam_image_array_.jpg").read_bytes()
    for file in (folder / "images").iterdir():
        file.write_bytes(first)
    facts = read_facts(open_log(folder, LogChoice(steering_full_rad=0.4)))
    assert [(each.possible, each.why) for each in facts.verdicts()] == [
        (False, "the images are all the same")
    ] * 3


def test_an_image_of_another_size_is_found_as_training_finds_it(tmp_path):
    folder = write_tub_2(tmp_path / "log", count=50)
    cv2.imwrite(str(folder / "images/40_cam_image_array_.jpg"), np.zeros((60, 80, 3), np.uint8))
    log = open_log(folder, LogChoice(steering_full_rad=0.4))
    policy, scene, evaluation = read_facts(log).verdicts()
    assert (policy.possible, scene.possible, evaluation.possible) == (False, True, False)
    said = r"catalog_8\.catalog:1: expected images of one size, 64 x 48, got 80 x 60"
    assert re.search(said, policy.why)
    with pytest.raises(LogError, match=r"catalog_8\.catalog:1: .*got 80 x 60; .* remove this one"):
        frames_of(log, view_for_size(64, 48), None, "recorded")


@pytest.mark.parametrize(("angle", "refused"), [(7.0, True), (-90.0, True), (1.2, False), (-1.0, False)])
def test_an_angle_far_outside_of_the_range_of_a_tub_is_refused(tmp_path, angle, refused):
    folder = write_tub_2(tmp_path / "log")
    catalog = folder / "catalog_1.catalog"
    catalog.write_text(catalog.read_text().replace(f'"user/angle": {value(6)}', f'"user/angle": {angle}', 1))
    said = pytest.raises(ConfigError, match=r"catalog_1\.catalog:2: user/angle: expected -1 to 1, got")
    with said if refused else contextlib.nullcontext():
        assert angle in open_log(folder, LogChoice(steering_full_rad=0.1)).steering()


def test_a_bag_says_what_it_lacks(tmp_path):
    bag = WRITERS["mcap"](tmp_path / "drive")
    facts = read_facts(open_log(bag))
    assert facts.log.poses == facts.log.count > 0
    policy, scene, evaluation = facts.verdicts()
    assert (policy.possible, scene.possible, evaluation.possible) == (True, False, False)
    assert (
        "no steering found; wheel angles are read from ackermann_msgs/msg/AckermannDriveStamped, the bag has nothing like it"
        in evaluation.why
    )


def test_the_commands_train_on_several_logs_and_evaluate_held_out_frames(tmp_path, monkeypatch, capsys):
    drive = str(write_udacity(tmp_path / "drive", False, "IMG/"))
    tub = str(write_tub_2(tmp_path / "tub", size=(60, 80)))
    for k, file in enumerate((tmp_path / "tub/images").iterdir()):  # not the images of the other drive
        cv2.imwrite(str(file), np.full((60, 80, 3), GREY * k + 9, np.uint8))
    logs = [drive, f"{tub},steering-full-rad=0.4"]
    assert advnerf(monkeypatch, "policy", "train", *logs, "--steps", "2", "-o", str(tmp_path / "policy")) == 0
    shown = capsys.readouterr().out
    assert "recorded: steering, 1 is 0.436 rad to the right" in shown
    assert "recorded: user/angle, 1 is 0.4 rad to the right" in shown
    assert "images of 80 x 60 are cropped at the same fraction as the policy's of 64 x 48" in shown
    policy = str(tmp_path / "policy/policy.safetensors")
    about = json.loads((tmp_path / "policy/policy.json").read_text())
    assert about["frames"] == dict.fromkeys(logs, COUNT)
    assert (
        advnerf(monkeypatch, "policy", "eval", policy, *logs, "--saliency", "0", "-o", str(tmp_path / "eval"))
        == 0
    )
    assert len(list((tmp_path / "eval").glob("*/steering.png"))) == 2
    assert (
        advnerf(monkeypatch, "policy", "eval", policy, drive, "--held-out", "-o", str(tmp_path / "eval")) == 2
    )
    assert "expected frames of" in capsys.readouterr().err
    assert advnerf(monkeypatch, "policy", "train", tub, "-o", str(tmp_path / "none")) == 2
    assert "give --steering-full-rad" in capsys.readouterr().err
    assert advnerf(monkeypatch, "policy", "log", "info", *logs) == 0
    assert "CSV file of Udacity's simulator" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("step_ms", "said"),
    [
        (-100, "times that go back or repeat"),
        (0, "times that go back or repeat"),
        (None, "no times"),
        (4000, "0.25 Hz"),
        (0.1, "9,986 Hz: times in another unit"),
    ],
)
def test_what_is_wrong_with_the_times_of_a_log_is_said(tmp_path, monkeypatch, capsys, step_ms, said):
    tub = f"{write_tub_2(tmp_path / 'tub', step_ms=step_ms)},steering-full-rad=0.4"
    assert advnerf(monkeypatch, "policy", "log", "info", tub) == 0
    shown = " ".join(capsys.readouterr().out.split())  # lines are broken where the screen ends
    assert f"12 of 64 x 48, {said}, cam/image_array" in shown
    assert advnerf(monkeypatch, "policy", "log", "export", tub, "-o", str(tmp_path / "out")) == 2
    refused = capsys.readouterr().err
    assert "expected times of the images of 0.5 to 1000 Hz in " in refused
    assert f"got {said}; give the images per second" in refused
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("step_ms", "is_told"), [(3, True), (7, True), (8, False), (100, False), (0.1, False)]
)
def test_times_of_a_conversion_are_told(tmp_path, monkeypatch, capsys, step_ms, is_told):
    pytest.importorskip("pyarrow")
    pytest.importorskip("av")
    tub = f"{write_tub_2(tmp_path / 'tub', step_ms=step_ms)},steering-full-rad=0.4"
    export = ["log", "export", tub, "--rate", "20", "-o", str(tmp_path / "set")]
    train = ["train", tub, "--steps", "1", "-o", str(tmp_path / "policy")]
    for command in (["log", "info", tub], train, *([export] if is_told else [])):
        assert advnerf(monkeypatch, "policy", *command) == 0
        shown = " ".join(capsys.readouterr().out.split())
        assert ("times that look like those of a conversion" in shown) is is_told
    if is_told:
        assert open_log(tmp_path / "set").rate_hz == 20


def write_timed(folder, column, times):
    """A CSV file with a column of times."""
    folder.mkdir()
    for k in range(len(times)):
        cv2.imwrite(str(folder / f"{k}.png"), np.full((48, 64, 3), GREY * k, np.uint8))
    rows = [f"{k}.png,{value(k)},{time}" for k, time in enumerate(times)]
    (folder / "drive.csv").write_text("\n".join([f"image,steering,{column}", *rows]) + "\n")
    return folder / "drive.csv"


FORWARD = [1700000000 + 0.1 * k for k in range(8)]
DAYS = [f"2026-11-30T10:00:0{k}Z" for k in range(8)]


@pytest.mark.parametrize(
    ("column", "times", "row"),
    [
        ("time", [*FORWARD[:3], *FORWARD[:-3:-1], FORWARD[3]], 6),
        ("Timestamp [ms]", [3, 2, 1, 0], 3),
        ("header.stamp_ns", [1, 2, 3, 1e-3], 5),
        ("t", [0.1, 0.2, 0.0, 0.1], 4),
        ("datetime", [*DAYS[4:], *DAYS[:4]], 6),
        ("stamp", [*DAYS[4:], *DAYS[:4]], 6),
        ("time", ["10:00:03.250", "10:00:03.350", "10:00:01.000", "10:00:02"], 4),
        ("exposure_time", [3, 2, 1, 0], None),
        ("timeout", [3, 2, 1, 0], None),
        ("tilt", [3, 2, 1, 0], None),
        ("timestamp", ["b", "a", "c", "a"], None),
        ("time", FORWARD, None),
        ("time", DAYS, None),
    ],
)
def test_rows_that_are_not_in_the_order_of_their_times_are_refused(tmp_path, column, times, row):
    file = write_timed(tmp_path / "log", column, times)
    if row is None:
        assert math.isnan(open_log(file).rate_hz)
        return
    said = rf"drive\.csv:{row}: {re.escape(column)}: expected times that go forward, got '{times[row - 2]}' after '{times[row - 3]}'; sort"
    with pytest.raises(LogError, match=said):
        open_log(file)


def test_times_of_a_slow_clock_are_said(tmp_path, monkeypatch, capsys):
    file = write_timed(tmp_path / "log", "time_s", [1700000000 + k // 3 for k in range(8)])
    log = f"{file},steering-full-rad=0.4,steering-positive=left"
    out = ["-o", str(tmp_path / "out")]
    for command in (["log", "info", log], ["train", log, "--steps", "1", *out]):
        assert advnerf(monkeypatch, "policy", *command) == 0
        assert "times that go back or repeat" in " ".join(capsys.readouterr().out.split())
    pytest.importorskip("pyarrow")
    pytest.importorskip("av")
    export = ["log", "export", log, "--rate", "10", "-o", str(tmp_path / "set")]
    assert advnerf(monkeypatch, "policy", *export) == 0
    assert "the log has times that go back or repeat" in capsys.readouterr().out


def test_columns_of_other_names_are_answered_with_the_options_that_name_them(tmp_path):
    file = write_timed(tmp_path / "log", "time", FORWARD)
    file.write_text(file.read_text().replace("image,steering", "Image,steering_deg"))
    said = "expected columns image, steering, got Image, steering_deg, time; name yours with --images and --steering"
    with pytest.raises(ConfigError, match=said):
        open_log(file)
    assert open_log(file, LogChoice(images="Image", steering="steering_deg")).count == len(FORWARD)


def test_a_csv_file_in_degrees_is_one_line_with_the_setting_for_it(tmp_path):
    file = write_timed(tmp_path / "log", "time", FORWARD)
    file.write_text(
        re.sub(r"png,([-.0-9]+)", lambda found: f"png,{30 * float(found[1]) + 20}", file.read_text())
    )
    unit = LogChoice(steering_full_rad=1.0, steering_positive="left")
    with pytest.raises(
        AdvnerfError, match=r"got 2 times 1; these look like degrees: give --steering-full-rad 0\.01745$"
    ):
        open_log(file, unit)


@pytest.mark.skipif(not SHARED.exists(), reason="the shared logs are not here")
def test_the_tub_of_donkeycar_s_tests_is_read_and_a_bag_without_images_refused():
    log = open_log(SHARED / "donkey_tub", LogChoice(steering_full_rad=0.3))
    frames = frames_of(log, view_for_size(160, 120), None, "recorded").frames
    assert len(frames) == log.count == 80
    assert frames.steering_rad[0] == pytest.approx(-0.3 * 0.2986039775370604)
    for name in ("talker.mcap", "talker.db3", "split", "topics_and_services.db3"):
        with pytest.raises(LogError, match=r"expected images in .*, it has none"):
            open_log(SHARED / "rosbag2" / name)
