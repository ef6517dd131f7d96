import time

import cv2
import numpy as np
import pytest
import torch

from advnerf_core.attack.artifact import face_texture
from advnerf_core.attack.projection import FaceOverlay, clip_near, faces_camera
from advnerf_core.fields.voxel_grid import cube_face_object, face_corners_in_object
from advnerf_core.geometry import (
    Pinhole,
    camera_mount,
    invert_transform,
    look_at,
    make_transform,
    planar_pose,
    rotation_z,
    transform_points,
)
from advnerf_core.scene.surrogate import Surrogate

CAMERA = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
MOUNT = camera_mount(0.30, 0.0, 0.20, np.deg2rad(10))
T_WORLD_FROM_FACE = make_transform(rotation_z(np.deg2rad(172)), [3.14, -1.75, 0.42])
CORNERS = face_corners_in_object(0.8)
GREY = np.full((188, 336, 3), 90, np.uint8)


def theta(seed=0):
    return torch.randn(16, 16, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 1.5


@pytest.mark.parametrize(
    "pose", [(-1.1, -2.0, 0.0), (0.9, -1.9, 0.1), (2.2, -1.6, -0.15), (2.62, -1.6, 0.3), (1.8, -3.2, 0.9)]
)
def test_the_overlay_equals_the_surrogate_at_the_same_pose(pose):
    def background(poses, pinhole):
        shape = (len(poses), pinhole.height, pinhole.width)
        return torch.full((*shape, 3), 90 / 255, dtype=torch.float64), torch.full(shape, 20.0)

    field = cube_face_object(0.8, 16, T_world_from_object=T_WORLD_FROM_FACE)
    surrogate = Surrogate(background, CAMERA, MOUNT, field, supersample=4, dtype=torch.float64)
    T_world_from_camera = planar_pose(*pose) @ MOUNT
    rendered = surrogate.render(T_world_from_camera[None], theta()).images[0].permute(1, 2, 0).numpy() * 255
    overlay = FaceOverlay(face_texture(theta()), CORNERS, CAMERA, supersample=4)
    image, drawn = overlay.draw(GREY, invert_transform(T_world_from_camera) @ T_WORLD_FROM_FACE)
    touched = (rendered != 90).any(axis=-1)
    assert drawn == bool(touched.any())
    difference = np.abs(image - rendered)
    assert difference[touched].mean() < 1.0
    assert np.quantile(difference[touched], 0.999) < 6.0
    assert np.array_equal(image[~touched], GREY[~touched])


def test_corners_land_where_they_are_projected_by_hand():
    # A face straight ahead: 2 m in front of the camera, edge 0.8 m, f = 173.97 px: half an edge is 34.794 px.
    T_camera_from_face = make_transform([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], [0.0, 0.0, 2.0])
    white = FaceOverlay(np.full((8, 8, 3), 255, np.uint8), CORNERS, CAMERA, supersample=8)
    image, drawn = white.draw(np.zeros_like(GREY), T_camera_from_face)
    assert drawn
    # Area covered along the middle row and column, in pixels.
    np.testing.assert_allclose(image[94, :, 0].sum() / 255, 2 * 34.794, atol=0.1)
    np.testing.assert_allclose(image[:, 168, 0].sum() / 255, 2 * 34.794, atol=0.1)
    columns = np.flatnonzero(image[94, :, 0])
    assert (columns[0], columns[-1]) == (int(168 - 34.794), int(168 + 34.794))


def test_rows_go_down_and_columns_go_right_for_the_viewer():
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32, 0] = 255  # top left is red
    texture[:32, 32:, 1] = 255  # top right is green
    T_world_from_camera = look_at([2.0, 0.0, 0.0], [0, 0, 0])
    image, _ = FaceOverlay(texture, CORNERS, CAMERA).draw(
        np.zeros_like(GREY), invert_transform(T_world_from_camera)
    )
    red, green = (np.argwhere(image[..., k] > 200).mean(axis=0) for k in (0, 1))
    assert red[0] < 94
    assert green[0] < 94
    assert red[1] < 168 < green[1]


def test_turned_away_behind_and_out_of_view_leave_the_image_alone():
    overlay = FaceOverlay(face_texture(theta()), CORNERS, CAMERA)
    for camera, back in (
        (look_at([-2.0, 0, 0.1], [0, 0, 0]), True),
        (look_at([-2.0, 0, 0.1], [-2, 3, 0]), False),
        (look_at([-2.0, 0, 0.1], [-4, 0, 0]), False),
        (look_at([2.0, 0, 0.1], [4, 0, 0]), False),
        (look_at([2.0, 0, 0.1], [2, 3, 0]), False),
        (look_at([0.0, 2.0, 0.0], [0, 0, 0]), False),  # edge-on
    ):
        image, drawn = overlay.draw(GREY, invert_transform(camera))
        assert not drawn
        assert image is GREY
        assert overlay.shows_back(GREY, invert_transform(camera)) is back
    assert not overlay.shows_back(GREY, invert_transform(look_at([2.0, 0, 0.1], [0, 0, 0])))


def test_a_face_through_the_camera_plane_is_clipped():
    # The camera stands between the face's ends, 0.1 m in front of it, and looks along it.
    T_world_from_camera = look_at([0.1, -0.1, 0.0], [0.0, 1.0, 0.0])
    corners = transform_points(invert_transform(T_world_from_camera), CORNERS)
    assert (corners[:, 2] < 0).any()
    assert (corners[:, 2] > 0).any()
    image, drawn = FaceOverlay(np.full((8, 8, 3), 255, np.uint8), CORNERS, CAMERA).draw(
        np.zeros_like(GREY), invert_transform(T_world_from_camera)
    )
    assert drawn
    rays = CAMERA.directions().reshape(-1, 3) @ T_world_from_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = -0.1 / rays[:, 0]
        hit = T_world_from_camera[:3, 3] + depth[:, None] * rays
    inside = (depth > 0.02) & (np.abs(hit[:, 1]) < 0.4) & (np.abs(hit[:, 2]) < 0.4)
    assert np.mean((image[..., 0].ravel() > 127) != inside) < 0.005


def test_clipping_a_square_that_is_half_behind():
    square = np.array([[-1, -1, -1], [1, -1, -1], [1, -1, 3], [-1, -1, 3]], float)
    clipped = clip_near(square, 1.0)
    np.testing.assert_allclose(clipped, [[1, -1, 1], [1, -1, 3], [-1, -1, 3], [-1, -1, 1]])
    assert clip_near(square, 5.0).shape == (0, 3)
    assert faces_camera(square[::-1]) != faces_camera(square)


def test_distortion_moves_the_face_as_opencv_projects_it():
    distortion = (-0.2, 0.05, 0.001, -0.001)
    T_camera_from_face = make_transform([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], [0.7, 0.2, 1.6])
    overlay = FaceOverlay(np.full((8, 8, 3), 255, np.uint8), CORNERS, CAMERA, distortion, supersample=4)
    image, _ = overlay.draw(np.zeros_like(GREY), T_camera_from_face)
    edge = np.concatenate(
        [np.linspace(a, b, 50) for a, b in zip(CORNERS, np.roll(CORNERS, -1, 0), strict=True)]
    )
    in_camera = transform_points(T_camera_from_face, edge)
    outline, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), CAMERA.matrix, np.array(distortion))
    expected = np.zeros((188 * 8, 336 * 8), np.uint8)
    cv2.fillPoly(expected, [np.round(outline.reshape(-1, 2) * 8).astype(np.int32)], 255)
    expected = cv2.resize(expected, (336, 188), interpolation=cv2.INTER_AREA)
    assert np.abs(image[..., 0].astype(float) - expected).mean() < 0.5


@pytest.mark.parametrize("angle_deg", [40, 54, 65, 80])
def test_a_face_at_the_edge_of_a_wide_lens_is_drawn_where_opencv_projects_it(angle_deg):
    """At 80 degrees it is outside the picture, where too few steps of undistortion had drawn a ghost of it."""
    distortion, camera = (-0.3, 0.09, 0.0, 0.0, 0.0), Pinhole(320, 240, 100.0, 100.0, 160.0, 120.0)
    away = np.array([np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])
    up = np.array([0.0, -1.0, 0.0])
    T = make_transform(np.stack([-away, np.cross(up, -away), up], axis=1), 1.2 * away)
    corners = np.array([[0, -0.15, 0.15], [0, 0.15, 0.15], [0, 0.15, -0.15], [0, -0.15, -0.15]])
    overlay = FaceOverlay(np.full((8, 8, 3), 255, np.uint8), corners, camera, distortion, 2)
    drawn, _ = overlay.draw(np.zeros((240, 320, 3), np.uint8), T)
    t = np.linspace(0.0, 1.0, 40)[:, None]
    edge = np.concatenate(
        [a + t * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
    )
    outline, _ = cv2.projectPoints(
        transform_points(T, edge), np.zeros(3), np.zeros(3), camera.matrix, np.array(distortion)
    )
    expected = np.zeros((240 * 8, 320 * 8), np.uint8)
    cv2.fillPoly(expected, [np.round(outline.reshape(-1, 2) * 8).astype(np.int32)], 255)
    expected = cv2.resize(expected, (320, 240), interpolation=cv2.INTER_AREA)
    assert (angle_deg == 80) == (not expected.any())
    assert np.abs(drawn[..., 0].astype(float) - expected).mean() < 0.3


def test_a_fine_pattern_far_away_is_averaged_not_aliased():
    checker = (np.indices((512, 512)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=2)
    T_camera_from_face = make_transform([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], [0.0, 0.0, 5.0])
    image, _ = FaceOverlay(checker, CORNERS, CAMERA).draw(GREY, T_camera_from_face)
    inner = image[84:104, 158:178]
    assert np.abs(inner.astype(float) - 127.5).max() < 12


@pytest.mark.timing
def test_it_is_fast_enough_for_the_live_path():
    overlay = FaceOverlay(face_texture(theta()), CORNERS, CAMERA)
    T = invert_transform(planar_pose(1.8, -1.9, 0.0) @ MOUNT) @ T_WORLD_FROM_FACE
    overlay.draw(GREY, T)
    times = []
    for _ in range(30):
        start = time.perf_counter()
        overlay.draw(GREY, T)
        times.append(time.perf_counter() - start)
    print(f"median {1e3 * np.median(times):.2f} ms")
    assert np.quantile(times, 0.1) < 3e-3


def test_wrong_inputs_are_refused():
    with pytest.raises(ValueError, match="corners of a rectangle"):
        FaceOverlay(face_texture(theta()), CORNERS[[0, 2, 1, 3]], CAMERA)
    with pytest.raises(ValueError, match="expected an image"):
        FaceOverlay(face_texture(theta()), CORNERS, CAMERA).draw(np.zeros((10, 10, 3), np.uint8), np.eye(4))
