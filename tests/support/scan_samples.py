"""Scans of one known scene in every format, written as their documentation says, by scipy, OpenCV and the standard library alone."""

import json
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 64, 48
COUNT = 8
K = np.array([[50.0, 0.0, 31.5], [0.0, 51.0, 24.5], [0.0, 0.0, 1.0]])  # pixel centres at +0.5
BROWN = (-0.1, 0.02, 0.001, -0.002)
FISHEYE = (0.01, -0.002, 0.001, 0.0005)
Array = NDArray[np.float64]
RATE_HZ, START_NS = 20, 1403636579763555584


def camera_at(time_s: float) -> Array:
    """``T_world_from_camera`` of a camera that walks around the origin, 1.5 m above the ground, x right, y down, z forward."""
    angle = 0.9 * time_s
    position = np.array([3.0 * math.cos(angle), 2.0 * math.sin(angle), 1.5 + 0.1 * math.sin(2.0 * angle)])
    forward = np.array([0.0, 0.3, 0.6]) - position
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3] = np.column_stack([right, np.cross(forward, right), forward, position])
    return T


TIMES_S = np.arange(COUNT) * 0.8
TRUTH = [camera_at(time_s) for time_s in TIMES_S]
# World with y up and the origin at the first camera, as ARKit has it.
Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])


def opengl(T: Array) -> Array:
    """The same camera with x right, y up, z backward."""
    return np.column_stack([T[:, 0], -T[:, 1], -T[:, 2], T[:, 3]])


def arkit(T: Array) -> Array:
    moved = T.copy()
    moved[:3, 3] -= TRUTH[0][:3, 3]
    return Y_UP @ opengl(moved)


def picture(number: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> NDArray[np.uint8]:
    return np.random.default_rng(number).integers(0, 256, (size[1], size[0], 3), np.uint8)


def write_image(file: Path, number: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(file), picture(number, size))


def rays(width: int, height: int) -> Array:
    """Rays ``[H, W, 3]`` of the pixels in the camera, of depth 1."""
    scale = np.array([width / WIDTH, height / HEIGHT])
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack(
        [(u / scale[0] - K[0, 2]) / K[0, 0], (v / scale[1] - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1
    )


def depth_of_floor(T: Array, width: int, height: int) -> Array:
    """Planar depth [m] of the floor z = 0; 0 where the camera sees none."""
    down = rays(width, height) @ T[2, :3]
    return np.where(down < -1e-3, -T[2, 3] / np.minimum(down, -1e-3), 0.0)


def polycam(folder: Path, corrected: bool = True, depth: bool = True) -> Path:
    keyframes, prefix = folder / "keyframes", "corrected_" if corrected else ""
    for number, T in enumerate(TRUTH):
        name = f"{9876543 + 800_000 * number}"
        write_image(keyframes / f"{prefix}images" / f"{name}.jpg", number)
        rows = {f"t_{row}{column}": float(arkit(T)[row, column]) for row in range(3) for column in range(4)}
        lens = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "width": WIDTH, "height": HEIGHT}
        file = keyframes / f"{prefix}cameras" / f"{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({**rows, **lens, "blur_score": 120.5, "timestamp": int(name)}))
        if depth:
            (keyframes / "depth").mkdir(exist_ok=True)
            (keyframes / "confidence").mkdir(exist_ok=True)
            depth_mm = np.round(1000.0 * depth_of_floor(T, 32, 24)).clip(0, 65535).astype(np.uint16)
            cv2.imwrite(str(keyframes / "depth" / f"{name}.png"), depth_mm)
            cv2.imwrite(str(keyframes / "confidence" / f"{name}.png"), np.full((24, 32), 255, np.uint8))
    (folder / "mesh_info.json").write_text("{}")
    return folder


def record3d(file: Path, packed: bool = True, each: bool = False) -> Path:
    relative = [np.linalg.inv(opengl(TRUTH[0])) @ opengl(T) for T in TRUTH]
    poses = [[*Rotation.from_matrix(T[:3, :3]).as_quat(), *T[:3, 3]] for T in relative]
    metadata: dict[str, Any] = {
        "w": WIDTH, "h": HEIGHT, "dw": 16, "dh": 12, "fps": 60, "K": K.T.ravel().tolist(), "poses": poses,
        "initPose": [0, 0, 0, 1, 0, 0, 0], "frameTimestamps": TIMES_S.tolist(),
    }  # fmt: skip
    if each:
        metadata["perFrameIntrinsicCoeffs"] = [
            [K[0, 0] + n, K[1, 1] + n, K[0, 2], K[1, 2]] for n in range(COUNT)
        ]
    images = {f"{n}.jpg": cv2.imencode(".jpg", picture(n))[1].tobytes() for n in range(COUNT)}
    if packed:
        file.parent.mkdir(parents=True, exist_ok=True)
        with zipfile.ZipFile(file, "w") as archive:
            archive.writestr("metadata", json.dumps(metadata))
            for name, data in images.items():
                archive.writestr(f"rgbd/{name}", data)
                archive.writestr(f"rgbd/{Path(name).stem}.depth", b"bvx2")
        return file
    (file / "rgb").mkdir(parents=True)
    (file / "metadata.json").write_text(json.dumps(metadata))
    for name, data in images.items():
        (file / "rgb" / name).write_bytes(data)
    return file


def llff(folder: Path, factor: int = 1, unit: float = 0.2) -> Path:
    """Poses in COLMAP's world: any rotation, any unit; the principal point is the centre."""
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [0.9, 0.4, -2.0]).as_matrix()
    rows = []
    for number, T in enumerate(TRUTH):
        moved = turned @ T
        right, down, forward, position = moved[:3].T
        pose = np.column_stack([down, right, -forward, unit * position, [HEIGHT, WIDTH, K[0, 0]]])
        rows.append([*pose.ravel(), 0.5 * unit, 4.0 * unit])
        name = "images" if factor == 1 else f"images_{factor}"
        write_image(folder / name / f"IMG_{number:03d}.png", number, (WIDTH // factor, HEIGHT // factor))
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return folder


def euroc(
    folder: Path,
    fisheye: bool = False,
    cameras: tuple[str, ...] = ("cam0", "cam1"),
    tracked: str = "state_groundtruth_estimate0",
) -> Path:
    T_BS = np.eye(4)
    T_BS[:3, :3] = Rotation.from_euler("zyx", [1.5, 0.1, -0.2]).as_matrix()
    T_BS[:3, 3] = [-0.02, -0.06, 0.01]
    T_BM = np.eye(4)  # what is tracked: the body, or markers on it
    if tracked == "vicon0":
        T_BM[:3, :3] = Rotation.from_euler("zyx", [0.7, -0.3, 0.2]).as_matrix()
        T_BM[:3, 3] = [0.07, 0.01, 0.12]
    truth = folder / "mav0" / tracked
    truth.mkdir(parents=True)
    stamps = range(START_NS, START_NS + round(1e9 * TIMES_S[-1]) + 1, 10_000_000)
    lines = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], v_RS_R_x [m s^-1]"
    ]
    for stamp in stamps:
        T_WM = camera_at(1e-9 * (stamp - START_NS)) @ np.linalg.inv(T_BS) @ T_BM
        x, y, z, w = Rotation.from_matrix(T_WM[:3, :3]).as_quat()
        lines.append(",".join(map(repr, (stamp, *map(float, (*T_WM[:3, 3], w, x, y, z, 0.0))))))
    (truth / "data.csv").write_text("\n".join(lines) + "\n")
    body = f"sensor_type: pose\nT_BS:\n  cols: 4\n  rows: 4\n  data: {T_BM.ravel().tolist()}\n"
    (truth / "sensor.yaml").write_text(body)
    for number, name in enumerate(cameras):
        T = T_BS.copy()
        T[:3, 3] += 0.11 * number * T_BS[:3, 0]  # to the right of the first
        camera = folder / "mav0" / name
        rows = ["#timestamp [ns],filename"]
        for image, time_s in enumerate(TIMES_S):
            stamp = START_NS + round(1e9 * time_s)
            rows.append(f"{stamp},{stamp}.png")
            write_image(camera / "data" / f"{stamp}.png", image)
        (camera / "data.csv").write_text("\r\n".join(rows) + "\r\n")
        model, k = ("equidistant", FISHEYE) if fisheye else ("radial-tangential", BROWN)
        (camera / "sensor.yaml").write_text(
            f"# General sensor definitions.\nsensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: {T.ravel().tolist()}\nrate_hz: {RATE_HZ}\n"
            f"resolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\nintrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2] - 0.5}, {K[1, 2] - 0.5}] #fu, fv, cu, cv\n"
            f"distortion_model: {model}\ndistortion_coefficients: {list(k)}\n"
        )
    return folder


def tum(folder: Path, listed: bool = True, depth: bool = False) -> Path:
    start_s = 1305031102.175304
    folder.mkdir(parents=True, exist_ok=True)
    rows = ["# ground truth trajectory", "# file: 'a.bag'", "# timestamp tx ty tz qx qy qz qw"]
    for index in range(round(100 * TIMES_S[-1]) + 3):
        time_s = 0.01 * index - 0.004
        T = camera_at(time_s)
        numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        rows.append(f"{start_s + time_s:.6f} " + " ".join(f"{each:.8f}" for each in numbers))
    (folder / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    (folder / "calibration.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2] - 0.5} {K[1, 2] - 0.5}\n")
    lists = {"rgb": ["# color images"], "depth": ["# depth maps"]}
    for number, (time_s, T) in enumerate(zip(TIMES_S, TRUTH, strict=True)):
        stamp = f"{start_s + time_s:.6f}"
        write_image(folder / "rgb" / f"{stamp}.png", number)
        lists["rgb"].append(f"{stamp} rgb/{stamp}.png")
        if depth:
            values = np.round(5000.0 * depth_of_floor(T, WIDTH, HEIGHT)).clip(0, 65535).astype(np.uint16)
            (folder / "depth").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / "depth" / f"{stamp}.png"), values)
            lists["depth"].append(f"{stamp} depth/{stamp}.png")
    if listed:
        (folder / "rgb.txt").write_text("\n".join(lists["rgb"]) + "\n")
    if depth:
        (folder / "depth.txt").write_text("\n".join(lists["depth"]) + "\n")
    return folder


def nerfstudio(folder: Path, fisheye: bool = False, unit: float = 0.2, masks: bool = False) -> Path:
    """As ``ns-process-data`` writes it: COLMAP's world with x and y swapped and z turned, ``transforms.json`` and ``dataparser_transforms.json``."""
    applied = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]])
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("xyz", [0.3, 1.4, -2.0]).as_matrix()
    frames = []
    for number, T in enumerate(TRUTH):
        moved = np.vstack([applied, [0, 0, 0, 1]]) @ turned @ opengl(T)
        moved[:3, 3] *= unit
        name = f"images/frame_{number + 1:05d}.png"
        write_image(folder / name, number)
        frame: dict[str, Any] = {
            "file_path": name,
            "transform_matrix": moved.tolist(),
            "colmap_im_id": number + 1,
        }
        if masks:
            frame["mask_path"] = f"masks/frame_{number + 1:05d}.png"
            (folder / "masks").mkdir(exist_ok=True)
            mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
            mask[:10] = 0
            cv2.imwrite(str(folder / frame["mask_path"]), mask)
        frames.append(frame)
    k = dict(
        zip(
            ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2"),
            FISHEYE if fisheye else BROWN,
            strict=True,
        )
    )
    lens = {"w": WIDTH, "h": HEIGHT, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], **k}
    names = [frame["file_path"] for frame in frames]
    content: dict[str, Any] = {
        **lens, "camera_model": "OPENCV_FISHEYE" if fisheye else "OPENCV", "applied_transform": applied.tolist(), "ply_file_path": "sparse_pc.ply",
        "train_filenames": names[:6], "val_filenames": names[6:], "test_filenames": names[6:7], "frames": frames,
    }  # fmt: skip
    content.pop("test_filenames")
    (folder / "transforms.json").write_text(json.dumps(content, indent=4))
    rng = np.random.default_rng(0)
    floor = np.column_stack([rng.uniform(-3.0, 3.0, (400, 2)), np.zeros(400), np.ones(400)])
    points = unit * (np.vstack([applied, [0, 0, 0, 1]]) @ turned @ floor.T).T[:, :3]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\nproperty float x\nproperty float y\nproperty float z\nproperty uint8 red\nproperty uint8 green\nproperty uint8 blue\nend_header\n"
    (folder / "sparse_pc.ply").write_text(
        header + "".join("{:.7f} {:.7f} {:.7f} 1 2 3\n".format(*each) for each in points)
    )
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    "Polycam": polycam,
    "LLFF": llff,
    "EuRoC": euroc,
    "TUM": tum,
    "nerfstudio": nerfstudio,
}


def write(kind: str, folder: Path) -> Path:
    """A sample of a format; the path to give to the command."""
    if kind == "Record3D":
        return record3d(folder / "scan.r3d")
    folder.mkdir(parents=True, exist_ok=True)
    return WRITERS[kind](folder)


KINDS = ("Polycam", "Record3D", "EuRoC", "nerfstudio", "LLFF", "TUM")
