"""A place of photographs: its path, ground and camera are those of the car that took them."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.image_files import write_image
from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.data.transforms import load_transforms
from advnerf_core.documents import Document
from advnerf_core.errors import AdvnerfError, ConfigError
from advnerf_core.geometry import (
    Array,
    Pinhole,
    camera_mount,
    make_transform,
    planar_pose,
    rotation_z,
    transform_points,
)
from advnerf_core.strict import validate
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import WorldError
from nodes.lab.worlds.expert_drive import as_path
from nodes.lab.worlds.photographs.config import PhotographsConfig
from nodes.lab.worlds.photographs.track import driven_track, path_along, points_of
from nodes.lab.worlds.photographs.world import Photographs

MOUNT = camera_mount(0.3, 0.02, 0.2, 0.17)
# The frame of the photographs is turned about z and lies 1.2 m below the ground.
T_IMAGES_FROM_WORLD = make_transform(rotation_z(0.5), [3.0, -2.0, 1.2])
LOOP = ReferencePath(
    (0.0, -2.0, 0.0), (("line", 1.8), ("arc", 1.1, np.pi / 2)) * 4, closed=True
)  # 4 x (1.8 + 1.73) m
PINHOLE = Pinhole(64, 48, 40.0, 40.0, 32.0, 24.0)


def bearings(T: Array, pinhole: Pinhole) -> Array:
    """A world that is infinitely far: every pixel ``[h, w, 3]`` uint8 shows its direction in the world, smoothly."""
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    rays = np.stack(
        [(columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy, np.ones_like(rows)], -1
    )
    rays = rays @ T[:3, :3].T
    return np.round(127.5 * (1.0 + rays / np.linalg.norm(rays, axis=-1, keepdims=True))).astype(np.uint8)


def photographs(folder: Path, count: int = 40, noise_m: float = 0.0, path: ReferencePath = LOOP) -> Path:
    """Pictures of one lap, in the order of the drive."""
    rng = np.random.default_rng(0)
    cars = [planar_pose(*path.pose_at(path.length_m * index / count)) for index in range(count)]
    poses = [T_IMAGES_FROM_WORLD @ car @ MOUNT for car in cars]
    for pose in poses:
        pose[:3, 3] += noise_m * rng.standard_normal(3)
    write_posed_images(folder, poses, PINHOLE, lambda index: bearings(poses[index], PINHOLE), "png")
    return folder


def place(folder: Path, **changes: object) -> Photographs:
    data = {
        "images": "images_of_mine", "closed": True, "off_track_m": 0.25,
        "car": {"speed_mps": 0.8, "wheelbase_m": 0.3, "max_steering_rad": 0.4},
        "camera": {"x_m": 0.3, "y_m": 0.02, "z_m": 0.2}, **changes,
    }  # fmt: skip
    return Photographs(validate(PhotographsConfig, Document(data, "mine"), folder))


@pytest.mark.parametrize(
    ("count", "noise_m", "within_m"),
    [(40, 0.0, 0.02), (120, 0.0, 0.012), (120, 0.005, 0.02)],  # of half a lane of 0.25 m
)
def test_path_ground_and_pitch_are_those_of_the_drive(
    tmp_path: Path, count: int, noise_m: float, within_m: float
) -> None:
    photographs(tmp_path / "images_of_mine", count, noise_m)
    found = place(tmp_path)
    described = found.describe()
    assert np.allclose(described.T_car_from_camera, MOUNT, atol=1e-6)
    along_m = np.linspace(0.0, LOOP.length_m, 500)
    flat = np.column_stack([as_path(LOOP).pose_at(along_m)[:, :2], np.zeros(500)])
    true = transform_points(T_IMAGES_FROM_WORLD, flat)
    assert np.abs(as_path(described.paths["track"]).project(true[:, :2]).cte_m).max() < within_m
    assert described.paths["track"].length_m == pytest.approx(LOOP.length_m, rel=0.01)
    learned, held_out = found.photographs(6)
    assert (len(learned), len(held_out)) == (count - 6, 6)
    for each in held_out:
        assert each.T_world_from_camera[2, 3] == pytest.approx(0.2, abs=4 * noise_m + 1e-6)


def test_content_and_not_the_folder_is_what_results_depend_on(tmp_path: Path) -> None:
    for name in ("a", "b"):
        photographs(tmp_path / name / "images_of_mine", count=12)
    first, second = (place(tmp_path / name).config for name in ("a", "b"))
    assert first.model_dump() == second.model_dump()
    picture = tmp_path / "b" / "images_of_mine" / "images" / "00003.png"
    picture.write_bytes((picture.parent / "00009.png").read_bytes())
    assert place(tmp_path / "b").config.content_sha256 != first.content_sha256


def test_copies_of_photographs_are_refused_before_halves_share_them(tmp_path: Path) -> None:
    file = photographs(tmp_path / "images_of_mine", count=12) / "transforms.json"
    content = json.loads(file.read_text())
    shutil.copytree(file.parent / "images", file.parent / "copies")
    copies = [
        {**each, "file_path": each["file_path"].replace("images", "copies")} for each in content["frames"]
    ]
    listed_beside = file.with_name("transforms_car.json")
    listed_beside.write_text(json.dumps({**content, "frames": copies}))
    with pytest.raises(DatasetError, match=r"got images/\d+\.png again as copies/\d+\.png"):
        place(tmp_path, path=str(listed_beside)).photographs(3)
    file.write_text(json.dumps({**content, "frames": content["frames"] + copies}))
    with pytest.raises(DatasetError, match=r"got images/\d+\.png again as copies/\d+\.png"):
        place(tmp_path, half="even").photographs(3)


def test_one_file_with_two_paths_is_not_learned_where_it_is_held_out(tmp_path: Path) -> None:
    file = photographs(tmp_path / "images_of_mine", count=12) / "transforms.json"
    content = json.loads(file.read_text())
    for each in content["frames"]:
        each["file_path"] = f"../images_of_mine/{each['file_path']}"
    driven = file.with_name("transforms_car.json")
    driven.write_text(json.dumps(content))
    learned, held_out = place(tmp_path, path=str(driven)).photographs(3)
    assert (len(learned), len(held_out)) == (9, 3)


def test_a_view_of_the_driving_camera_is_cut_out_of_a_wider_photograph(tmp_path: Path) -> None:
    photographs(tmp_path / "images_of_mine", count=12)
    camera = Pinhole(40, 24, 50.0, 50.0, 20.0, 12.0)
    _, held_out = place(
        tmp_path, camera={"x_m": 0.3, "y_m": 0.02, "z_m": 0.2, "pinhole": vars(camera)}
    ).photographs(3)
    for each in held_out:
        rgb, pinhole = each.look()
        assert pinhole == camera
        pose = make_transform(each.T_world_from_camera[:3, :3], np.zeros(3))
        # Interpolated between pixels of 1.4 degrees, rounded twice.
        assert np.abs(rgb.astype(int) - bearings(pose, camera)).max() <= 2
    wide = vars(Pinhole(40, 24, 10.0, 10.0, 20.0, 12.0))
    _, held_out = place(tmp_path, camera={"x_m": 0.3, "z_m": 0.2, "pinhole": wide}).photographs(3)
    with pytest.raises(WorldError, match="show all that the driving camera"):
        held_out[0].look()


def test_a_small_camera_sees_the_mean_of_a_large_photograph(tmp_path: Path) -> None:
    """As a camera of so few pixels does; single pixels of a meadow or of gravel are noise to a policy."""
    poses = [planar_pose(0.1 * index, 0.0, 0.0) @ MOUNT for index in range(12)]
    fine = np.random.default_rng(0).integers(0, 2, (480, 640, 1), np.uint8) * 255 + np.zeros(3, np.uint8)
    large = Pinhole(640, 480, 400.0, 400.0, 320.0, 240.0)
    write_posed_images(tmp_path / "images_of_mine", poses, large, lambda _: fine, "png")
    camera = {"x_m": 0.3, "z_m": 0.2, "pinhole": vars(PINHOLE)}
    rgb, _ = place(tmp_path, closed=False, camera=camera).photographs(3)[1][0].look()
    assert rgb.shape == (48, 64, 3)
    # The mean of 10 x 10 pixels that are black or white.
    assert rgb.std() == pytest.approx(12.7, rel=0.15)


def test_a_leap_ends_a_drive_and_the_longest_part_is_taken() -> None:
    cars = np.stack([planar_pose(0.1 * index, 0.0, 0.0) for index in range(20)])
    elsewhere = np.stack([planar_pose(5.0, 0.1 * index, np.pi / 2) for index in range(8)])
    assert np.allclose(driven_track(np.concatenate([elsewhere, cars]))[:, 0], 0.1 * np.arange(20))
    back = np.stack([planar_pose(1.9 - 0.1 * index, 0.0, 0.0) for index in range(1, 12)])
    assert len(driven_track(np.concatenate([cars, back]))) == 20, "a car does not drive backwards"
    with pytest.raises(WorldError, match=r"one after the other along a drive, got 2 .* at most 2 are; .*CSV"):
        driven_track(cars[[0, 9]])


def test_photographs_are_put_in_the_order_of_their_names_if_that_is_the_drive_s(tmp_path: Path) -> None:
    """Sorted as text (0, 1, 10, 11, 2, ...), and as a program lists them that keeps no order."""
    file = photographs(tmp_path / "images_of_mine", count=48) / "transforms.json"
    content = json.loads(file.read_text())
    whole = place(tmp_path).path_points()
    assert len(whole) == 48
    for number, frame in enumerate(content["frames"]):
        old, new = file.parent / frame["file_path"], file.parent / "images" / f"view{number}.png"
        old.rename(new)
        frame["file_path"] = f"images/view{number}.png"
    for shown in (sorted(content["frames"], key=lambda each: each["file_path"]), shuffled(content["frames"])):
        file.write_text(json.dumps({**content, "frames": shown}))
        found = place(tmp_path)
        assert np.array_equal(found.path_points(), whole)
        assert [each.path.stem for each in found.along] == [f"view{number}" for number in range(48)]
    for number, frame in enumerate(shown):  # now no order is that of the drive
        (file.parent / frame["file_path"]).rename(file.parent / "images" / f"any{number}.png")
        frame["file_path"] = f"images/any{number}.png"
    file.write_text(json.dumps({**content, "frames": shown}))
    with pytest.raises(
        WorldError, match=r"got 48 of which at most \d are; list or name them in the order of the drive"
    ):
        place(tmp_path).path_points()


def shuffled(frames: list[Any]) -> list[Any]:
    return [frames[k] for k in np.random.default_rng(0).permutation(len(frames))]


@pytest.mark.parametrize(
    ("turn", "degrees"),
    [
        (np.diag([-1.0, -1.0, 1.0, 1.0]), 180),  # upside down
        (make_transform(rotation_z(np.pi / 2), [0.0, 0.0, 0.0]), 90),  # a portrait camera
    ],
)
def test_a_rolled_camera_is_refused(tmp_path: Path, turn: Array, degrees: int) -> None:
    file = photographs(tmp_path / "images_of_mine") / "transforms.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array(frame["transform_matrix"]) @ turn).tolist()
    file.write_text(json.dumps(content))
    with pytest.raises(
        WorldError, match=rf"rolled by {degrees} degrees in the median; turn pictures and poses"
    ):
        place(tmp_path).describe()


@pytest.mark.parametrize("up", ["y", "-z"])
def test_a_frame_without_z_up_is_refused(tmp_path: Path, up: str) -> None:
    file = photographs(tmp_path / "images_of_mine") / "transforms.json"
    content = json.loads(file.read_text())
    turn = {
        "y": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]],
        "-z": [[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0]],
    }[up]
    for frame in content["frames"]:
        frame["transform_matrix"] = (np.array([*turn, [0, 0, 0, 1]]) @ frame["transform_matrix"]).tolist()
    file.write_text(json.dumps(content))
    with pytest.raises(WorldError, match="expected upright photographs in a frame with z up"):
        place(tmp_path).describe()


@pytest.mark.parametrize("laps", [0.98, 1.02, 1.3, 2.0, 2.4])
def test_a_drive_of_more_than_a_lap_is_cut_to_one(laps: float) -> None:
    angle_rad = np.arange(0.0, 2.0 * np.pi * laps, 0.04)
    points = 2.0 * np.column_stack([np.cos(angle_rad), np.sin(angle_rad)])
    noise = np.random.default_rng(0).normal(0.0, 0.004, points.shape)
    path = as_path(path_along(points + noise, 0.25, True))
    assert path.length_m == pytest.approx(4.0 * np.pi, rel=0.01)
    assert np.hypot(*path.pose_at(np.linspace(0.0, path.length_m, 99))[:, :2].T) == pytest.approx(
        2.0, abs=0.02
    )


def test_a_way_that_passes_its_first_point_twice_is_not_cut() -> None:
    """Two loops one behind the other, a large and a small one, which touch where they begin."""
    angle_rad = np.arange(0.02, 2.0 * np.pi, 0.04)
    loops = [r * np.column_stack([np.sin(angle_rad), 1.0 - np.cos(angle_rad)]) for r in (2.0, 1.5)]
    path = path_along(np.concatenate(loops), 0.25, True)
    assert path.length_m == pytest.approx(7.0 * np.pi, rel=0.01)


def test_an_open_path_from_a_file(tmp_path: Path) -> None:
    photographs(tmp_path / "images_of_mine", count=12)
    file = tmp_path / "way.csv"
    angle_rad = np.linspace(0.0, 1.0, 40)
    rows = np.column_stack([3.0 * np.sin(angle_rad), 3.0 * (1.0 - np.cos(angle_rad))])  # a circle of 3 m
    file.write_text("x_m,y_m\n" + "\n".join(f"{x},{y}" for x, y in rows))
    found = place(
        tmp_path, path="way.csv", closed=False, ground_z_m=1.2, camera={"z_m": 0.2, "pitch_down_rad": 0.17}
    )
    path = as_path(found.describe().paths["track"])
    assert (
        np.abs(
            np.hypot(*(path.pose_at(np.linspace(0.0, path.length_m, 99))[:, :2] - [0.0, 3.0]).T) - 3.0
        ).max()
        < 0.01
    )
    assert path.length_m == pytest.approx(3.0, abs=0.02)
    file.write_text("x_m,y_m\n" + "\n".join(f"{x + 100.0},{y}" for x, y in rows))
    with pytest.raises(WorldError, match=r"expected a path among the photographs, .* got x = 10"):
        place(
            tmp_path,
            path="way.csv",
            closed=False,
            ground_z_m=1.2,
            camera={"z_m": 0.2, "pitch_down_rad": 0.17},
        ).describe()
    file.write_text("x_m,y_m\n0,0\n1;2\n")
    with pytest.raises(ConfigError, match=r"way\.csv:3: expected 2 fields as in the header"):
        points_of(file)
    with pytest.raises(WorldError, match="one smooth way"):
        path_along(np.zeros((4, 2)), 0.25, False)
    with pytest.raises(WorldError, match="expected at least 4 points along the path, got 2"):
        path_along(np.array([[0.0, 0.0], [1.0, 0.0]]), 0.25, False)
    to_and_fro = [[0.1 * x, 0.0] for x in [*range(20), *range(18, 5, -1), *range(7, 40)]]
    with pytest.raises(WorldError, match="turns back at x = 1"):
        path_along(np.array(to_and_fro), 0.25, False)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"images": "not_there"}, "images: expected a file or folder relative to this file, got not_there"),
        ({"path": "images_of_mine/transforms.json", "camera": {"z_m": 0}}, "camera.z_m"),
        ({"path": "images_of_mine/images/00000.png"}, "expected ground_z_m and camera.pitch_down_rad"),
        ({"car": {}}, "car.speed_mps is missing"),
        ({"off_track_m": 40}, "off_track_m: expected at most 20 m, not cm or mm, got 40"),
        ({"camera": {"z_m": 200}}, "camera.z_m: expected at most 20 m, not cm or mm, got 200"),
        (
            {"camera": {"z_m": 0.2, "pitch_down_rad": 10}},
            "camera.pitch_down_rad: expected at most 1.5708 rad, not degrees",
        ),
    ],
)
def test_what_is_missing_is_said(tmp_path: Path, changes: dict[str, object], message: str) -> None:
    photographs(tmp_path / "images_of_mine", count=12)
    with pytest.raises(AdvnerfError, match=message):
        place(tmp_path, **changes)


def test_nothing_can_be_driven_or_photographed_anew(tmp_path: Path) -> None:
    photographs(tmp_path / "images_of_mine", count=12)
    found = place(tmp_path)
    for ask in (
        lambda: found.reset(0.0, 0.0, 0.0),
        lambda: found.step(0.0, 1.0, 0.1),
        lambda: found.observe_at(0.0, 0.0, 0.0),
        lambda: found.photograph(np.eye(4)),
        lambda: found.state,
    ):
        with pytest.raises(WorldError, match="known by photographs alone"):
            ask()
    with pytest.raises(WorldError, match=r"capture\.held_out from 3 to a third of the 12"):
        found.photographs(5)


def masked(folder: Path, some: slice) -> Path:
    """A lap of photographs, some with a mask that hides their left half."""
    photographs(folder)
    (folder / "masks").mkdir()
    data = json.loads((folder / "transforms.json").read_text())
    half = np.zeros((PINHOLE.height, PINHOLE.width, 3), np.uint8)
    half[:, PINHOLE.width // 2 :] = 255
    write_image(folder / "masks" / "half.png", half)
    for frame in data["frames"][some]:
        frame["mask_path"] = "masks/half.png"
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder


def test_masked_photographs_are_learned_from_and_not_compared_with(tmp_path: Path) -> None:
    masked(tmp_path / "images_of_mine", slice(None, None, 2))
    learned, held_out = place(tmp_path).photographs(5)
    assert not any(each.valid for each in held_out)
    assert sum(each.valid is not None for each in learned) == 20
    write_posed_images(
        tmp_path / "taken", [each.T_world_from_camera for each in learned], PINHOLE,
        lambda index: learned[index].look()[0], "png", valid=[each.valid for each in learned],
    )  # fmt: skip
    taken = load_transforms(tmp_path / "taken").load()
    assert taken.valid is not None
    for index, each in enumerate(learned):
        expected = np.ones((PINHOLE.height, PINHOLE.width), bool)
        if each.valid is not None:
            expected[:, : PINHOLE.width // 2] = False
        assert np.array_equal(np.asarray(taken.valid[index]), expected)


def test_views_that_all_have_a_mask_are_told(tmp_path: Path) -> None:
    masked(tmp_path / "images_of_mine", slice(4, None))
    with pytest.raises(
        WorldError, match=r"to a third of the 4 photographs along the path, got 3; 36 more have a mask"
    ):
        place(tmp_path).photographs(3)
