"""``scene from-scan`` of COLMAP: data sets from models that pycolmap wrote."""

import json
import re
import subprocess
import sys

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import read_stored
from advnerf_core.data.similarity import align_poses
from advnerf_core.data.transforms import load_transforms
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole, look_at, make_transform, rotation_x, rotation_z
from benchmarks.painted_corner import poses_of, write_photographs
from calibration.scans.scan import ScanError, ScanOptions
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import photographs_in
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.scan import from_scan
from tests.support.colmap_models import (
    HEIGHT,
    OTHER_CAMERAS,
    WIDTH,
    posed,
    poses_by_name,
    synthetic,
    write,
    write_images,
)

pycolmap = pytest.importorskip("pycolmap")

NAMES = [f"front/{number}.png" for number in range(4)] + [f"rear/{number}.png" for number in range(4)]
RING = [look_at([3 * np.cos(a), 3 * np.sin(a), 1.5], [0.0, 0.0, 1.0]) for a in np.linspace(0.0, 6.0, 8)]
# COLMAP's world: not upright, another unit.
TILTED = make_transform(rotation_x(0.9) @ rotation_z(0.4), [5.0, -3.0, 2.0])
UNIT = 0.2


def in_colmap(T):
    """A pose or point of the true world in COLMAP's."""
    moved = TILTED @ T
    moved[:3, -1] *= UNIT
    return moved


def floor(count=400):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-4.0, 4.0, (2, count))
    things = np.c_[rng.uniform(-4.0, 4.0, (count, 2)), rng.uniform(0.3, 3.0, count)]
    points = np.r_[np.c_[x, y, 0.002 * rng.normal(size=count)], things]
    return [in_colmap(np.append(point, 1.0)[:, None])[:3, 0] for point in points]


def run(tmp_path, folder, images, model=None, **known):
    def report(share, text=""):
        assert 0.0 <= share <= 1.0

    return from_scan(folder, tmp_path / "out", ScanOptions(images, model), MetricOptions(**known), report)


@pytest.fixture
def ring(tmp_path):
    """Folders of a model in COLMAP's world, with a floor, and of its images."""
    model = posed([in_colmap(T) for T in RING], NAMES, floor())
    return write(model, tmp_path / "model"), write_images(tmp_path / "pictures", NAMES)


def loaded(tmp_path):
    """Poses by the image's name in COLMAP, and the report."""
    frames = load_transforms(tmp_path / "out", require_all=True).frames
    names = [each.path.relative_to(tmp_path / "out" / "images").as_posix() for each in frames]
    return dict(zip(names, frames, strict=True)), json.loads((tmp_path / "out" / "import.json").read_text())


def test_poses_and_lens_come_back_to_1e_6(tmp_path):
    model = synthetic(per_rig=2, name="OPENCV")
    truth = poses_by_name(model)
    folder, images = write(model, tmp_path / "0", text=True), write_images(tmp_path / "pictures", truth)
    run(tmp_path, folder, images)
    frames, report = loaded(tmp_path)
    T, scale = np.array(report["T_world_from_scan"]), report["metres_per_unit"]
    for name, expected in truth.items():
        got = np.linalg.inv(T) @ frames[name].T_world_from_camera
        back = np.linalg.inv(T)[:3, :3] @ (frames[name].T_world_from_camera[:3, 3] - T[:3, 3]) / scale
        np.testing.assert_allclose(got[:3, :3], expected[:3, :3], atol=1e-6)
        np.testing.assert_allclose(back, expected[:3, 3], atol=1e-6)
        camera = model.image(next(i for i in model.images if model.image(i).name == name)).camera
        for direction in ([0.1, 0.2, 1.0], [-0.3, 0.2, 1.0]):
            pixel = frames[name].lens.distort(np.array([direction]), frames[name].pinhole)
            np.testing.assert_allclose(pixel[0], np.ravel(camera.img_from_cam(direction)), atol=1e-6)


def test_images_in_folders_are_copied_as_they_are(tmp_path, ring):
    _, images = ring
    run(tmp_path, *ring)
    for name in NAMES:
        assert (tmp_path / "out" / "images" / name).read_bytes() == (images / name).read_bytes()


def test_the_ground_is_z_0_and_nothing_is_said_in_metres_without_a_scale(tmp_path, ring):
    run(tmp_path, *ring)
    frames, report = loaded(tmp_path)
    heights = [each.T_world_from_camera[2, 3] for each in frames.values()]
    np.testing.assert_allclose(heights, 1.5 * UNIT, rtol=0.01)
    assert report["ground_at_zero"]
    assert report["scale_from"] is None
    assert report["scale"].startswith("unknown: lengths are in COLMAP's unit")


def assert_true_sizes(frames, tolerance=0.003):
    poses = np.stack([frames[name].T_world_from_camera for name in NAMES])
    aligned = align_poses(poses, np.stack(RING), np.inf, np.inf)
    assert aligned.similarity.scale == pytest.approx(1.0, abs=tolerance)
    np.testing.assert_allclose(poses[:, 2, 3], poses[0, 2, 3], atol=0.02)


def test_a_length_between_two_cameras_gives_metres(tmp_path, ring):
    length = float(np.linalg.norm(RING[0][:3, 3] - RING[5][:3, 3]))
    run(tmp_path, *ring, length=("front/0.png", "rear/1.png", length))
    frames, report = loaded(tmp_path)
    assert_true_sizes(frames, 1e-9)
    assert report["scale_from"] == "length"


def test_a_length_between_two_points_gives_metres(tmp_path, ring):
    points = pycolmap.Reconstruction(ring[0]).points3D
    length = float(np.linalg.norm(points[3].xyz - points[9].xyz)) / UNIT
    run(tmp_path, *ring, length=("3", "9", length))
    assert_true_sizes(loaded(tmp_path)[0], 1e-9)


def write_positions(file, poses, names=NAMES):
    rows = [f"{name},{','.join(map(str, T[:3, 3]))}" for name, T in zip(names, poses, strict=True)]
    file.write_text("\n".join(["image,x_m,y_m,z_m", *rows]) + "\n")
    return file


def test_known_positions_give_metres_and_the_world(tmp_path, ring):
    run(tmp_path, *ring, positions=write_positions(tmp_path / "gps.csv", RING))
    frames, report = loaded(tmp_path)
    for name, T in zip(NAMES, RING, strict=True):
        np.testing.assert_allclose(frames[name].T_world_from_camera, T, atol=1e-3)
    assert report["up"] == "that of the known positions"
    assert not report["ground_at_zero"]


@pytest.mark.parametrize("beside", [False, True])
def test_known_positions_may_leave_out_the_folders_of_images_as_a_length_may(tmp_path, beside):
    """A whole name is that image's, though another one ends with it."""
    ends = [f"{number}.png" for number in range(8)]
    names = [*ends[:4], *(f"walk/{end}" for end in ends[:4])] if beside else [f"walk/{end}" for end in ends]
    scan = write(posed([in_colmap(T) for T in RING], names, floor()), tmp_path / "model")
    known = write_positions(tmp_path / "gps.csv", RING, names if beside else ends)
    run(tmp_path, scan, write_images(tmp_path / "pictures", names), positions=known)
    frames, report = loaded(tmp_path)
    assert "known positions of 8 images" in str(report)
    for name, T in zip(names, RING, strict=True):
        np.testing.assert_allclose(frames[name].T_world_from_camera, T, atol=1e-3)


def test_two_rows_for_one_image_are_refused_with_both_names(tmp_path):
    names = [f"walk/{number}.png" for number in range(8)]
    scan = write(posed([in_colmap(T) for T in RING], names, floor()), tmp_path / "model")
    known = write_positions(tmp_path / "gps.csv", [*RING, RING[3]], [*names, "3.png"])
    with pytest.raises(AdvnerfError, match=r"one position for each image, got .*walk/3\.png and 3\.png"):
        run(tmp_path, scan, write_images(tmp_path / "pictures", names), positions=known)


def test_positions_that_name_no_single_image_are_named(tmp_path, ring):
    names = [*NAMES[:6], "2.png", "typo.png"]
    run(tmp_path, *ring, positions=write_positions(tmp_path / "gps.csv", RING, names))
    _, report = loaded(tmp_path)
    assert "known positions of 6 images (8 in the file; not used: 2.png, which is" in report["scale"]
    assert "front/2.png and rear/2.png; typo.png, which is no image with a pose)" in report["scale"]
    ends = write_positions(tmp_path / "ends.csv", RING[:4], [f"{number}.png" for number in range(4)])
    with pytest.raises(
        AdvnerfError, match=r"got 0 \(not used: 0\.png, which is front/0\.png and rear/0\.png; "
    ):
        run(tmp_path, *ring, positions=ends)


@pytest.mark.parametrize("with_floor", [True, False])
def test_positions_on_a_straight_drive_take_up_from_the_ground_or_the_cameras(tmp_path, with_floor):
    drive = [look_at([0.5 * k, 0.2, 1.2], [0.5 * k + 3.0, 0.2, 1.2]) for k in range(8)]
    model = posed([in_colmap(T) for T in drive], NAMES, floor() if with_floor else ())
    images = write_images(tmp_path / "pictures", NAMES)
    known = write_positions(tmp_path / "gps.csv", drive)
    run(tmp_path, write(model, tmp_path / "model"), images, positions=known)
    frames, report = loaded(tmp_path)
    for name, T in zip(NAMES, drive, strict=True):
        np.testing.assert_allclose(frames[name].T_world_from_camera, T, atol=0.005)
    assert report["up"].startswith("normal of the ground" if with_floor else "the cameras' up")


def test_positions_of_something_else_are_refused(tmp_path, ring):
    wrong = write_positions(tmp_path / "gps.csv", RING[::-1][:4] + RING[:4])
    with pytest.raises(AdvnerfError, match="expected positions that fit the model"):
        run(tmp_path, *ring, positions=wrong)


SWAPPED = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def test_positions_in_a_left_handed_frame_are_refused(tmp_path, ring):
    """On a level drive the mirrored positions fit exactly, by a world that is upside down."""
    wrong = write_positions(tmp_path / "gps.csv", [SWAPPED @ T for T in RING])
    with pytest.raises(AdvnerfError, match=r"stand on their heads: are x and y exchanged"):
        run(tmp_path, *ring, positions=wrong)


def test_a_wrong_row_among_known_positions_is_named(tmp_path, ring):
    rows = [T.copy() for T in RING]
    rows[2][0, 3] += 0.6  # below the share of their extent at which positions do not fit the model at all
    wrong = write_positions(tmp_path / "gps.csv", rows)
    with pytest.raises(AdvnerfError, match=rf"got one of {NAMES[2]} that is 0\.6 m away .* correct its row"):
        run(tmp_path, *ring, positions=wrong)


@pytest.mark.parametrize(("first", "said"), [(1, "before"), (0, "after")])
def test_positions_of_the_row_beside_are_refused(tmp_path, first, said):
    """On a track with nearly even steps they fit to decimetres, and the scale and the world are wrong by as much."""
    angles = 0.25 * np.arange(10) + 0.05 * np.sin(np.arange(10))
    places = [[8 * np.sin(a) + 0.02 * k * k, 8 - 8 * np.cos(a), 1.2] for k, a in enumerate(angles)]
    track = [look_at(place, [place[0] + 3.0, place[1], 1.0]) for place in places]
    images = write_images(tmp_path / "pictures", NAMES)
    scan = write(posed([in_colmap(T) for T in track[1:9]], NAMES, floor()), tmp_path / "model")
    run(tmp_path, scan, images, positions=write_positions(tmp_path / "gps.csv", track[1:9]))
    (tmp_path / "out").rename(tmp_path / "right")
    off = write_positions(tmp_path / "off.csv", track[2 * first : 2 * first + 8])
    with pytest.raises(AdvnerfError, match=f"takes that of the row {said} it; correct the names"):
        run(tmp_path, scan, images, positions=off)


@pytest.mark.parametrize("seed", range(20))
def test_positions_with_the_errors_of_satellites_are_no_wrong_rows(tmp_path, ring, seed):
    noise = 0.05 * np.random.default_rng(seed).normal(size=(len(RING), 3))
    noisy = [T.copy() for T in RING]
    for T, error in zip(noisy, noise, strict=True):
        T[:3, 3] += error
    run(tmp_path, *ring, positions=write_positions(tmp_path / "gps.csv", noisy))


def test_positions_with_the_origin_of_a_map_are_refused(tmp_path, ring):
    """The data set would take over a world that no command reads."""
    far = [T + np.array([[0, 0, 0, 5e5], [0, 0, 0, 5.4e6], [0, 0, 0, 0], [0, 0, 0, 0]]) for T in RING]
    wrong = write_positions(tmp_path / "utm.csv", far)
    with pytest.raises(
        AdvnerfError, match=r"utm\.csv: .*of the origin, got 5\.4e\+06; take a common offset off"
    ):
        run(tmp_path, *ring, positions=wrong)


def test_what_is_not_there_is_named_and_the_rest_is_used(tmp_path, ring):
    model, images = ring
    (images / "front" / "1.png").unlink()
    (images / "rear" / "2.png").write_bytes(b"no image")
    write_images(images, ["other.png"])
    run(tmp_path, model, images)
    frames, report = loaded(tmp_path)
    assert set(frames) == {*NAMES} - {"front/1.png", "rear/2.png"}
    left_out = {each["name"]: each["why"] for each in report["model"]["left_out"]}
    assert set(left_out) == {"front/1.png", "rear/2.png", "other.png"}
    assert left_out["other.png"] == "it has no pose in the scan"


def test_a_data_set_inside_the_folder_of_images_is_not_one_of_them(tmp_path):
    model = write(posed(RING, NAMES), tmp_path / "model")
    write_images(tmp_path, NAMES)
    for _ in range(2):
        run(tmp_path, model, tmp_path)
        assert loaded(tmp_path)[1]["model"]["left_out"] == []


def test_reduced_images_keep_their_rays(tmp_path, ring):
    run(tmp_path, ring[0], write_images(tmp_path / "half", NAMES, (WIDTH // 2, HEIGHT // 2)))
    pinhole = next(iter(loaded(tmp_path)[0].values())).pinhole
    assert (pinhole.width, pinhole.fx, pinhole.cx) == (WIDTH // 2, 25.0, 16.25)


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (
            lambda path: write_images(path / "cut", NAMES, (WIDTH, HEIGHT - 8)),
            "expected 64 x 48 pixels as camera 1",
        ),
        (lambda path: write_images(path / "other", ["a.png"]), "none is there; the first is front/0.png"),
        (lambda path: write_images(path / "pictures" / "deep", NAMES).parent, "give .*deep"),
    ],
)
def test_other_images_are_refused_with_one_line(tmp_path, images, message):
    model = write(posed(RING, NAMES), tmp_path / "model")
    with pytest.raises((ImportRecordingError, ScanError), match=message) as error:
        run(tmp_path, model, images(tmp_path))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out.part").exists()


def test_images_may_be_links(tmp_path, ring):
    links = tmp_path / "links"
    links.mkdir()
    for folder in ("front", "rear"):
        (links / folder).symlink_to(ring[1] / folder)
    run(tmp_path, ring[0], links)
    assert set(loaded(tmp_path)[0]) == set(NAMES)


@pytest.mark.parametrize(
    "name", ["../secret.png", "front/../../secret.png", "..\\secret.png", "/etc/secret.png"]
)
def test_a_model_does_not_reach_out_of_the_folder(tmp_path, name):
    names = [name, *NAMES[1:]]
    model = write(posed(RING, names), tmp_path / "model")
    images = write_images(tmp_path / "pictures", NAMES)
    write_images(tmp_path, ["secret.png"])
    with pytest.raises(ScanError, match=r"expected names of images inside .*secret"):
        run(tmp_path, model, images)


@pytest.mark.parametrize("name", ["FOV", "FULL_OPENCV"])
def test_images_of_lenses_without_a_model_are_undistorted_by_colmap(tmp_path, name):
    model = synthetic(name=name, params=OTHER_CAMERAS[name])
    images = write_images(tmp_path / "pictures", poses_by_name(model))
    run(tmp_path, write(model, tmp_path / "model"), images)
    for written, frame in loaded(tmp_path)[0].items():
        bitmap = pycolmap.Bitmap.read(images / written.removesuffix(".png"), True)
        straight, camera = pycolmap.undistort_image(
            pycolmap.UndistortCameraOptions(), bitmap, model.cameras[1]
        )
        np.testing.assert_array_equal(read_stored(frame.path)[0], straight.to_array())
        assert frame.lens.is_ideal
        assert (frame.pinhole.width, frame.pinhole.height) == (camera.width, camera.height)
        assert frame.pinhole.fx == pytest.approx(camera.focal_length_x, abs=1e-6)


@pytest.mark.parametrize("name", ["FOV", "FULL_OPENCV"])
def test_reduced_images_of_such_lenses_keep_their_rays(tmp_path, name):
    def colours(x, y):
        return np.rint(
            np.stack([128 + 90 * np.sin(4 * x), 128 + 90 * np.sin(4 * y), 128 + 90 * np.cos(3 * x + y)], -1)
        )

    model = synthetic(name=name, params=OTHER_CAMERAS[name])
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.array([model.cameras[1].cam_from_img(each) for each in np.c_[u.ravel(), v.ravel()]])
    whole = colours(*rays[:, :2].T).reshape(HEIGHT, WIDTH, 3).astype(np.uint8)
    half = cv2.resize(whole, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
    for image in (names := sorted(poses_by_name(model))):
        (tmp_path / "half" / image).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(tmp_path / "half" / image), half[..., ::-1])
    run(tmp_path, write(model, tmp_path / "model"), tmp_path / "half")
    frames = loaded(tmp_path)[0]
    assert len(frames) == len(names)
    for frame in frames.values():
        seen = read_stored(frame.path)[0]
        assert frame.lens.is_ideal
        assert seen.shape == (frame.pinhole.height, frame.pinhole.width, 3)
        directions = frame.pinhole.directions()
        away = np.abs(seen - colours(directions[..., 0], directions[..., 1]))[2:-2, 2:-2]
        assert away.mean() < 1.0, "half a pixel is 2.5"


def test_one_image_of_another_size_leaves_the_others(tmp_path, ring):
    write_images(ring[1], NAMES[2:3], (WIDTH, HEIGHT - 8))
    run(tmp_path, *ring)
    frames, report = loaded(tmp_path)
    assert set(frames) == {*NAMES} - {NAMES[2]}
    (left_out,) = report["model"]["left_out"]
    assert left_out["why"].startswith(
        f"{NAMES[2]}: expected 64 x 48 pixels as camera 1 of the scan has, got 64 x 40"
    )


def test_folders_of_a_person_are_never_replaced(tmp_path, ring):
    (tmp_path / "out" / "colmap" / "sparse").mkdir(parents=True)
    with pytest.raises(ImportRecordingError, match="out has other files: colmap; give another --output"):
        run(tmp_path, *ring)


@pytest.mark.parametrize("read", [load_transforms, photographs_in])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "."])
def test_commands_for_posed_images_name_this_one(tmp_path, read, place):
    write(synthetic(), tmp_path / place)
    (tmp_path / "images").mkdir()
    with pytest.raises((DatasetError, ImportRecordingError)) as error:
        read(tmp_path)
    told = re.search(r"advnerf scene from-scan (\S+) -o NEW_FOLDER", str(error.value))
    assert told[1] == str(tmp_path)


def markers_on_the_floor(T, pinhole, side_m=0.5):
    """A floor with two printed markers of one size, seen by a camera."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    picture = np.full((600, 600), 200, np.uint8)  # 100 pixels per metre, y down
    for number, corner in ((3, (150, 200)), (7, (350, 300))):
        marker = cv2.aruco.generateImageMarker(dictionary, number, round(100 * side_m))
        picture[corner[1] : corner[1] + len(marker), corner[0] : corner[0] + len(marker)] = marker
    floor_from_pixel = np.array([[0.01, 0.0, -3.0 + 0.005], [0.0, -0.01, 3.0 - 0.005], [0.0, 0.0, 1.0]])
    half = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5], [0.0, 0.0, 1.0]])
    H = half @ pinhole.matrix @ np.linalg.inv(T)[:3][:, [0, 1, 3]] @ floor_from_pixel
    return cv2.warpPerspective(
        picture, H, (pinhole.width, pinhole.height), flags=cv2.INTER_AREA, borderValue=90
    )


def test_printed_markers_give_metres(tmp_path):
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240], camera_id=1)
    model = posed([in_colmap(T) for T in RING], NAMES)
    model.cameras[1].width, model.cameras[1].height = 640, 480
    model.cameras[1].params = camera.params
    pinhole = Pinhole(640, 480, 500.0, 500.0, 320.0, 240.0)
    images = write_images(tmp_path / "pictures", NAMES)
    for name, T in zip(NAMES, RING, strict=True):
        assert cv2.imwrite(str(images / name), markers_on_the_floor(T, pinhole))
    run(tmp_path, write(model, tmp_path / "model"), images, marker_m=0.5, dictionary="DICT_4X4_50")
    frames, report = loaded(tmp_path)
    assert_true_sizes(frames, 0.01)
    assert report["scale_from"] == "fiducials"
    assert report["scale"].startswith("metric: 2 markers of 0.5 m")


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"length": ("a.png", "rear/1.png", 1.0)}, "expected --length to name one image"),
        ({"length": ("front/0.png", "front/0.png", 1.0)}, "between two different places"),
        ({"marker_m": 0.1}, "expected a marker of DICT_APRILTAG_36h11 in two images"),
        ({"marker_m": 0.1, "dictionary": "4x4"}, "expected a marker dictionary such as"),
        ({"marker_m": 0.1, "length": ("1", "2", 1.0)}, "got --length and --marker; give one"),
        ({"model": "5"}, "expected --model to be one of model, got 5"),
    ],
)
def test_wrong_options_are_one_line(tmp_path, ring, config, message):
    with pytest.raises(AdvnerfError, match=message) as error:
        run(tmp_path, *ring, **config)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_the_lens_of_a_model_is_its_own(tmp_path, ring):
    with pytest.raises(
        ScanError, match=r"expected --images and --model for a scan of COLMAP, .* got --calibration"
    ):
        from_scan(
            ring[0],
            tmp_path / "out",
            ScanOptions(ring[1], calibration=tmp_path),
            MetricOptions(),
            lambda *_: None,
        )


@pytest.mark.slow
def test_photographs_that_colmap_posed_become_a_metric_scene(tmp_path):
    photographs, sparse = tmp_path / "photographs", tmp_path / "sparse"
    pinhole = Pinhole(400, 300, 330.0, 330.0, 200.0, 150.0)
    from advnerf_core.data.lens import Lens

    camera = (pinhole, Lens((-0.12, 0.03, 0.0, 0.0, 0.0)))
    truth = write_photographs(photographs, poses_of(12, 2.6, 1.5, 0.3, 1.27), [camera] * 12)
    database = tmp_path / "database.db"
    pycolmap.extract_features(database, photographs, camera_mode=pycolmap.CameraMode.SINGLE)
    pycolmap.match_exhaustive(database)
    sparse.mkdir()
    pycolmap.incremental_mapping(database, photographs, sparse)
    first, last = (truth[name][0][:3, 3] for name in ("00.png", "11.png"))
    length = ("00.png", "11.png", float(np.linalg.norm(last - first)))
    run(tmp_path, sparse, photographs, length=length)
    frames, report = loaded(tmp_path)
    found = np.stack([frames[name].T_world_from_camera for name in truth])
    expected = np.stack([pose for pose, _ in truth.values()])
    aligned = align_poses(found, expected, np.inf, np.inf)
    assert aligned.similarity.scale == pytest.approx(1.0, abs=0.005)
    assert aligned.position_error_m.max() < 0.01
    assert report["ground_at_zero"], "the floor of the corner"
    np.testing.assert_allclose(found[:, 2, 3], 1.5, atol=0.02)


def test_the_command_says_what_it_did(tmp_path, ring):
    write(synthetic(4), tmp_path / "several" / "1")
    write(pycolmap.Reconstruction(ring[0]), tmp_path / "several" / "0")
    (ring[1] / "front" / "0.png").unlink()
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "scene",
        "from-scan",
        tmp_path / "several",
        "--images",
        ring[1],
    ]
    command += ["-o", tmp_path / "out", "--length", "front/1.png", "rear/2.png", "2.5"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "of 0 (8 images), 1 (4 images); --model uses another" in done.stdout
    assert "7 of 8 images placed" in done.stdout
    assert "left out: front/0.png: it is not in" in done.stdout
    assert "scale: metric: 2.5 m from front/1.png to rear/2.png" in done.stdout
