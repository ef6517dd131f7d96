"""Stored and upright pixels, alpha and damage, held against pictures that were made here and against Pillow."""

import io
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image, ImageOps

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_bytes import is_damaged
from advnerf_core.data.image_files import image_size, read_mask, read_stored, read_upright
from advnerf_core.data.transforms import load_transforms
from nodes.lab.policy_data.logs import open_log
from nodes.lab.wizards.bags import read_picture

CASE = Path(__file__).parents[4] / "shared/data/cases/exif_transforms"
RNG = np.random.default_rng(0)
# No two of the eight ways to turn it look alike.
PICTURE = cv2.resize(RNG.integers(0, 255, (4, 6, 3), np.uint8), (60, 40), interpolation=cv2.INTER_NEAREST)
LOSSLESS = {"png": {}, "tiff": {"compression": "tiff_lzw"}, "webp": {"lossless": True}}


def oriented(path, orientation, pixels=PICTURE, **options):
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif, **options)
    return path


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", ["jpg", "png", "tiff", "webp"])
def test_stored_pixels_ignore_the_orientation_and_upright_ones_follow_it(tmp_path, suffix, orientation):
    options = LOSSLESS.get(suffix, {"quality": 100, "subsampling": 0})
    path = oriented(tmp_path / f"a.{suffix}", orientation, **options)
    tolerance = 6 if suffix == "jpg" else 0
    stored, upright = read_stored(path)[0], read_upright(path)[0]
    assert image_size(path) == (60, 40)
    assert np.abs(stored.astype(int) - PICTURE).max() <= tolerance
    # Pillow turns a TIFF by itself; the others where it is asked.
    expected = np.asarray(ImageOps.exif_transpose(Image.open(path)).convert("RGB"))
    assert upright.shape == expected.shape
    assert np.abs(upright.astype(int) - expected).max() <= tolerance
    assert np.array_equal(read_mask(path), stored.max(axis=-1))


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_calibration_pictures_and_logs_are_read_as_stored(tmp_path, orientation):
    square = np.ascontiguousarray(PICTURE[:, :40])
    path = oriented(tmp_path / "a.jpg", orientation, square, quality=100, subsampling=0)
    assert np.abs(read_picture(path).astype(int) - square).max() <= 6
    log = tmp_path / "log.csv"
    log.write_text("image,steering\na.jpg,0.1\n")
    turned = open_log(log).first_image()
    Image.fromarray(square).save(path, quality=100, subsampling=0)
    np.testing.assert_array_equal(turned, open_log(log).first_image())


@pytest.mark.skipif(not CASE.exists(), reason="the shared cases are not here")
def test_posed_photographs_with_an_orientation_keep_their_pixels():
    listed = load_transforms(CASE / "transforms.json")
    for frame, rgb in zip(listed.frames, listed.load().rgb, strict=True):
        with Image.open(frame.path) as picture:
            assert picture.getexif()[0x0112] == 3
            assert np.abs(rgb.astype(int) - np.asarray(picture)).mean() < 1.0


def associated(path, rgba):
    """A TIFF whose colours are multiplied by alpha and which says so (TIFF 6.0: ExtraSamples = 1)."""
    weight = rgba[..., 3:] / 255.0
    premultiplied = np.concatenate([np.rint(rgba[..., :3] * weight), rgba[..., 3:]], axis=-1).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(premultiplied).save(buffer, "TIFF")
    data, tag = bytearray(buffer.getvalue()), b"\x52\x01\x03\x00\x01\x00\x00\x00"
    at = data.index(tag) + len(tag)
    assert data[at] == 2
    data[at] = 1
    path.write_bytes(data)


@pytest.mark.parametrize("kind", ["associated", "unassociated", "unassociated lzw", "png"])
def test_colours_behind_alpha_are_the_pictures_own(tmp_path, kind):
    rgba = np.dstack([PICTURE, np.full(PICTURE.shape[:2], 255, np.uint8)])
    rgba[:, :30, 3] = 100
    path = tmp_path / ("a.png" if kind == "png" else "a.tiff")
    if kind == "associated":
        associated(path, rgba)
    else:
        Image.fromarray(rgba).save(path, **({"compression": "tiff_lzw"} if "lzw" in kind else {}))
    rgb, alpha = read_stored(path)
    np.testing.assert_array_equal(alpha, rgba[..., 3])
    assert np.abs(rgb.astype(int) - PICTURE).max() <= (2 if kind == "associated" else 0)


def photograph(**options):
    fine = np.clip(cv2.resize(PICTURE, (640, 480)) + RNG.normal(0, 5, (480, 640, 3)), 0, 255)
    buffer = io.BytesIO()
    Image.fromarray(fine.astype(np.uint8)).save(buffer, "JPEG", quality=92, **options)
    return buffer.getvalue()


def test_what_is_transparent_in_a_mask_is_not_kept(tmp_path):
    """As of tools that cut a picture out: they kept all of it."""
    pixels = np.full((4, 6, 4), 200, np.uint8)
    pixels[:, 2:, 3] = pixels[0, :2, :3] = 0
    assert cv2.imwrite(str(tmp_path / "mask.png"), pixels)
    assert np.argwhere(read_mask(tmp_path / "mask.png")).tolist() == [
        [y, x] for y in (1, 2, 3) for x in (0, 1)
    ]


@pytest.mark.parametrize("options", [{}, {"optimize": True}, {"progressive": True}, {"subsampling": 0}])
@pytest.mark.parametrize("hole", ["zeros", "noise", "missing"])
def test_a_jpeg_with_a_hole_is_damaged(tmp_path, options, hole):
    data = photograph(**options)
    assert not is_damaged(data)
    assert not is_damaged(data + b"a film that the phone hangs on")
    for start in range(3000, len(data) - 5000, len(data) // 8):
        holed = bytearray(data)
        if hole == "missing":
            del holed[start : start + 4096]
        else:
            holed[start : start + 4096] = bytes(4096) if hole == "zeros" else RNG.bytes(4096)
        assert is_damaged(bytes(holed)), f"hole at {start} of {len(data)}"


@pytest.mark.parametrize("mode", ["L", "RGB", "CMYK"])
@pytest.mark.parametrize("subsampling", [0, 1, 2])
@pytest.mark.parametrize("size", [(1, 1), (17, 9), (200, 120)])
def test_whole_jpegs_of_all_kinds_are_read(tmp_path, mode, subsampling, size):
    for progressive in (False, True):
        picture = Image.fromarray(cv2.resize(PICTURE, size)).convert(mode)
        picture.save(tmp_path / "a.jpg", subsampling=subsampling, progressive=progressive)
        assert read_stored(tmp_path / "a.jpg")[0].shape == (size[1], size[0], 3)


def test_a_flat_sky_is_no_hole(tmp_path):
    for progressive in (False, True):
        Image.new("RGB", (4000, 3000), "white").save(
            tmp_path / "a.jpg", optimize=True, progressive=progressive
        )
        assert (read_stored(tmp_path / "a.jpg")[0] == 255).all()


def test_a_png_with_a_hole_is_damaged(tmp_path):
    Image.fromarray(RNG.integers(0, 255, (100, 100, 3), np.uint8)).save(tmp_path / "a.png")
    data = bytearray((tmp_path / "a.png").read_bytes())
    assert not is_damaged(bytes(data))
    data[5000:5600] = bytes(600)
    assert is_damaged(bytes(data))


@pytest.mark.parametrize("content", [b"", b"\xff\xd8", b"II*\0", b"no picture", b"\x89PNG\r\n\x1a\n", b"BM"])
def test_a_file_without_a_picture_is_one_clear_error(tmp_path, content):
    (tmp_path / "a.jpg").write_bytes(content)
    for read in (read_stored, read_upright, read_mask, image_size):
        with pytest.raises(DatasetError, match=rf"got .*a\.jpg \({len(content)} bytes\): it is damaged"):
            read(tmp_path / "a.jpg")


def test_all_broken_images_of_a_set_are_named_at_once(tmp_path):
    frames = []
    for k in range(5):
        Image.fromarray(PICTURE).save(tmp_path / f"{k}.png")
        frames.append({"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist()})
    for k in (1, 3):
        (tmp_path / f"{k}.png").write_bytes((tmp_path / f"{k}.png").read_bytes()[:-20])
    import json

    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "frames": frames}))
    with pytest.raises(DatasetError, match=r"(?s)2 of 5 images cannot be used:.*1\.png.*3\.png"):
        load_transforms(tmp_path).load()
    frames[0]["transform_matrix"] = frames[4]["transform_matrix"] = None
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 50.0, "frames": frames}))
    with pytest.raises(DatasetError, match=r"(?s)2 of 5 frames cannot be used:.*0\.png.*4\.png"):
        load_transforms(tmp_path)
