"""Poses that are not those of their photographs are known by matched features; the photographs are drawn here by homographies of two walls."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.data.epipolar import require_agreeing_poses
from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.transforms import load_transforms
from advnerf_core.geometry import Array, Pinhole, invert_transform

FOX = Path(__file__).parents[4] / "shared/data/fox"
PINHOLE = Pinhole(200, 150, 170.0, 170.0, 100.0, 75.0)
OTHER_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
# Depth [m], middle [m], and width and height [m] of two walls that face the cameras, the far one first.
WALLS = ((6.0, (0.0, 0.0), (14.0, 10.0)), (3.0, (-0.6, 0.3), (1.8, 1.6)))


def poses(count: int = 14) -> Array:
    """``T_world_from_camera [N, 4, 4]`` along an arc that looks at the walls; no two steps are alike."""
    made = []
    for index, share in enumerate(np.linspace(-1.0, 1.0, count)):
        turn, nod = 0.25 * share + 0.03 * np.sin(9.0 * index), 0.12 * np.cos(2.3 * index)
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(np.array([nod, -turn, 0.0]))[0]
        T[:3, 3] = 1.2 * share, 0.25 * np.sin(2.0 * index), 0.4 * np.cos(1.7 * index)
        made.append(T)
    return np.stack(made)


def photograph(T_world_from_camera: Array, seed: int | None = 0) -> np.ndarray:
    """A picture of the walls, textured by smooth noise; ``seed`` None: without a texture."""
    size = (PINHOLE.width, PINHOLE.height)
    picture = np.full((*size[::-1], 3), 128, np.uint8)
    for depth_m, middle_m, side_m in WALLS:
        texture = np.full((160, 160, 3), 128, np.uint8)
        if seed is not None:
            noise = np.random.default_rng(seed + int(depth_m)).uniform(0, 255, (40, 40, 3))
            texture = cv2.resize(noise, (160, 160), interpolation=cv2.INTER_CUBIC).clip(0, 255)
        corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * side_m + middle_m
        world = np.column_stack([corners, np.full(4, depth_m), np.ones(4)])
        local = world @ invert_transform(T_world_from_camera).T
        pixels = (PINHOLE.project(local[:, :3]) - 0.5).astype(np.float32)
        sides = np.array([[0, 0], [160, 0], [160, 160], [0, 160]], np.float32) - np.float32(0.5)
        H = cv2.getPerspectiveTransform(sides, pixels)
        shown = cv2.warpPerspective(np.full((160, 160), 255, np.uint8), H, size) > 127
        picture[shown] = cv2.warpPerspective(texture.astype(np.uint8), H, size)[shown]
    return picture


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("walls")
    made = [folder / f"{index:02d}.png" for index in range(len(poses()))]
    for file, pose in zip(made, poses(), strict=True):
        cv2.imwrite(str(file), photograph(pose))
    return made


def frames(files: list[Path], given: Array) -> list[PosedImage]:
    return [PosedImage(file, PINHOLE, Lens(), pose) for file, pose in zip(files, given, strict=True)]


def test_poses_of_their_photographs_pass(files: list[Path]) -> None:
    require_agreeing_poses(frames(files, poses()), "walls")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = cv2.Rodrigues(np.array([0.3, 1.0, -0.4]))[0], [5.0, -3.0, 100.0]
    require_agreeing_poses(frames(files, T @ poses()), "walls")  # in any world


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (
            poses() @ OTHER_AXES,
            r"with each pose multiplied by diag\(1, -1, -1, 1\) from the right: its camera axes",
        ),
        (invert_transform(poses()), "with each pose inverted: it leads"),
        (invert_transform(poses() @ OTHER_AXES), "with each pose inverted and multiplied"),
        (np.roll(poses(), 1, axis=0), "one row late"),
        (np.roll(poses(), -1, axis=0), "one row early"),
    ],
)
def test_a_usual_mistake_is_named_with_its_mend(files: list[Path], given: Array, found: str) -> None:
    with pytest.raises(
        DatasetError, match=f"expected poses of walls that fit its photographs, got .*{found}"
    ):
        require_agreeing_poses(frames(files, given), "walls")


def test_what_no_usual_mistake_explains_passes(files: list[Path]) -> None:
    """A training then says that it learns nothing: its message has more causes."""
    order = np.random.default_rng(2).permutation(len(files))
    require_agreeing_poses(frames(files, poses()[order]), "walls")


def test_photographs_without_features_pass(tmp_path: Path) -> None:
    blank = [tmp_path / f"{index}.png" for index in range(6)]
    for file, pose in zip(blank, poses(6), strict=True):
        cv2.imwrite(str(file), photograph(pose, seed=None))
    require_agreeing_poses(frames(blank, poses(6) @ OTHER_AXES), "walls")
    require_agreeing_poses(frames(blank[:1], poses(1)), "walls")


@pytest.mark.skipif(not FOX.exists(), reason="the shared photographs are not here")
def test_photographs_by_hand_pass_and_their_inverses_do_not() -> None:
    listed = load_transforms(FOX).sorted_by_name()
    require_agreeing_poses(listed.frames, "fox")
    given = invert_transform(np.stack([each.T_world_from_camera for each in listed.frames]))
    wrong = [
        PosedImage(each.path, each.pinhole, each.lens, pose)
        for each, pose in zip(listed.frames, given, strict=True)
    ]
    with pytest.raises(DatasetError, match="with each pose inverted: it leads from the world to the camera"):
        require_agreeing_poses(wrong, "fox")
