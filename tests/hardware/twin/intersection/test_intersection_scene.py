"""Pictures of the intersection against geometry, and what every world promises."""

import json
import math

import numpy as np
import pytest

from advnerf_core.geometry import invert_transform, planar_pose, transform_points
from hardware.worlds.junction import pictures
from hardware.worlds.junction.car import DubinsCar
from hardware.worlds.junction.config import DubinsConfig, RoadConfig
from hardware.worlds.junction.ground import PAINT_M
from hardware.worlds.junction.photos import DRIVEN_M, photo_poses
from hardware.worlds.junction.scene import Intersection
from hardware.worlds.junction.town import HOUSES, TREES
from hardware.worlds.world import NotOpenError, World, WorldDescription

APPROACH = (-24.0, -1.75, 0.0)
FROM_SOUTH = (1.75, -24.0, 0.5 * math.pi)


def world_rays(scene, pose):
    """Camera position [3] and directions [H, W, 3] of unit planar depth in the world."""
    T = planar_pose(*pose) @ scene.T_car_from_camera
    return T[:3, 3], scene.camera_pinhole.directions() @ T[:3, :3].T


def pixel(scene, pose, point):
    T = planar_pose(*pose) @ scene.T_car_from_camera
    u, v = scene.camera_pinhole.project(transform_points(invert_transform(T), np.asarray(point)))
    return int(v), int(u)


def test_it_is_a_world(intersection):
    assert isinstance(intersection, World)


def test_observation_has_the_documented_form(intersection):
    intersection.reset(*APPROACH)
    rgb, depth = intersection.observe()
    assert (rgb.shape, rgb.dtype) == ((188, 336, 3), np.uint8)
    assert (depth.shape, depth.dtype) == ((188, 336), np.float32)
    assert intersection.observe(depth=False)[1] is None
    photo = intersection.photograph(planar_pose(*APPROACH) @ intersection.T_car_from_camera)
    assert photo.shape == (360, 640, 3)


def test_depth_of_the_road_is_that_of_its_plane(intersection):
    eye, rays = world_rays(intersection, APPROACH)
    depth = intersection.observe_at(*APPROACH)[1]
    expected = eye[2] / np.maximum(-rays[..., 2], 1e-9)
    hit = eye + expected[..., None] * rays
    # Bare lane: left of the right-hand kerb, right of the centre line, before the zebra, beside the arrow.
    bare = (
        (hit[..., 1] > -3.3)
        & (hit[..., 1] < -0.3)
        & (hit[..., 0] < -13.5)
        & (np.abs(hit[..., 1] + 1.75) > 0.6)
    )
    assert bare.sum() > 4000
    np.testing.assert_allclose(depth[bare], expected[bare], rtol=2e-4)


def test_depth_of_a_facade_is_that_of_its_plane(intersection):
    house = HOUSES[5]
    pose = (house.x[0] + 3.0, -2.0, 0.5 * math.pi)
    eye, rays = world_rays(intersection, pose)
    depth = intersection.observe_at(*pose)[1]
    expected = (house.y[0] - eye[1]) / np.maximum(rays[..., 1], 1e-9)
    hit = eye + expected[..., None] * rays
    on_it = (
        (hit[..., 0] > house.x[0] + 0.3)
        & (hit[..., 0] < house.x[0] + 6.0)
        & (hit[..., 2] > 1.6)
        & (hit[..., 2] < 8.0)
    )
    assert on_it.sum() > 4000
    np.testing.assert_allclose(depth[on_it], expected[on_it], rtol=2e-4)


def test_depth_of_the_pavement_is_a_kerb_nearer(intersection):
    eye, rays = world_rays(intersection, APPROACH)
    depth = intersection.observe_at(*APPROACH)[1]
    expected = (eye[2] - 0.12) / np.maximum(-rays[..., 2], 1e-9)
    hit = eye + expected[..., None] * rays
    pavement = (hit[..., 1] < -4.0) & (hit[..., 1] > -6.0) & (hit[..., 0] > -21.0) & (hit[..., 0] < -13.0)
    assert pavement.sum() > 300
    np.testing.assert_allclose(np.median(depth[pavement] / expected[pavement]), 1.0, rtol=2e-4)


def test_the_world_encloses_every_view(intersection):
    rng = np.random.default_rng(0)
    for x, y, _ in [
        path.pose_at(float(s)) for path in intersection.config.paths().values() for s in (0, 20, 50)
    ]:
        depth = intersection.observe_at(x, y, float(rng.uniform(-math.pi, math.pi)))[1]
        assert np.isfinite(depth).all()
        assert depth.min() > 1.0
        assert depth.max() < 130.0


def test_markings_are_where_the_plan_has_them(intersection):
    stop_line, lane = (1.0, -13.9, PAINT_M), (1.0, -15.5, 0.0)
    rgb = intersection.observe_at(*FROM_SOUTH, depth=False)[0].astype(float)
    assert rgb[pixel(intersection, FROM_SOUTH, stop_line)].mean() > 200.0
    assert rgb[pixel(intersection, FROM_SOUTH, lane)].mean() < 120.0


def test_colours_do_not_depend_on_where_one_looks_from(intersection):
    points = [(-10.0, 9.6, 3.2), (-6.0, -0.8, 0.0), (-6.5, 9.6, 5.75), (-3.0, 0.6, 0.0), (1.0, 8.8, 5.9)]
    views = [(-12.0, -6.0, 1.5), (-4.0, -7.0, 1.7), (-8.0, -8.0, 1.2)]
    for point in points:
        seen = []
        for view in views:
            row, column = pixel(intersection, view, point)
            if not (1 <= row < 187 and 1 <= column < 335):
                continue
            rgb, depth = intersection.observe_at(*view)
            eye, rays = world_rays(intersection, view)
            if np.linalg.norm(eye + depth[row, column] * rays[row, column] - point) < 0.4:
                seen.append(rgb[row - 1 : row + 2, column - 1 : column + 2].reshape(-1, 3).mean(axis=0))
        assert len(seen) >= 2, point
        assert np.ptp(seen, axis=0).max() < 12.0, point


def test_two_scenes_of_one_configuration_agree_to_the_byte(intersection):
    intersection.reset(*APPROACH)
    with Intersection(intersection.config) as other:
        other.reset(*APPROACH)
        for _ in range(3):
            assert intersection.step(0.4, 6.0, 0.1) == other.step(0.4, 6.0, 0.1)
            for mine, theirs in zip(intersection.observe(), other.observe(), strict=True):
                assert mine.tobytes() == theirs.tobytes()
    other.close()  # a second time
    with pytest.raises(RuntimeError, match="closed"):
        other.observe()


def test_the_seed_decides_what_is_painted():
    painted = [
        pictures.asphalt(RoadConfig(), np.random.default_rng(seed), pixels_per_m=2.0) for seed in (1, 1, 2)
    ]
    np.testing.assert_array_equal(painted[0], painted[1])
    assert np.abs(painted[0] - painted[2]).max() > 0.05


def test_observe_at_equals_driving_there(intersection):
    intersection.reset(*FROM_SOUTH)
    state = intersection.step(0.2, 6.0, 0.5)
    there = intersection.observe(depth=False)[0]
    intersection.reset(*APPROACH)
    elsewhere = intersection.observe_at(state.x_m, state.y_m, state.yaw_rad, depth=False)[0]
    np.testing.assert_array_equal(there, elsewhere)
    assert intersection.state.x_m == APPROACH[0]


def test_a_house_and_the_end_of_the_world_stop_the_car(intersection):
    car = intersection.config.car
    reach = car.body_ahead_m + 0.5 * car.body_length_m
    intersection.reset(1.75, -2.0, 0.5 * math.pi)
    state = intersection.step(0.0, 6.0, 5.0)
    assert intersection.blocked
    assert HOUSES[5].y[0] - 0.05 < state.y_m + reach <= HOUSES[5].y[0]
    assert intersection.touches(state.x_m, state.y_m, state.yaw_rad) == "house"
    intersection.reset(40.0, -1.75, 0.0)
    state = intersection.step(0.0, 6.0, 10.0)
    assert intersection.blocked
    assert intersection.config.road.half_m - 0.05 < state.x_m + reach <= intersection.config.road.half_m
    assert intersection.touches(state.x_m, state.y_m, state.yaw_rad) == "end of the world"
    assert not intersection.reset(*APPROACH).speed_mps
    assert not intersection.blocked


def test_an_ideal_car_follows_every_path_in_its_lane(intersection):
    for path in intersection.config.paths().values():
        car = DubinsCar(DubinsConfig.ideal(), intersection.fits)
        car.reset(*path.start_pose)
        for s in np.arange(0.0, 36.0, 0.6).tolist():
            turn = math.remainder(path.pose_at(s + 0.6)[2] - path.pose_at(s)[2], 2.0 * math.pi)
            state = car.advance(turn / 0.1, 6.0, 0.1)
            assert math.dist((state.x_m, state.y_m), path.pose_at(s + 0.6)[:2]) < 0.15
            assert not car.blocked


def test_photos_cover_the_drives_and_are_taken_from_free_places(intersection):
    config = intersection.config
    poses = photo_poses(config, 240, np.random.default_rng(3))
    again = photo_poses(config, 240, np.random.default_rng(3))
    np.testing.assert_array_equal(poses, again)
    eyes = np.array(poses)[:, :3, 3]
    for path in config.paths().values():
        for s in np.arange(0.0, DRIVEN_M, 1.0):
            assert np.linalg.norm(eyes[:, :2] - path.pose_at(float(s))[:2], axis=1).min() < 3.0
    raised = eyes[:, 2] > 2.5
    assert 0.15 < raised.mean() < 0.25
    assert eyes[~raised, 2].min() > 1.2
    for tree in TREES:
        assert np.hypot(*(eyes[:, :2] - (tree.x_m, tree.y_m)).T).min() > tree.radius_m
    for house in HOUSES:
        inside = (
            (eyes[:, 0] > house.x[0])
            & (eyes[:, 0] < house.x[1])
            & (eyes[:, 1] > house.y[0])
            & (eyes[:, 1] < house.y[1])
        )
        assert not inside.any()


def test_the_overview_comes_with_its_camera(intersection):
    picture, pinhole, T = intersection.overview(480, 360)
    assert picture.shape == (360, 480, 3)
    stop_line, lane = (1.0, -13.9, PAINT_M), (1.0, -16.5, 0.0)
    for point, bright in ((stop_line, True), (lane, False)):
        u, v = pinhole.project(transform_points(invert_transform(T), np.asarray(point)))
        assert (picture[int(v), int(u)].mean() > 180.0) == bright


def test_it_is_described_without_being_opened_and_drawn_only_open():
    closed = Intersection()
    description = closed.describe()
    assert list(description.paths) == ["straight", "right", "left"]
    assert (description.car.kind, description.car.control_limits) == ("dubins", (-1.2, 1.2))
    assert (
        WorldDescription.from_dict(json.loads(json.dumps(description.to_dict()))).to_dict()
        == description.to_dict()
    )
    for line in description.road_edge:
        middle = 0.5 * (line[:-1] + line[1:])
        along = line[1:] - line[:-1]
        right = np.stack([along[:, 1], -along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        assert all(closed.config.on_road(*point) for point in middle + 0.05 * right)
        assert not any(closed.config.on_road(*point) for point in middle - 0.05 * right)
    with pytest.raises(NotOpenError, match="as a context manager"):
        closed.observe_at(0.0, 0.0, 0.0)
