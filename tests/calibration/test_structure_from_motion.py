"""Structure from motion on photographs whose poses and lens are known: a box's inner corner with painted walls."""

from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
from PIL import Image

from advnerf_core.data.image_files import image_size
from advnerf_core.data.lens import Lens
from advnerf_core.data.similarity import align_poses
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole, look_at
from benchmarks.painted_corner import WALL_M, WALLS, photograph, poses_of, some_camera, write_photographs
from calibration.photo_model import PhotoSource, ReconstructionError, SfmConfig
from calibration.structure_from_motion import reconstruct

PHONE = Pinhole(400, 300, 330.0, 330.0, 200.0, 150.0)
CAR = Pinhole(320, 200, 210.0, 210.0, 160.0, 100.0)
FEW_FEATURES = SfmConfig(max_features=1200)
PHONE_LENS, CAR_LENS = Lens((-0.12, 0.03, 0.0, 0.0, 0.0)), Lens()


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Folder of images, sources, true poses by name."""
    root, truth, names = tmp_path_factory.mktemp("sfm"), {}, {"phone": [], "car": []}
    plan = {
        "phone": (poses_of(8, 2.6, 1.5, 0.3, 1.27), PHONE, PHONE_LENS),
        "car": (poses_of(6, 2.3, 0.8, 0.4, 1.17), CAR, CAR_LENS),
    }
    for camera, (poses, pinhole, lens) in plan.items():
        for index, pose in enumerate(poses):
            name = f"{camera}_{index}.png"
            assert cv2.imwrite(str(root / name), photograph(pose, pinhole, lens)[..., ::-1])
            truth[name] = pose
            names[camera].append(name)
    sources = [
        PhotoSource("phone", tuple(names["phone"]), ordered=True),
        PhotoSource("car", tuple(names["car"]), True, CAR, CAR_LENS),
    ]
    return root, sources, truth


@pytest.mark.slow
def test_poses_and_lens_of_two_cameras_are_found(scene):
    root, sources, truth = scene
    model = reconstruct(root, sources, root / "work")
    assert model.left_out == ()
    assert [image.name for image in model.images] == list(truth)
    aligned = align_poses(model.poses, np.stack([truth[i.name] for i in model.images]), 0.1, 0.1, 1.0)
    assert aligned.position_error_m.max() < 0.01 * aligned.extent_m
    assert np.rad2deg(aligned.rotation_error_rad.max()) < 0.4
    phone, car = model.images[0], model.images[-1]
    assert phone.pinhole.fx == pytest.approx(PHONE.fx, rel=0.01)
    assert phone.lens.coefficients[0] == pytest.approx(-0.12, abs=0.03)
    assert car.pinhole == CAR, "known intrinsics are held"
    assert model.reprojection_error_px < 1.0
    points = aligned.similarity.points(model.points)
    off_wall = np.abs(points).min(axis=1)
    assert np.median(off_wall) < 0.01, "points lie on the walls"


@pytest.mark.slow
def test_a_stopped_run_goes_on_and_other_inputs_begin_anew(scene, tmp_path):
    root, sources, _ = scene

    class StoppedError(Exception):
        pass

    def stop(share, text):
        if "matched" in text:
            raise StoppedError

    work = tmp_path / "work"
    with pytest.raises(StoppedError):
        reconstruct(root, sources, work, FEW_FEATURES, stop)
    said = []
    first = reconstruct(root, sources, work, FEW_FEATURES, lambda share, text: said.append(text))
    assert not any(text.startswith("features") for text in said), "features were there already"
    said.clear()
    again = reconstruct(root, sources, work, FEW_FEATURES, lambda share, text: said.append(text))
    assert not any("placed" in text for text in said), "a finished model is read, not made again"
    np.testing.assert_array_equal(again.points, first.points)
    (work / "finished.json").unlink()
    again = reconstruct(root, sources, work, FEW_FEATURES)
    np.testing.assert_allclose(again.poses, first.poses, atol=1e-9)
    said.clear()
    reconstruct(root, sources, work, SfmConfig(max_features=700), lambda share, text: said.append(text))
    assert any(text.startswith("features") for text in said)


@pytest.mark.slow
def test_photographs_without_overlap_are_refused_with_what_to_do(tmp_path):
    rng = np.random.default_rng(0)
    for k in range(4):
        blocks = rng.integers(0, 255, (30, 40, 3), np.uint8)
        cv2.imwrite(
            str(tmp_path / f"{k}.png"), cv2.resize(blocks, (400, 300), interpolation=cv2.INTER_NEAREST)
        )
    with pytest.raises(
        ReconstructionError, match=r"but no two could be matched; take photographs with overlap"
    ):
        reconstruct(tmp_path, [PhotoSource("phone", tuple(f"{k}.png" for k in range(4)))], tmp_path / "work")


def true_focal_lengths(model, truth):
    return np.array([image.pinhole.fx / truth[image.name][1].fx - 1.0 for image in model.images])


@pytest.mark.slow
def test_ten_photographs_by_ten_cameras_have_ten_sane_lenses(tmp_path):
    rng, poses = np.random.default_rng(1), poses_of(10, 2.6, 1.4, 0.2, 1.37)
    truth = write_photographs(tmp_path, poses, [some_camera(rng, 460) for _ in poses])
    said = []
    model = reconstruct(
        tmp_path,
        [PhotoSource("photos", tuple(truth))],
        tmp_path / "work",
        report=lambda share, text: said.append((share, text)),
    )
    assert len(model.images) >= 8
    assert np.abs(true_focal_lengths(model, truth)).max() < 0.05
    assert {image.name for image in model.images} | {image.name for image in model.left_out} == set(truth)
    listed = {camera.camera_id: camera for camera in model.cameras}
    assert [image.camera_id for image in model.images] == list(listed), "each by its own name"
    assert set(listed) <= {f"photos/{index:02d}" for index in range(10)}
    assert {camera.model for camera in model.cameras} <= {"SIMPLE_PINHOLE", "SIMPLE_RADIAL"}, (
        "one image supports no more"
    )
    assert all("RADIAL needs 5 images" in camera.why for camera in model.cameras)
    assert all(0.0 < camera.focal_error_percent < 5.0 for camera in model.cameras)
    assert set(model.summary()["cameras"]) == set(listed)
    shares = [share for share, _ in said]
    assert shares == sorted(shares), "progress never goes back"
    pairs = {text for _, text in said if text.endswith("of 45 pairs of images matched")}
    # How many of the numbers in between are read depends on the machine's speed.
    assert len(pairs) >= 3, "progress moves while pairs are matched"


@pytest.mark.slow
def test_eleven_photographs_by_one_camera_give_its_focal_length(tmp_path):
    pinhole = Pinhole(480, 320, 450.0, 450.0, 240.0, 160.0)
    poses = poses_of(11, 2.6, 1.4, 0.2, 1.37)
    truth = write_photographs(tmp_path, poses, [(pinhole, Lens((-0.08, 0.02, 0.0, 0.0, 0.0)))] * 11)
    names = tuple(truth)
    # Two folders, but one camera: they share its lens.
    sources = [PhotoSource("camera", names[:6]), PhotoSource("camera", names[6:])]
    model = reconstruct(tmp_path, sources, tmp_path / "work", FEW_FEATURES)
    assert model.left_out == ()
    assert [(camera.camera_id, camera.images) for camera in model.cameras] == [("camera", 11)]
    assert np.abs(true_focal_lengths(model, truth)).max() < 0.01
    assert model.images[0].lens.coefficients[0] == pytest.approx(-0.08, abs=0.03)


def with_exif(folder, name, focal_length_35mm):
    """The photograph as a JPEG file whose EXIF data name a camera and its focal length."""
    image = Image.open(folder / name)
    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = "Maker", "Model"
    exif.get_ifd(0x8769)[0x920A], exif.get_ifd(0x8769)[0xA405] = 5.0, focal_length_35mm
    image.save((folder / name).with_suffix(".jpg"), quality=95, exif=exif)
    (folder / name).unlink()
    return str(Path(name).with_suffix(".jpg"))


@pytest.mark.slow
@pytest.mark.parametrize("knows_itself", [False, True])
def test_a_camera_whose_lens_cannot_be_told_is_left_out_by_name_or_held_at_its_exif_focal_length(
    tmp_path, knows_itself
):
    """Seen square on, a wall says nothing about the focal length: a longer one from farther off gives the same picture."""
    common = Pinhole(400, 300, 380.0, 380.0, 200.0, 150.0)
    square_on = Pinhole(360, 360, 500.0, 500.0, 180.0, 180.0)
    poses = [*poses_of(5, 2.6, 1.4, 0.4, 1.17), look_at([2.6, 1.1, 1.2], [0.0, 1.1, 1.2])]
    truth = write_photographs(tmp_path, poses, [(common, Lens())] * 5 + [(square_on, Lens())])
    names, last = list(truth), "05.png"
    if knows_itself:
        names[-1] = last = with_exif(
            tmp_path, last, round(43.27 * 500.0 / np.hypot(360.0, 360.0))
        )  # by the diagonal of the film
    model = reconstruct(tmp_path, [PhotoSource("photos", tuple(names))], tmp_path / "work", FEW_FEATURES)
    cameras = {camera.camera_id: camera for camera in model.cameras}
    assert cameras["photos/400x300"].pinhole.fx == pytest.approx(380.0, rel=0.01)
    if knows_itself:
        assert model.left_out == ()
        assert "EXIF focal length, held" in cameras["photos/05"].why
        assert cameras["photos/05"].pinhole.fx == pytest.approx(500.0, rel=0.05)
    else:
        assert [image.name for image in model.left_out] == [last]
        assert "focal length is only known within" in model.left_out[0].why
    # What was finished says the same again.
    again = reconstruct(tmp_path, [PhotoSource("photos", tuple(names))], tmp_path / "work", FEW_FEATURES)
    assert (again.left_out, again.cameras) == (model.left_out, model.cameras)


def test_a_process_of_colmap_that_is_killed_is_one_error(tmp_path):
    poses = poses_of(3, 2.6, 1.4, 0.2, 0.4)
    truth = write_photographs(tmp_path, poses, [(PHONE, Lens())] * 3)

    def kill(share, text):
        for child in psutil.Process().children():
            child.kill()

    with pytest.raises(ReconstructionError, match=r"was ended by SIGKILL .* run the command again to resume"):
        reconstruct(tmp_path, [PhotoSource("photos", tuple(truth))], tmp_path / "work", report=kill)


def test_an_error_of_the_system_in_that_process_is_one_of_ours(tmp_path):
    with pytest.raises(AdvnerfError, match="No such file or directory") as caught:
        reconstruct(tmp_path, [PhotoSource("phone", ("a.png", "b.png", "c.png"))], tmp_path / "work")
    assert not isinstance(caught.value, ReconstructionError)


def test_what_cannot_begin_is_refused_at_once(tmp_path):
    with pytest.raises(ReconstructionError, match="at least 3 different images, got 2"):
        reconstruct(tmp_path, [PhotoSource("phone", ("a.png", "b.png"))], tmp_path / "work")
    with pytest.raises(ReconstructionError, match="got a fisheye"):
        PhotoSource("phone", ("a.png",), lens=Lens((0.1, 0.0, 0.0, 0.0), fisheye=True))
    with pytest.raises(ReconstructionError, match="images of camera 'phone', got none"):
        PhotoSource("phone", ())


def test_the_painted_corner_is_seen_where_it_is(tmp_path):
    """The test's own renderer against the pinhole: the corner of the box is at the pixel that projection says."""
    pose = look_at([2.0, 1.8, 1.2], [0.0, 0.0, 0.0])
    image = photograph(pose, PHONE, Lens())
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert image_size(tmp_path / "a.png") == (400, 300)
    T = np.linalg.inv(pose)
    point = np.array([1.0, 0.0, 0.7])
    u, v = PHONE.project(T[:3, :3] @ point + T[:3, 3])
    painted = WALLS[1][round(900 / WALL_M * 0.7), round(900 / WALL_M * 1.0)]
    seen = image[int(v) - 1 : int(v) + 2, int(u) - 1 : int(u) + 2].reshape(-1, 3).astype(float)
    assert np.abs(seen - painted).sum(axis=1).min() < 60.0
