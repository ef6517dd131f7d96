"""``scene from-scan``: data sets from samples of each format, compared with the cameras that they were written from."""

import json
import subprocess
import sys

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from advnerf_core.data.image_files import read_stored
from advnerf_core.data.lens import Lens
from advnerf_core.data.scan_folder import SCANS, scan_of
from advnerf_core.data.similarity import align_poses
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.views import HELD_OUT_SPLITS
from advnerf_core.errors import AdvnerfError
from calibration.scans.reading import READERS
from calibration.scans.scan import ScanError, ScanOptions
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.media import MediaConfig, gather
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.scan import from_scan
from nodes.lab.scene_training import scene_field
from nodes.lab.training_request import TrainingRequest
from tests.support import scan_samples
from tests.support.scan_samples import BROWN, FISHEYE, HEIGHT, KINDS, TRUTH, WIDTH, K

ORIGIN = TRUTH[0][:3, 3]
POINTS = np.random.default_rng(3).uniform([-0.5, -0.5, 0.2], [0.5, 0.5, 1.0], (50, 3))


def run(tmp_path, path, options=None, **known):
    def report(share, text=""):
        assert 0.0 <= share <= 1.0

    from_scan(path, tmp_path / "out", options or ScanOptions(), MetricOptions(**known), report)
    frames = load_transforms(tmp_path / "out", require_all=True).frames
    return frames, json.loads((tmp_path / "out" / "import.json").read_text())


def pixels_of(T, k=(), fisheye=False):
    """Where a true camera sees the points, by OpenCV."""
    matrix = K.copy()
    matrix[:2, 2] -= 0.5
    w2c = np.linalg.inv(T)
    rvec, tvec = cv2.Rodrigues(w2c[:3, :3])[0], w2c[:3, 3]
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    return project(POINTS.reshape(-1, 1, 3), rvec, tvec, matrix, np.array(k))[0].reshape(-1, 2) + 0.5


def assert_same_pixels(frames, poses, k=(), fisheye=False, offset=(0.0, 0.0), world=lambda points: points):
    """Images show known points where the true cameras see them, to 0.1 % of the width."""
    assert len(frames) == len(poses)
    for frame, T in zip(sorted(frames, key=lambda each: each.path.as_posix()), poses, strict=True):
        local = (np.linalg.inv(frame.T_world_from_camera) @ np.c_[world(POINTS), np.ones(len(POINTS))].T)[
            :3
        ].T
        seen = frame.lens.distort(local, frame.pinhole) + np.array(offset)
        np.testing.assert_allclose(seen, pixels_of(T, k, fisheye), atol=0.001 * WIDTH)


def moved_to(origin):
    return lambda points: points - np.array(origin)


def aligned(frames):
    """The similarity that takes the frames to the truth, in the order of their names; all agree to 0.1 %."""
    found = np.stack([each.T_world_from_camera for each in sorted(frames, key=lambda each: each.path.name)])
    fit = align_poses(found, np.stack(TRUTH), np.inf, np.inf)
    assert fit.position_error_m.max() < 0.001 * fit.extent_m
    assert fit.rotation_error_rad.max() < 0.001
    return fit.similarity


def in_scan(similarity):
    back = np.linalg.inv(similarity.T_target_from_source)
    return lambda points: (
        (points - similarity.T_target_from_source[:3, 3]) @ back[:3, :3].T / similarity.scale
    )


def test_every_format_that_is_recognised_has_a_reader(tmp_path):
    assert [each.name for each in SCANS] == list(READERS)
    for kind in KINDS:
        assert scan_of(scan_samples.write(kind, tmp_path / kind)).name == kind
    assert scan_of(tmp_path) is None


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("read", [load_transforms, lambda path: gather([path], path, MediaConfig(), print)])
def test_other_commands_name_this_one(tmp_path, kind, read):
    scan = scan_samples.write(kind, tmp_path / "scan")
    if kind == "nerfstudio" and read is load_transforms:
        assert read(scan).frames
        return
    with pytest.raises(
        AdvnerfError, match=f"of the format {kind}, so run: advnerf scene from-scan {scan} -o"
    ):
        read(scan)


def test_polycam(tmp_path):
    frames, report = run(tmp_path, scan_samples.polycam(tmp_path / "scan"))
    # The floor, which the depth images show, is z = 0; x and y begin at the first camera.
    assert_same_pixels(frames, TRUTH, offset=(1.0, 1.0), world=moved_to([*ORIGIN[:2], 0.0]))
    assert (frames[0].pinhole.width, frames[0].pinhole.height) == (WIDTH - 2, HEIGHT - 2), "no border"
    assert report["ground_at_zero"]
    assert report["scale_from"] == "poses"
    assert report["up"].startswith("that of the scan; the ground is a plane of")


def test_reduced_images_of_polycam_keep_their_rays(tmp_path):
    scan = scan_samples.polycam(tmp_path / "scan")
    for number, file in enumerate(sorted((scan / "keyframes" / "corrected_images").iterdir())):
        scan_samples.write_image(file, number, (WIDTH // 2, HEIGHT // 2))
    frames, _ = run(tmp_path, scan)
    for frame in frames:  # the border is less than half a pixel
        assert (frame.pinhole.width, frame.pinhole.fx, frame.pinhole.cx) == (
            WIDTH // 2,
            K[0, 0] / 2,
            K[0, 2] / 2,
        )
        assert read_stored(frame.path)[0].shape == (HEIGHT // 2, WIDTH // 2, 3)


def test_polycam_without_correction_and_depth(tmp_path):
    frames, report = run(tmp_path, scan_samples.polycam(tmp_path / "scan", corrected=False, depth=False))
    assert_same_pixels(frames, TRUTH, world=moved_to(ORIGIN))
    assert not report["ground_at_zero"]
    assert "not corrected" in next(iter(report["model"]["cameras"].values()))["why"]


@pytest.mark.parametrize("packed", [True, False])
def test_record3d(tmp_path, packed):
    frames, report = run(
        tmp_path, scan_samples.record3d(tmp_path / ("scan.r3d" if packed else "scan"), packed)
    )
    similarity = aligned(frames)
    assert similarity.scale == pytest.approx(1.0, abs=1e-6)
    assert_same_pixels(frames, TRUTH, world=in_scan(similarity))
    assert report["scale_from"] == "poses"
    assert report["up"] == "the cameras' up"
    np.testing.assert_allclose(similarity.T_target_from_source[2, :3], [0.0, 0.0, 1.0], atol=0.05)


def test_each_image_of_record3d_has_its_focal_length(tmp_path):
    frames, report = run(tmp_path, scan_samples.record3d(tmp_path / "folder" / "a.r3d", each=True).parent)
    assert sorted(each.pinhole.fx for each in frames) == [50.0 + n for n in range(8)]
    assert report["model"]["cameras"]["phone"]["why"].endswith("the median is shown")


@pytest.mark.parametrize("factor", [1, 2])
def test_llff(tmp_path, factor):
    frames, report = run(tmp_path, scan_samples.llff(tmp_path / "scan", factor))
    assert aligned(frames).scale == pytest.approx(5.0, rel=1e-6)
    pinhole = frames[0].pinhole
    assert (pinhole.width, pinhole.fx, pinhole.cx, pinhole.cy) == (
        64 // factor,
        50 / factor,
        32 / factor,
        24 / factor,
    )
    assert report["scale_from"] is None
    assert report["scale"].startswith("unknown: lengths are in COLMAP's unit")
    listed = load_transforms(tmp_path / "out")
    assert listed.aabb_scale > 1.0, "unbounded"
    low, high = listed.inner_box()
    assert all(
        (low < each.T_world_from_camera[:3, 3]).all() and (each.T_world_from_camera[:3, 3] < high).all()
        for each in frames
    )


@pytest.mark.parametrize(("fisheye", "k"), [(False, BROWN), (True, FISHEYE)])
def test_euroc(tmp_path, fisheye, k):
    frames, report = run(tmp_path, scan_samples.euroc(tmp_path / "scan", fisheye))
    first = [each for each in frames if each.camera_id == "cam0"]
    assert_same_pixels(first, TRUTH, k, fisheye)
    right = [T @ np.array([*np.eye(4)[:3], [0.11, 0.0, 0.0, 1.0]]).T for T in TRUTH]
    assert_same_pixels([each for each in frames if each.camera_id == "cam1"], right, k, fisheye)
    assert report["scale_from"] == "poses"


def test_markers_on_the_body_of_euroc_are_not_its_camera(tmp_path):
    frames, _ = run(tmp_path, scan_samples.euroc(tmp_path / "scan", cameras=("cam0",), tracked="vicon0"))
    assert_same_pixels(frames, TRUTH, BROWN)


@pytest.mark.parametrize("head", ["%YAML:1.0\n", "%YAML:1.0\n---\n"])
def test_sensors_of_euroc_that_opencv_wrote(tmp_path, head):
    scan = scan_samples.euroc(tmp_path / "scan", cameras=("cam0",))
    for file in scan.rglob("sensor.yaml"):
        text = file.read_text().split("\n", 1)[1].replace("T_BS:\n", "T_BS: !!opencv-matrix\n   dt: d\n")
        file.write_text(
            head + text.replace("  cols", "   cols").replace("  rows", "   rows").replace("  data", "   data")
        )
    sensor = cv2.FileStorage(str(scan / "mav0" / "cam0" / "sensor.yaml"), cv2.FILE_STORAGE_READ)
    assert sensor.getNode("T_BS").mat().shape == (4, 4), "OpenCV reads what we read"
    frames, _ = run(tmp_path, scan)
    assert_same_pixels(frames, TRUTH, BROWN)


def test_one_folder_of_images_or_one_lens_is_not_for_several_cameras_of_euroc(tmp_path):
    """Both cameras would have shown the same files, as names of EuRoC are time stamps."""
    scan = scan_samples.euroc(tmp_path / "scan")
    given = ScanOptions(images=scan / "mav0" / "cam1" / "data", calibration=calibration(tmp_path))
    with pytest.raises(
        AdvnerfError, match=r"--images and --calibration for a recording of one camera, got cam0, cam1"
    ):
        run(tmp_path, scan, given)


@pytest.mark.parametrize("kind", ["EuRoC", "TUM"])
def test_a_trajectory_whose_header_names_another_order_is_refused(tmp_path, kind):
    """ROS writes x y z w, EuRoC w x y z: turned cameras that nothing else shows."""
    scan = scan_samples.write(kind, tmp_path / "scan")
    file = next(scan.rglob("state_groundtruth_estimate0/data.csv" if kind == "EuRoC" else "groundtruth.txt"))
    other = {"q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []": "qx, qy, qz, qw", "qx qy qz qw": "qw qx qy qz"}
    text = file.read_text()
    for ours, theirs in other.items():
        text = text.replace(ours, theirs)
    file.write_text(text)
    with pytest.raises(AdvnerfError, match=r"expected columns of a position and a quaternion in the order"):
        run(tmp_path, scan)


@pytest.mark.parametrize("kind", KINDS)
def test_training_takes_the_data_set_without_a_box(tmp_path, kind):
    run(tmp_path, scan_samples.write(kind, tmp_path / "scan"))
    listed = load_transforms(tmp_path / "out", require_all=True)
    images = listed.load()
    field = scene_field(TrainingRequest(tmp_path / "out", tmp_path / "learned"), listed, images)
    places = images.T_world_from_camera[:, :3, 3]
    assert (places > field.box_low_m).all()
    assert (places < field.box_high_m).all()
    assert field.contraction == (kind not in ("Polycam", "nerfstudio")), "unbounded without points"


@pytest.mark.parametrize("listed", [True, False])
def test_tum(tmp_path, listed):
    frames, report = run(tmp_path, scan_samples.tum(tmp_path / "scan", listed))
    assert_same_pixels(frames, TRUTH)
    assert report["scan"] == {"format": "TUM", "rows_without_pose": 0}


def test_numbers_of_frames_are_no_time_stamps(tmp_path):
    scan = scan_samples.tum(tmp_path / "scan", listed=False)
    for number, file in enumerate(sorted((scan / "rgb").iterdir())):
        file.rename(file.with_name(f"{number:06d}.png"))
    rows = np.loadtxt(scan / "groundtruth.txt")
    np.savetxt(scan / "groundtruth.txt", rows - [rows[0, 0], *7 * [0.0]])
    with pytest.raises(AdvnerfError, match=r"000000.png: expected the time stamp \[s\] as the name"):
        run(tmp_path, scan)


def test_a_trajectory_of_slam_has_its_own_unit_and_directions(tmp_path):
    """Monocular SLAM begins at the first camera, and its unit of length is anything."""
    scan = scan_samples.tum(tmp_path / "scan", depth=True)
    rows = np.loadtxt(scan / "groundtruth.txt")
    first = np.linalg.inv(TRUTH[0])
    for row in rows:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = Rotation.from_quat(row[4:]).as_matrix(), row[1:4]
        T = first @ T
        row[1:4], row[4:] = 0.31 * T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat()
    (scan / "groundtruth.txt").unlink()
    np.savetxt(scan / "KeyFrameTrajectory.txt", rows, fmt="%.9f")
    frames, report = run(tmp_path, scan)
    similarity = aligned(frames)
    assert similarity.scale == pytest.approx(1.0 / 0.31, rel=1e-4)
    assert_same_pixels(frames, TRUTH, world=in_scan(similarity))
    assert report["scale_from"] is None
    assert report["scale"].startswith("unknown: lengths are in the unit of KeyFrameTrajectory.txt")
    assert report["up"] == "the cameras' up"
    np.testing.assert_allclose(similarity.T_target_from_source[2, :3], [0.0, 0.0, 1.0], atol=0.05)
    names = sorted(frame.path.name for frame in frames)
    length_m = float(np.linalg.norm(TRUTH[0][:3, 3] - TRUTH[5][:3, 3]))
    frames, report = run(tmp_path, scan, length=(names[0], names[5], length_m))
    assert aligned(frames).scale == pytest.approx(1.0, rel=1e-4)
    assert report["scale_from"] == "length"


def test_depth_images_of_tum_show_the_ground(tmp_path):
    frames, report = run(tmp_path, scan_samples.tum(tmp_path / "scan", depth=True))
    assert report["ground_at_zero"]
    assert report["T_world_from_scan"][2][3] == pytest.approx(0.0, abs=0.002)
    assert_same_pixels(frames, TRUTH)


@pytest.mark.parametrize("values_per_m", [1000.0, 5000.0])
def test_depth_images_of_tum_may_be_in_millimetres(tmp_path, values_per_m):
    """The camera keeps its height, so that wrong scales give a plane too: only the wall tells them apart."""
    scan = scan_samples.tum(tmp_path / "scan", depth=True)
    rows = np.loadtxt(scan / "groundtruth.txt")
    rows[:, 3] = 1.5
    np.savetxt(scan / "groundtruth.txt", rows, fmt="%.9f")
    for file, T in zip(sorted((scan / "depth").iterdir()), TRUTH, strict=True):
        level = T.copy()
        level[2, 3] = 1.5
        depth_m = scan_samples.depth_of_floor(level, WIDTH, HEIGHT)
        rays = scan_samples.rays(WIDTH, HEIGHT)
        for axis, at in ((0, -4.0), (0, 4.0), (1, -4.0), (1, 4.0)):
            towards = rays @ level[axis, :3]
            with np.errstate(divide="ignore"):
                wall_m = (at - level[axis, 3]) / towards
            nearer = (wall_m > 0.0) & ((depth_m == 0.0) | (wall_m < depth_m))
            depth_m = np.where(nearer, wall_m, depth_m)
        cv2.imwrite(str(file), np.round(values_per_m * depth_m).clip(0, 65535).astype(np.uint16))
    frames, report = run(tmp_path, scan)
    assert report["ground_at_zero"]
    heights_m = [frame.T_world_from_camera[2, 3] for frame in frames]
    np.testing.assert_allclose(heights_m, 1.5, atol=0.005)
    assert f"depth images have {values_per_m:g} values per metre" in report["scale"]


def test_depth_images_in_another_unit_are_refused(tmp_path):
    scan = scan_samples.tum(tmp_path / "scan", depth=True)
    for file in sorted((scan / "depth").iterdir())[::2]:
        cv2.imwrite(str(file), cv2.imread(str(file), cv2.IMREAD_UNCHANGED) // 40)
    with pytest.raises(
        AdvnerfError, match=r"depth.txt: expected depth images of 5000 values per metre, or in mill"
    ):
        run(tmp_path, scan)


def test_a_trajectory_with_y_up_is_refused(tmp_path):
    scan = scan_samples.tum(tmp_path / "scan", depth=True)
    rows = np.loadtxt(scan / "groundtruth.txt")
    y_up = scan_samples.Y_UP[:3, :3]
    rows[:, 1:4] = rows[:, 1:4] @ y_up.T
    rows[:, 4:] = (Rotation.from_matrix(y_up) * Rotation.from_quat(rows[:, 4:])).as_quat()
    np.savetxt(scan / "groundtruth.txt", rows, fmt="%.9f")
    with pytest.raises(
        AdvnerfError, match=r"tops point (8|9)\d degrees away from it: .* or give --up cameras"
    ):
        run(tmp_path, scan)
    frames, _ = run(tmp_path, scan, up="cameras")
    tops = [-frame.T_world_from_camera[2, 1] for frame in frames]
    assert min(tops) > 0.8


def test_kinects_of_the_benchmark_are_known(tmp_path):
    scan = scan_samples.tum(tmp_path / "rgbd_dataset_freiburg1_desk")
    (scan / "calibration.txt").unlink()
    for number, file in enumerate(sorted((scan / "rgb").iterdir())):
        scan_samples.write_image(file, number, (640, 480))
    frames, _ = run(tmp_path, scan)
    assert (frames[0].pinhole.fx, frames[0].pinhole.cx) == (517.3, 319.1)
    assert frames[0].lens == Lens((0.2624, -0.9531, -0.0054, 0.0026, 1.1633))


@pytest.mark.parametrize(("fisheye", "k"), [(False, BROWN), (True, FISHEYE)])
def test_nerfstudio(tmp_path, fisheye, k):
    frames, report = run(tmp_path, scan_samples.nerfstudio(tmp_path / "scan", fisheye))
    similarity = aligned(frames)
    assert similarity.scale == pytest.approx(5.0, rel=1e-6)
    assert_same_pixels(frames, TRUTH, k, fisheye, world=in_scan(similarity))
    assert report["ground_at_zero"], "sparse_pc.ply shows the floor"
    assert report["scale_from"] is None
    assert [each.split for each in frames] == ["train"] * 6 + ["val"] * 2
    assert len(load_transforms(tmp_path / "out").of_split(*HELD_OUT_SPLITS).frames) == 2


def test_masks_go_along(tmp_path):
    frames, _ = run(tmp_path, scan_samples.nerfstudio(tmp_path / "scan", masks=True))
    assert all(
        (read_stored(each.mask)[0][:10] == 0).all() and each.mask.is_relative_to(tmp_path / "out" / "masks")
        for each in frames
    )


def test_a_mask_of_another_size_or_without_a_pixel_leaves_its_image_out(tmp_path):
    scan = scan_samples.nerfstudio(tmp_path / "scan", masks=True)
    masks = sorted((scan / "masks").iterdir())
    assert cv2.imwrite(str(masks[0]), np.full((HEIGHT // 2, WIDTH // 2), 255, np.uint8))
    assert cv2.imwrite(str(masks[3]), np.zeros((HEIGHT, WIDTH), np.uint8))
    frames, report = run(tmp_path, scan)
    assert len(frames) == 6
    first, second = report["model"]["left_out"]
    assert first["why"].startswith(
        f"expected a mask of {WIDTH} x {HEIGHT}, the size of frame_00001.png, got {masks[0]}"
    )
    assert second["why"].startswith("expected a mask with something that is not black")
    load_transforms(tmp_path / "out").load()


@pytest.mark.parametrize("applied_scale", [1.0, 0.4])
def test_the_world_of_a_trained_model_is_found_again(tmp_path, applied_scale):
    scan = scan_samples.nerfstudio(tmp_path / "scan")
    content = json.loads((scan / "transforms.json").read_text())
    content["applied_transform"] = applied = [[0.0, 1, 0, 0.5], [1, 0, 0, -0.3], [0, 0, -1, 0.2]]
    (scan / "transforms.json").write_text(json.dumps(content | {"applied_scale": applied_scale}))
    # As nerfstudio does it: it turns and scales the poses of the file, then writes what takes COLMAP's world there.
    oriented = np.array([[0.0, 0, 1, 0.3], [1, 0, 0, -0.2], [0, 1, 0, 0.1], [0, 0, 0, 1]])
    transform = (oriented @ np.vstack([applied, [0, 0, 0, 1]]))[:3]
    (scan / "dataparser_transforms.json").write_text(
        json.dumps({"transform": transform.tolist(), "scale": 0.7 * applied_scale})
    )
    _, report = run(tmp_path, scan)
    in_colmap = np.array([0.3, -0.1, 0.5, 1.0])
    in_file = applied_scale * np.array(applied) @ in_colmap
    in_model = 0.7 * (oriented @ [*in_file, 1.0])[:3]
    facts = report["scan"]
    for name, point in (("dataparser", in_model), ("colmap", in_colmap[:3])):
        unscaled = np.append(facts[f"scan_units_per_{name}_unit"] * point, 1.0)
        np.testing.assert_allclose((facts[f"T_scan_from_{name}"] @ unscaled)[:3], in_file, atol=1e-12)


@pytest.mark.parametrize("value", [0.0, -1.0, "a"])
def test_an_applied_scale_that_is_none_is_refused(tmp_path, value):
    scan = scan_samples.nerfstudio(tmp_path / "scan")
    content = json.loads((scan / "transforms.json").read_text())
    (scan / "transforms.json").write_text(json.dumps(content | {"applied_scale": value}))
    with pytest.raises(ScanError, match=r"applied_scale: expected a (finite )?number"):
        run(tmp_path, scan)


def test_a_known_length_gives_metres(tmp_path):
    length_m = float(np.linalg.norm(TRUTH[0][:3, 3] - TRUTH[5][:3, 3]))
    frames, report = run(
        tmp_path, scan_samples.llff(tmp_path / "scan"), length=("IMG_000.png", "IMG_005.png", length_m)
    )
    assert aligned(frames).scale == pytest.approx(1.0, rel=1e-6)
    assert report["scale_from"] == "length"


def test_a_length_that_contradicts_a_metric_scan_is_said_or_refused(tmp_path):
    scan, ends = scan_samples.polycam(tmp_path / "scan"), ("9876543.jpg", "13876543.jpg")
    length_m = float(np.linalg.norm(TRUTH[0][:3, 3] - TRUTH[5][:3, 3]))
    _, report = run(tmp_path, scan, length=(*ends, 1.03 * length_m))
    assert report["scale"].endswith("; this makes the scan, which is in metres, 1.03 times as large")
    positions = tmp_path / "gps.csv"
    rows = [f"{9876543 + 800_000 * k}.jpg,{','.join(map(str, 100 * T[:3, 3]))}" for k, T in enumerate(TRUTH)]
    positions.write_text("\n".join(["image,x_m,y_m,z_m", *rows]))
    for known in ({"length": (*ends, 8.9 * length_m)}, {"positions": positions}):
        with pytest.raises(
            ImportRecordingError, match=r"a length that the scan agrees with.* times as large"
        ):
            run(tmp_path, scan, **known)
    with pytest.raises(ImportRecordingError, match="expected --dictionary only with --marker"):
        MetricOptions(dictionary="DICT_4X4_50")


@pytest.mark.parametrize(
    ("kind", "unused"),
    [
        ("Polycam", ("model", "calibration")),
        ("Record3D", ("images", "model", "calibration")),
        ("EuRoC", ("model",)),
        ("nerfstudio", ("images", "model", "calibration")),
        ("LLFF", ("model", "calibration")),
        ("TUM", ("model",)),
    ],
)
def test_an_option_that_the_format_does_not_use_is_refused(tmp_path, kind, unused):
    scan = scan_samples.write(kind, tmp_path / "scan")
    values = {"images": tmp_path, "model": "7", "calibration": calibration(tmp_path)}
    for name in unused:
        with pytest.raises(AdvnerfError, match=rf"for a scan of {kind}, .* got --{name}; leave it out"):
            run(tmp_path, scan, ScanOptions(**{name: values[name]}))


def test_an_image_that_is_damaged_is_left_out(tmp_path):
    scan = scan_samples.write("Record3D", tmp_path)
    data = bytearray(scan.read_bytes())
    at = data.index(b"rgbd/3.jpg") + 200
    data[at : at + 20] = bytes(20)
    scan.write_bytes(data)
    frames, report = run(tmp_path, scan)
    assert len(frames) == 7
    assert report["model"]["left_out"][0]["name"] == "rgbd/3.jpg"
    assert "Bad CRC-32" in report["model"]["left_out"][0]["why"]


def test_a_damaged_image_is_named_as_in_the_scan(tmp_path):
    scan = scan_samples.nerfstudio(tmp_path / "scan")
    file = sorted((scan / "images").iterdir())[3]
    file.write_bytes(file.read_bytes()[:20])
    (left_out,) = run(tmp_path, scan)[1]["model"]["left_out"]
    assert f"got {left_out['name']} (20 bytes)" in left_out["why"]


def test_silhouettes_leave_the_box_to_training(tmp_path):
    scan = scan_samples.nerfstudio(tmp_path / "scan")
    (scan / "sparse_pc.ply").unlink()
    run(tmp_path, scan)
    assert load_transforms(tmp_path / "out").aabb_scale == 16.0
    for file in (scan / "images").iterdir():
        image = cv2.imread(str(file))
        assert cv2.imwrite(str(file), np.dstack([image, np.full(image.shape[:2], 200, np.uint8)]))
    run(tmp_path, scan)
    assert load_transforms(tmp_path / "out").aabb_scale is None


def test_recordings_are_thinned(tmp_path):
    frames, _ = run(tmp_path, scan_samples.tum(tmp_path / "scan"), ScanOptions(most=4))
    assert len(frames) == 4


def test_images_that_most_leaves_out_are_not_said_to_have_no_pose(tmp_path):
    frames, report = run(tmp_path, scan_samples.polycam(tmp_path / "scan"), ScanOptions(most=4))
    assert len(frames) == 4
    assert {each["why"] for each in report["model"]["left_out"]} == {"--most leaves it out"}
    assert len(report["model"]["left_out"]) == len(TRUTH) - 4


def test_a_lens_and_images_may_be_given(tmp_path):
    scan = scan_samples.euroc(tmp_path / "scan", cameras=("cam0",))
    (scan / "mav0" / "cam0" / "sensor.yaml").unlink()
    (scan / "mav0" / "cam0" / "data").rename(tmp_path / "pictures")
    with pytest.raises(AdvnerfError, match=r"give their folder with --images"):
        run(tmp_path, scan, ScanOptions(calibration=calibration(tmp_path)))
    frames, _ = run(
        tmp_path, scan, ScanOptions(calibration=calibration(tmp_path), images=tmp_path / "pictures")
    )
    assert frames[0].lens == Lens((*BROWN, 0.0))
    assert frames[0].pinhole.cx == K[0, 2]


def calibration(folder):
    rows = "\n".join(f"- {row}" for row in np.eye(4).tolist())
    file = folder / "camera.yaml"
    file.write_text(
        f"kind: camera\ndate: 2026-01-01\nmethod: known\nwidth: {WIDTH}\nheight: {HEIGHT}\nfx: {K[0, 0]}\nfy: {K[1, 1]}\ncx: {K[0, 2]}\ncy: {K[1, 2]}\n"
        f"distortion: {[*BROWN, 0.0]}\nT_car_from_camera:\n{rows}\n"
    )
    return file


def test_the_command_takes_all_formats(tmp_path):
    command = [
        sys.executable,
        "-m",
        "nodes.cli",
        "scene",
        "from-scan",
        scan_samples.write("Record3D", tmp_path),
    ]
    done = subprocess.run([*command, "-o", tmp_path / "out"], capture_output=True, text=True, check=True)
    assert "format: Record3D" in done.stdout
    assert "8 of 8 images placed, 0 points\n" in done.stdout
    assert "scale: metric: lengths of ARKit" in done.stdout
