"""Posed images as they are taken: what is written, and what a capture that goes on takes again."""

import numpy as np
import pytest

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Pinhole, make_transform, rotation_z

PINHOLE = Pinhole(12, 8, 10.0, 11.0, 6.0, 4.0)
POSES = [make_transform(rotation_z(0.3 * i), [i, 0.0, 0.5]) for i in range(3)]


def picture(index):
    return np.full((8, 12, 3), 40 * index, np.uint8)


def test_are_read_back_as_they_were_taken(tmp_path):
    counts = []
    assert write_posed_images(tmp_path, POSES, PINHOLE, picture, "png", told=counts.append) == 3
    assert counts == [1, 2, 3]
    views = load_transforms(tmp_path, require_all=True).load()
    np.testing.assert_allclose(views.T_world_from_camera, POSES, atol=1e-12)
    np.testing.assert_array_equal(views.rgb, [picture(i) for i in range(3)])
    assert views.pinholes[0] == PINHOLE


def test_a_capture_that_was_stopped_takes_only_what_is_missing(tmp_path):
    def stopped(index):
        if index == 2:
            raise RuntimeError("the camera is gone")
        return picture(index)

    with pytest.raises(RuntimeError, match="gone"):
        write_posed_images(tmp_path, POSES, PINHOLE, stopped, "png", keep=True)
    assert not (tmp_path / "transforms.json").exists()
    asked = []
    assert (
        write_posed_images(
            tmp_path, POSES, PINHOLE, lambda i: asked.append(i) or picture(i), "png", keep=True
        )
        == 1
    )
    assert asked == [2]
    assert len(load_transforms(tmp_path, require_all=True).frames) == 3


def test_pictures_are_taken_again_unless_told_to_keep_them(tmp_path):
    write_posed_images(tmp_path, POSES, PINHOLE, picture, "png")
    assert write_posed_images(tmp_path, POSES, PINHOLE, lambda i: picture(i) + 7, "png") == 3
    assert load_transforms(tmp_path).load().rgb[0].max() == 7


def test_nothing_asked_for_nothing_written(tmp_path):
    assert write_posed_images(tmp_path / "none", [], PINHOLE, picture, "jpg") == 0
    assert not (tmp_path / "none").exists()
