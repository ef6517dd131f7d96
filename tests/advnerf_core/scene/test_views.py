import json

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_bytes import is_damaged
from advnerf_core.data.image_files import image_size, read_stored, write_image
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import PosedImages
from advnerf_core.objects.voxel.pictures import load_pictures

EYE = np.eye(4).tolist()


def write(folder, count=1, **frame):
    frames = [{"file_path": f"{k}.png", "transform_matrix": EYE, **frame} for k in range(count)]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    return folder


def save(path, pixels):
    assert cv2.imwrite(str(path), np.asarray(pixels))


def test_transparency_is_kept_and_averaged_by_opacity(tmp_path):
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[:, ::2] = (
        0,
        0,
        200,
        255,
    )  # opaque red columns between transparent green ones (file order blue, green, red)
    rgba[:, 1::2] = (0, 250, 0, 0)
    save(tmp_path / "0.png", rgba)
    loaded = load_transforms(write(tmp_path)).load(size=(2, 4))
    assert loaded.alpha[0].tolist() == [[128, 128]] * 4
    assert np.abs(loaded.rgb[0].astype(int) - [200, 0, 0]).max() <= 1, "what is transparent does not bleed in"
    white = loaded.on_background([1.0, 1.0, 1.0])
    assert np.abs(white[0].astype(int) - [227, 127, 127]).max() <= 2


def test_masks_become_valid_pixels_and_partly_masked_ones_do_not_count(tmp_path):
    save(tmp_path / "0.png", np.full((8, 8, 3), 50, np.uint8))
    save(tmp_path / "1.png", np.full((8, 8, 3), 50, np.uint8))
    mask = np.full((8, 8), 255, np.uint8)
    mask[:, :3] = 0
    save(tmp_path / "mask.png", mask)
    folder = write(tmp_path, count=2)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["mask_path"] = "mask.png"
    (folder / "transforms.json").write_text(json.dumps(content))
    listed = load_transforms(folder)
    np.testing.assert_array_equal(listed.load().valid[0], mask > 0)
    small = listed.load(size=(4, 4))
    assert small.valid[0].tolist() == [[False, False, True, True]] * 4
    assert small.valid[1].all(), "an image without a mask counts whole"


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        (np.zeros((8, 8), np.uint8), r"not black, got .*mask\.png, which hides all of .*0\.png"),
        (np.ones((4, 8), np.uint8), r"mask of 8 x 8, the size of .*0\.png, got .*mask\.png of 8 x 4"),
    ],
)
def test_useless_masks_are_named(tmp_path, mask, message):
    save(tmp_path / "0.png", np.full((8, 8, 3), 50, np.uint8))
    save(tmp_path / "mask.png", mask)
    with pytest.raises(DatasetError, match=message):
        load_transforms(write(tmp_path, mask_path="mask.png")).load()


def test_undistorted_views_say_which_pixels_the_lens_saw(tmp_path):
    save(tmp_path / "0.png", np.full((60, 80, 3), 50, np.uint8))
    listed = load_transforms(write(tmp_path, k1=-0.2, fl_x=45.0))
    assert listed.load().valid is None
    whole = listed.load(keep_all=True)
    assert 0.5 < whole.valid.mean() < 1.0
    assert not whole.valid[0, 0, 40], "barrel distortion leaves gaps in the middle of the sides"


def test_an_image_of_another_shape_than_listed_is_refused_but_a_smaller_copy_is_not(tmp_path):
    save(tmp_path / "0.png", np.zeros((30, 40, 3), np.uint8))
    assert load_transforms(write(tmp_path, w=80, h=60, fl_x=70.0)).load().pinholes[0].fx == pytest.approx(
        35.0
    )
    with pytest.raises(
        DatasetError, match=r"shape 60 x 80 .*0\.png of 40 x 30; the stored pixels were turned"
    ):
        load_transforms(write(tmp_path, w=60, h=80)).load()


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_file_that_was_cut_off_is_refused(tmp_path, suffix):
    path = tmp_path / f"0{suffix}"
    save(path, np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8))
    assert not is_damaged(path.read_bytes())
    assert image_size(path) == (60, 40)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DatasetError, match=r"expected a readable image, got .*damaged"):
        read_stored(path)


def test_the_end_of_a_thumbnail_is_not_the_end_of_the_photograph(tmp_path):
    path = tmp_path / "0.jpg"
    save(path, np.random.default_rng(0).integers(0, 255, (40, 60, 3), np.uint8))
    data, thumbnail = path.read_bytes(), b"Exif\0\0" + b"\xff\xd8 small picture \xff\xd9"
    with_thumbnail = data[:2] + b"\xff\xe1" + (len(thumbnail) + 2).to_bytes(2, "big") + thumbnail + data[2:]
    assert not is_damaged(with_thumbnail)
    assert is_damaged(with_thumbnail[:-200])
    assert not is_damaged(with_thumbnail + b"a film that the phone hangs on")


def test_grey_and_16_bit_images_are_read_as_colours(tmp_path):
    save(tmp_path / "grey.png", np.full((5, 6), 70, np.uint8))
    save(tmp_path / "deep.png", np.full((5, 6, 3), 257 * 70, np.uint16))
    for name in ("grey.png", "deep.png"):
        rgb, alpha = read_stored(tmp_path / name)
        assert (rgb == 70).all()
        assert (rgb.shape, alpha) == ((5, 6, 3), None)


def test_images_of_several_sizes_need_a_common_one(tmp_path):
    save(tmp_path / "0.png", np.zeros((30, 40, 3), np.uint8))
    save(tmp_path / "1.png", np.zeros((60, 80, 3), np.uint8))
    listed = load_transforms(write(tmp_path, count=2))
    with pytest.raises(DatasetError, match=r"one size in .*transforms\.json, got .*give --size WIDTH HEIGHT"):
        listed.load()
    assert listed.load(size=(20, 15)).rgb.shape == (2, 15, 20, 3)


@pytest.mark.parametrize("size", [(0, 0), (-5, 7), (100_000, 100_000), (30_000, 30_000)])
@pytest.mark.parametrize("load", [PosedImages.load, load_pictures])
def test_impossible_sizes_to_load_are_refused(tmp_path, load, size):
    save(tmp_path / "0.png", np.zeros((30, 40, 3), np.uint8))
    with pytest.raises(DatasetError, match=rf"px a side .* got {size[0]} x {size[1]}; correct the size"):
        load(load_transforms(write(tmp_path, count=1)), size)


def test_a_picture_needs_the_name_of_one(tmp_path):
    for name in ("sheet.txt", "sheet"):
        with pytest.raises(DatasetError, match=r"expected the name of a picture to write \(\.png"):
            write_image(tmp_path / name, np.zeros((3, 4, 3), np.uint8))
