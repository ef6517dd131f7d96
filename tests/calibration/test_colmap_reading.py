"""Models that pycolmap wrote, read and held against what pycolmap says of them."""

import numpy as np
import pytest

from advnerf_core.geometry import look_at
from calibration.colmap_lens import lens_of
from calibration.colmap_reading import read_colmap
from calibration.photo_model import ReconstructionError
from tests.support.colmap_models import (
    CAMERAS,
    HEIGHT,
    OTHER_CAMERAS,
    WIDTH,
    camera,
    posed,
    poses_by_name,
    synthetic,
    write,
)

pytest.importorskip("pycolmap")


@pytest.mark.parametrize("rigs", [True, False])
@pytest.mark.parametrize("text", [True, False])
def test_poses_are_those_of_pycolmap(tmp_path, text, rigs):
    model = synthetic(per_rig=2 if rigs else 1)
    found = read_colmap(write(model, tmp_path, text, rigs)).model
    truth = poses_by_name(model)
    assert [each.name for each in found.images] == sorted(truth)
    for image in found.images:
        np.testing.assert_allclose(image.T_world_from_camera, truth[image.name], rtol=0, atol=1e-9)
    assert len(found.points) == model.num_points3D()


@pytest.mark.parametrize("name", CAMERAS)
def test_a_lens_projects_as_the_camera_of_pycolmap(name):
    directions = np.c_[np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2)), np.ones(50)]
    pinhole, lens = lens_of(camera(name))
    truth = [camera(name).img_from_cam(each) for each in directions]
    np.testing.assert_allclose(
        lens.distort(directions, pinhole), np.reshape(truth, (-1, 2)), rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("name", OTHER_CAMERAS)
def test_images_of_other_cameras_are_to_be_undistorted(tmp_path, name):
    import pycolmap

    params = OTHER_CAMERAS[name]
    found = read_colmap(write(synthetic(name=name, params=params), tmp_path))
    straight = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera(name, params))
    for image in found.model.images:
        assert image.lens.is_ideal
        assert image.pinhole.fx == pytest.approx(straight.focal_length_x, abs=1e-9)
        assert image.pinhole.width == straight.width
    assert set(found.undistorted) == {each.name for each in found.model.images}
    assert found.model.cameras[0].model == name


def test_a_panorama_has_no_lens(tmp_path):
    poses = [look_at([k, 0.0, 1.0], [k, 5.0, 1.0]) for k in range(4)]
    model = posed(poses, "abcd")
    model.cameras[1].model = "EQUIRECTANGULAR"
    model.cameras[1].params = [WIDTH, HEIGHT]
    with pytest.raises(ReconstructionError, match=r"camera 1 \(EQUIRECTANGULAR\).*render perspective images"):
        read_colmap(write(model, tmp_path))


def test_normalised_intrinsics_are_refused(tmp_path):
    model = posed([look_at([k, 0.0, 1.0], [k, 5.0, 1.0]) for k in range(4)], "abcd")
    model.cameras[1].model = "PINHOLE"
    model.cameras[1].params = [0.7, 0.9, 0.5, 0.5]
    with pytest.raises(ReconstructionError, match=r"camera 1 \(PINHOLE\): .*if they are normalised"):
        read_colmap(write(model, tmp_path))


def test_the_largest_of_several_models_is_read_unless_one_is_named(tmp_path):
    for number, frames in enumerate((4, 7, 5)):
        write(synthetic(frames, seed=number), tmp_path / "sparse" / str(number), text=number == 1)
    found = read_colmap(tmp_path)
    assert found.folder == tmp_path / "sparse" / "1"
    assert found.sizes == {"0": 4, "1": 7, "2": 5}
    assert found.model.parts == 3
    assert len(read_colmap(tmp_path / "sparse", "2").model.images) == 5
    with pytest.raises(ReconstructionError, match="expected --model to be one of 0, 1, 2, got 3"):
        read_colmap(tmp_path, "3")


def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def huge_count(data: bytes) -> bytes:
    return b"\xff" * 8 + data[8:]


@pytest.mark.parametrize("damage", [half, huge_count, lambda data: b"", lambda data: data + b"more"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_damaged_binary_files_are_one_line_that_names_the_file(tmp_path, name, damage):
    file = write(synthetic(), tmp_path) / f"{name}.bin"
    file.write_bytes(damage(file.read_bytes()))
    with pytest.raises(
        ReconstructionError, match=rf"expected a complete .*{name}\.bin.*export the model again"
    ) as error:
        read_colmap(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_damaged_text_files_are_one_line(tmp_path, name):
    file = write(synthetic(), tmp_path, text=True) / f"{name}.txt"
    file.write_text("what is this\n1 2 3\n")
    with pytest.raises(ReconstructionError, match="expected a COLMAP model that pycolmap can read") as error:
        read_colmap(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("text", "file"), [(True, "images.txt"), (False, "images.bin")])
def test_a_name_of_another_encoding_is_one_line(tmp_path, text, file):
    path = write(synthetic(), tmp_path, text) / file
    path.write_bytes(path.read_bytes().replace(b"camera000001_frame", b"cam\xe9ra000001_frame", 1))
    with pytest.raises(
        ReconstructionError, match=r"expected names of images in UTF-8 in .*, got b'cam\\xe9ra000001_frame"
    ):
        read_colmap(tmp_path)


@pytest.mark.parametrize(("text", "form"), [(False, "photo.png"), (True, "photo {}.png")])
def test_images_of_one_name_are_refused(tmp_path, text, form):
    """One file was taken for five images; of a name with spaces in a text file, pycolmap reads the first word."""
    model = synthetic()
    for number, image in model.images.items():
        image.name = form.format(number)
    with pytest.raises(
        ReconstructionError,
        match=r"^expected each image of .* once, got 5 of the name 'photo.*; names with sp",
    ):
        read_colmap(write(model, tmp_path, text))


def test_poses_that_are_not_numbers_are_refused(tmp_path):
    file = write(synthetic(), tmp_path, rigs=False) / "images.bin"
    data = bytearray(file.read_bytes())
    data[12:20] = np.float64(np.nan).tobytes()
    file.write_bytes(bytes(data))
    with pytest.raises(ReconstructionError, match="got a pose that is not finite"):
        read_colmap(tmp_path)


def test_a_folder_without_a_model_is_told_with_what_is_there(tmp_path):
    (tmp_path / "database.db").touch()
    with pytest.raises(ReconstructionError, match=r"expected cameras, images and points3D.*got database\.db"):
        read_colmap(tmp_path)


def test_too_few_images_are_refused(tmp_path):
    with pytest.raises(ReconstructionError, match="expected at least 3 images with a pose"):
        read_colmap(write(posed([np.eye(4)] * 2, "ab"), tmp_path))
