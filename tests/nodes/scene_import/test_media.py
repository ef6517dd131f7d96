import os
import sys

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import MediaConfig, gather, photographs_in

RNG = np.random.default_rng(0)


def quiet(share, text=""):
    pass


def photo(path, width=60, height=40):
    path.parent.mkdir(parents=True, exist_ok=True)
    coarse = RNG.integers(0, 255, (height // 10, width // 10, 3), np.uint8)
    assert cv2.imwrite(str(path), cv2.resize(coarse, (width, height), interpolation=cv2.INTER_NEAREST))
    return path


def turned(path, orientation):
    """Write EXIF data with an orientation into a JPEG (TIFF 6.0: one directory with one entry, tag 0x0112)."""
    data = path.read_bytes()
    tiff = b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0" + bytes([orientation, 0, 0, 0]) + b"\0\0\0\0"
    body = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(body) + 2).to_bytes(2, "big") + body + data[2:])


def test_each_folder_is_a_camera_and_names_sort_as_people_count(tmp_path):
    for name in ("IMG 10.jpg", "IMG 9.jpg", "IMG 100.jpg"):
        photo(tmp_path / "my phone" / name)
    photo(tmp_path / "other" / "a.png")
    (tmp_path / "other" / "notes.txt").write_text("no image")
    sources = gather([tmp_path / "my phone", tmp_path / "other"], tmp_path / "out", MediaConfig(), quiet)
    assert [source.camera_id for source in sources] == ["my_phone", "other"]
    assert sources[0].images == tuple(f"images/my_phone/IMG_{n}.jpg" for n in (9, 10, 100))
    assert (tmp_path / "out" / sources[1].images[0]).read_bytes() == (
        tmp_path / "other" / "a.png"
    ).read_bytes()
    one = gather(
        [tmp_path / "my phone", tmp_path / "other"], tmp_path / "out", MediaConfig(one_camera=True), quiet
    )
    assert {source.camera_id for source in one} == {"camera"}


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_photographs_are_turned_upright_for_readers_without_exif(tmp_path, orientation, turns):
    file = photo(tmp_path / "phone" / "a.jpg")
    before = read_stored(file)[0]
    turned(file, orientation)
    gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    raw = cv2.imread(
        str(tmp_path / "out/images/phone/a.jpg"), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    )
    expected = np.rot90(before, turns)
    assert raw.shape == expected.shape
    assert np.abs(raw[..., ::-1].astype(int) - expected).mean() < 6.0


def test_a_second_run_copies_nothing_and_drops_what_left(tmp_path):
    files = [photo(tmp_path / "phone" / f"{k}.jpg") for k in range(3)]
    (source,) = gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    stamps = [(tmp_path / "out" / name).stat().st_mtime_ns for name in source.images]
    files[1].unlink()
    (again,) = gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    assert again.images == (source.images[0], source.images[2])
    assert [(tmp_path / "out" / name).stat().st_mtime_ns for name in again.images] == [stamps[0], stamps[2]]
    assert not (tmp_path / "out" / source.images[1]).exists()


def test_older_photographs_of_the_same_names_replace_the_copies(tmp_path):
    """Cameras count from IMG_0001 again: the copies of the first day are no pictures of the second, which may be older than they are."""
    first, second = photo(tmp_path / "day1" / "phone" / "0.jpg"), photo(tmp_path / "day2" / "phone" / "0.jpg")
    cv2.imwrite(str(second), np.zeros((24, 32, 3), np.uint8))
    os.utime(second, ns=(0, 1_000_000_000))
    for file in (first, second):
        (source,) = gather([file.parent], tmp_path / "out", MediaConfig(), quiet)
        assert (tmp_path / "out" / source.images[0]).read_bytes() == file.read_bytes()


def test_at_most_so_many_are_taken_evenly(tmp_path):
    for k in range(9):
        photo(tmp_path / "phone" / f"{k}.jpg")
    (source,) = gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(most=3), quiet)
    assert [name[-5] for name in source.images] == ["0", "4", "8"]


def test_damaged_and_missing_media_are_named(tmp_path):
    damaged = photo(tmp_path / "phone" / "a.jpg")
    damaged.write_bytes(damaged.read_bytes()[:-100])
    with pytest.raises(ImportRecordingError, match=r"not one of 1 .*a\.jpg \(\d+ bytes\): it is damaged"):
        gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImportRecordingError, match=r"expected photographs .* in .*empty, got none"):
        photographs_in(tmp_path / "empty")
    with pytest.raises(ImportRecordingError, match="found none"):
        gather([tmp_path / "nothing.mp4"], tmp_path / "out", MediaConfig(), quiet)


def test_damaged_photographs_are_left_out_and_all_named(tmp_path, capsys):
    for name in ("a.jpg", "b.jpg", "c.png", "d.jpg"):
        photo(tmp_path / "phone" / name, 600, 400)
    (tmp_path / "phone/b.jpg").write_bytes(b"")
    data = (tmp_path / "phone/d.jpg").read_bytes()
    (tmp_path / "phone/d.jpg").write_bytes(data[: len(data) // 2])
    (tmp_path / "phone/raw.dng").write_bytes(b"II*\0")
    (source,) = gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    assert [name.rsplit("/", 1)[1] for name in source.images] == ["a.jpg", "c.png"]
    said = capsys.readouterr().out
    assert "2 of 4 photographs cannot be read" in said
    assert "b.jpg" in said
    assert "d.jpg" in said
    assert "1 .dng" in said


@pytest.mark.parametrize("orientation", [1, 6])
def test_heic_photographs_become_upright_jpegs_with_their_focal_length(tmp_path, orientation):
    heif = pytest.importorskip("pillow_heif")
    image = pytest.importorskip("PIL.Image")
    pixels = cv2.resize(RNG.integers(0, 255, (4, 6, 3), np.uint8), (96, 64), interpolation=cv2.INTER_NEAREST)
    (tmp_path / "phone").mkdir()
    heif.register_heif_opener()
    exif = image.Exif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769)[0xA405] = 26  # focal length as of 35 mm film
    picture = image.fromarray(pixels)
    picture.info["exif"] = exif.tobytes()  # from here the library takes how the decoder is to turn it
    picture.save(tmp_path / "phone/IMG_1.HEIC", quality=95)
    (source,) = gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
    assert source.images == ("images/phone/IMG_1.jpg",)
    with image.open(tmp_path / "out" / source.images[0]) as copy:
        expected = np.rot90(pixels, {1: 0, 6: 3}[orientation])
        assert copy.size == expected.shape[1::-1]
        assert np.abs(np.asarray(copy).astype(int) - expected).mean() < 12.0
        assert copy.getexif().get(0x0112, 1) == 1
        assert copy.getexif().get_ifd(0x8769)[0xA405] == 26


def test_heic_without_its_reader_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "phone").mkdir()
    (tmp_path / "phone/IMG_1.heic").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    with pytest.raises(DatasetError, match=r"IMG_1\.heic.*pip install pillow-heif"):
        gather([tmp_path / "phone"], tmp_path / "out", MediaConfig(), quiet)
