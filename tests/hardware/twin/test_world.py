"""Pictures of the room against geometry: pixels where the pinhole puts them, depths where planes are."""

import contextlib
import math

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import Pinhole, invert_transform, look_at, planar_pose, transform_points
from hardware.worlds.lab import gl, lighting
from hardware.worlds.lab.config import CameraConfig, LabConfig
from hardware.worlds.lab.furniture import Solid, furnish, obstacles
from hardware.worlds.lab.lab import Lab
from hardware.worlds.lab.phone import track_length, track_pose
from hardware.worlds.lab.renderer import Renderer
from hardware.worlds.lab.surfaces import paint_room

CONFIG = LabConfig()
POSES = [(0.4, -2.0, 0.0), (1.2, -1.8, 0.15), (0.8, -2.3, 0.2)]


@pytest.fixture(scope="module")
def lab():
    with Lab(CONFIG) as lab:
        yield lab


def chess(squares=8, pixels=64):
    tiles = np.indices((squares, squares)).sum(axis=0) % 2 * 255
    return np.repeat(tiles.repeat(pixels, 0).repeat(pixels, 1)[..., None], 3, axis=2).astype(np.uint8)


def chess_corners_on_face(panel, squares=8):
    """Inner corners in the panel's frame, row by row as a viewer reads them."""
    inner = np.arange(1, squares) / squares - 0.5
    y, z = np.meshgrid(inner * panel.width_m, -inner * panel.height_m)
    return np.stack([np.zeros_like(y), y, z], axis=-1).reshape(-1, 3)


def detect_corners(image, expected):
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    # Pixel centres at +0.5 in ours, at 0 in OpenCV's.
    found = (expected - 0.5).astype(np.float32).reshape(-1, 1, 2).copy()
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-4)
    cv2.cornerSubPix(gray, found, (3, 3), (-1, -1), criteria)
    return found.reshape(-1, 2) + 0.5


@pytest.mark.parametrize("pose", POSES)
def test_driving_camera_sees_the_board_where_the_pinhole_projects_it(lab, pose):
    lab.set_board_image(chess())
    image, _ = lab.observe_at(*pose, depth=False)
    T_camera_from_world = invert_transform(planar_pose(*pose) @ CONFIG.camera.T_car_from_camera)
    points = transform_points(CONFIG.board.T_world_from_face, chess_corners_on_face(CONFIG.board))
    expected = CONFIG.camera.pinhole.project(transform_points(T_camera_from_world, points))
    in_view = (expected > 5).all(axis=1) & (expected < [331, 183]).all(axis=1)
    assert in_view.sum() >= 20
    error = np.linalg.norm(detect_corners(image, expected[in_view]) - expected[in_view], axis=1)
    lab.set_board_image(None)
    assert error.mean() < 0.15
    assert error.max() < 0.5


def test_phone_sees_the_monitor_where_the_pinhole_projects_it(lab):
    lab.show("monitor", chess())
    T = look_at([1.4, 2.0, 0.9], [1.75, 3.15, 0.4])
    image = lab.photograph(T)
    points = transform_points(CONFIG.monitor.T_world_from_face, chess_corners_on_face(CONFIG.monitor))
    expected = lab.photo_pinhole.project(transform_points(invert_transform(T), points))
    error = np.linalg.norm(detect_corners(image, expected) - expected, axis=1)
    lab.show("monitor", None)
    assert error.mean() < 0.15
    assert error.max() < 0.5


def test_off_centre_intrinsics_are_honoured(lab):
    """A crop's intrinsics draw the crop of the image."""
    T = planar_pose(*POSES[0]) @ CONFIG.camera.T_car_from_camera
    whole = lab._renderer.render_rgb(T, CONFIG.camera.pinhole)
    part = lab._renderer.render_rgb(T, CONFIG.camera.pinhole.cropped(40, 30, 200, 100))
    difference = np.abs(whole[30:130, 40:240].astype(int) - part.astype(int))
    assert difference.mean() < 0.5


@pytest.mark.parametrize("pose", POSES)
def test_depth_of_the_floor_is_that_of_a_plane(lab, pose):
    _, depth = lab.observe_at(*pose)
    camera, pinhole = CONFIG.camera, CONFIG.camera.pinhole
    T = planar_pose(*pose) @ camera.T_car_from_camera
    rays = pinhole.directions() @ T[:3, :3].T
    downward = np.minimum(rays[..., 2], -1e-9)
    floor = -camera.z_m / downward
    points = T[:3, 3] + floor[..., None] * rays
    # The open floor between the car and the board, tape included (1 mm thick).
    open_floor = (rays[..., 2] < 0) & (points[..., 0] < 2.6) & (np.abs(points[..., 1] + 2.0) < 0.8)
    assert open_floor.sum() > 5000
    relative = np.abs(depth - floor)[open_floor] / floor[open_floor]
    assert relative.max() < 0.007  # the tape is 1 mm of 200 mm higher
    assert np.median(relative) < 1e-4


def test_depth_of_the_board_is_that_of_its_face(lab):
    pose = POSES[0]
    _, depth = lab.observe_at(*pose)
    T_camera_from_face = (
        invert_transform(planar_pose(*pose) @ CONFIG.camera.T_car_from_camera)
        @ CONFIG.board.T_world_from_face
    )
    grid = np.linspace(-0.3, 0.3, 7)
    points = transform_points(T_camera_from_face, [[0.0, y, z] for y in grid for z in grid])
    pixels = np.floor(CONFIG.camera.pinhole.project(points)).astype(int)
    normal, origin = T_camera_from_face[:3, 0], T_camera_from_face[:3, 3]
    rays = CONFIG.camera.pinhole.directions()[pixels[:, 1], pixels[:, 0]]
    expected = (origin @ normal) / (rays @ normal)
    np.testing.assert_allclose(depth[pixels[:, 1], pixels[:, 0]], expected, rtol=1e-4)


def test_walls_are_where_they_should_be(lab):
    """Four views from the middle above the furniture: the wall is 4 m ahead, and its colour is its own."""
    pinhole = Pinhole(32, 16, 200.0, 200.0, 16.0, 8.0)
    colours = []
    for target in ([4, 0, 2.3], [0, 4, 2.3], [-4, 0, 2.3], [0, -4, 2.3]):
        T = look_at([0.0, 0.0, target[2]], target)
        np.testing.assert_allclose(lab._renderer.render_depth(T, pinhole), 4.0, rtol=1e-5)
        colours.append(lab._renderer.render_rgb(T, pinhole).reshape(-1, 3).mean(axis=0))
    for i in range(4):
        for j in range(i):
            assert np.abs(colours[i] - colours[j]).max() > 15


def test_panel_pictures_have_row_0_on_top_and_column_0_on_the_viewers_left(lab):
    red, green, blue, white = (250, 0, 0), (0, 250, 0), (0, 0, 250), (250, 250, 250)
    picture = np.array([[red, green], [blue, white]], dtype=np.uint8).repeat(32, 0).repeat(32, 1)
    lab.set_board_image(picture)
    image, _ = lab.observe_at(0.4, -2.0, 0.0, depth=False)
    lab.set_board_image(None)
    T = invert_transform(planar_pose(0.4, -2.0, 0.0) @ CONFIG.camera.T_car_from_camera)
    for (y, z), colour in zip(
        [(-0.2, 0.2), (0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)], (red, green, blue, white), strict=True
    ):
        point = transform_points(T @ CONFIG.board.T_world_from_face, [0.0, y, z])
        column, row = np.floor(CONFIG.camera.pinhole.project(point)).astype(int)
        # Left on the board is -y seen from the front, hence the smaller column.
        np.testing.assert_allclose(image[row, column], colour, atol=12)


def test_plain_board_comes_back(lab):
    before, _ = lab.observe_at(*POSES[0], depth=False)
    lab.set_board_image(chess())
    lab.set_board_image(None)
    after, _ = lab.observe_at(*POSES[0], depth=False)
    np.testing.assert_array_equal(before, after)
    with pytest.raises(ValueError, match="uint8"):
        lab.set_board_image(np.zeros((4, 4, 3)))


def test_tape_lies_on_the_path_and_is_as_wide_as_configured(lab):
    """In rows near the car, the green pixels' middle and width are those of the line's projection."""
    pose = (-0.6, -2.03, 0.02)
    image, _ = lab.observe_at(*pose, depth=False)
    rgb = image.astype(int)
    green = (rgb[..., 1] - np.maximum(rgb[..., 0], rgb[..., 2])).clip(0) / 150.0
    T = invert_transform(planar_pose(*pose) @ CONFIG.camera.T_car_from_camera)
    for ahead in (0.8, 1.0, 1.2):
        edges = [
            CONFIG.camera.pinhole.project(transform_points(T, [pose[0] + ahead, -2.0 + dy, 0.001]))
            for dy in (0.025, -0.025)
        ]
        row = int(edges[0][1])
        weight = green[row]
        centre = ((np.arange(336) + 0.5) * weight).sum() / weight.sum()
        assert centre == pytest.approx(0.5 * (edges[0][0] + edges[1][0]), abs=0.5)
        assert weight.sum() == pytest.approx(edges[1][0] - edges[0][0], rel=0.2)


def test_nothing_stands_in_the_lane():
    clear = 0.4 + 0.6  # half a lane and the margin
    for s in np.arange(0.0, track_length(CONFIG.track), 0.05):
        x, y, _ = track_pose(CONFIG.track, float(s))
        for obstacle in obstacles(CONFIG):
            c, n = math.cos(obstacle.yaw_rad), math.sin(obstacle.yaw_rad)
            dx, dy = x - obstacle.x_m, y - obstacle.y_m
            outside = (
                max(abs(c * dx + n * dy) - obstacle.half_length_m, 0.0),
                max(abs(c * dy - n * dx) - obstacle.half_width_m, 0.0),
            )
            assert math.hypot(*outside) >= clear - 0.15, (
                f"obstacle at ({obstacle.x_m:.2f}, {obstacle.y_m:.2f})"
            )


def test_a_closed_lab_names_what_the_car_stands_against():
    board = CONFIG.board
    lab, ahead = Lab(CONFIG), 0.5 * (CONFIG.car.wheelbase_m + CONFIG.car.body_length_m) + 0.01
    # With its nose at the middle of the board's face, which looks along its yaw.
    x = board.x_m + ahead * math.cos(board.yaw_rad)
    y = board.y_m + ahead * math.sin(board.yaw_rad)
    assert lab.touches(x, y, board.yaw_rad + math.pi) == "board"
    assert lab.touches(*CONFIG.start_pose) == ""
    assert all(obstacle.name for obstacle in obstacles(CONFIG))


def test_furniture_stays_in_the_room():
    for solid in furnish(CONFIG):
        assert all(max(abs(x), abs(y)) < 4.0 + 1e-6 for x, y in solid.footprint.corners()), solid
        assert solid.centre_m[2] - solid.half_m[2] >= -1e-9
        assert solid.centre_m[2] + solid.half_m[2] <= CONFIG.room.height_m


def test_a_room_is_painted_once_whatever_its_cameras_are():
    painted = paint_room(LabConfig())
    assert paint_room(LabConfig(camera=CameraConfig(width=168, height=94))) is painted
    other = paint_room(LabConfig(shadows=False))[0]["floor"].image
    assert other.mean() > painted[0]["floor"].image.mean()
    moved = paint_room(LabConfig.model_validate({"board": {"x_m": 2.0}}))[0]["floor"].image
    assert not np.array_equal(moved, painted[0]["floor"].image)  # the stand's shadow moves too


def test_a_renderer_keeps_no_map_of_shadows_that_it_does_not_draw():
    model = gl.load_mujoco().MjSpec().compile()
    assert model.vis.quality.shadowsize > 0
    with contextlib.closing(Renderer(model, 1)):
        assert model.vis.quality.shadowsize == 0


def test_light_without_occluders_is_the_lambert_sum():
    lamp, point = np.array([[0.3, -0.2, 2.0]]), np.array([[0.0, 0.0, -0.01]])
    ray = lamp[0] - [0.0, 0.0, 0.0]  # irradiance lifts the point by 1 cm along the normal
    r = np.linalg.norm(ray)
    expected = lighting.AMBIENT + lighting.LAMP_POWER * (ray[2] / r) ** 2 / r**2
    up = np.array([0.0, 0.0, 1.0])
    assert lighting.irradiance(point, up, lamp, [])[0] == pytest.approx(expected, rel=1e-5)


def test_a_box_casts_a_shadow_exactly_where_it_hides_the_lamp():
    lamp = np.array([[0.0, 0.0, 2.0]])
    box = Solid("box", (0.5, 0.0, 1.0), (0.1, 0.1, 0.0005), (1.0, 1.0, 1.0), yaw_rad=0.0)
    # By similar triangles the shadow spans x = 0.8 .. 1.2 on the floor.
    points = np.array([[x, 0.0, 0.0] for x in (0.7, 0.77, 0.83, 1.0, 1.17, 1.23)])
    light = lighting.irradiance(points, np.array([0.0, 0.0, 1.0]), lamp, [box])
    np.testing.assert_array_equal(light < lighting.AMBIENT + 1e-6, [False, False, True, True, True, False])


def test_missing_egl_names_the_packages(monkeypatch):
    class Broken:
        @staticmethod
        def GLContext(width, height):
            raise AttributeError("'NoneType' object has no attribute 'eglQueryString'")

    monkeypatch.setattr(gl.importlib, "import_module", lambda name: Broken)
    with pytest.raises(
        gl.TwinUnavailable, match=r"libegl1 libgl1-mesa-dri libegl-mesa0 libopengl0.*MUJOCO_GL=egl"
    ):
        gl.create_context(8, 8)


def test_missing_mujoco_names_the_extra(monkeypatch):
    def refuse(name):
        raise ModuleNotFoundError("No module named 'mujoco'", name="mujoco")

    monkeypatch.setattr(gl.importlib, "import_module", refuse)
    with pytest.raises(gl.TwinUnavailable, match=r"pip install 'advnerf\[twin\]'"):
        gl.load_mujoco()
