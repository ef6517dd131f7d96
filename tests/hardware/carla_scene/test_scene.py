"""The scene's control flow on a scripted server, with the real library's geometry: what it asks for, gets, and puts back."""

import math

import numpy as np
import pytest

from advnerf_core.geometry import camera_mount, planar_pose, transform_points
from hardware.worlds.carla.errors import CarlaError
from hardware.worlds.world import NotOpenError, World
from tests.support.carla.scenes import carla_points, is_put_back, scene_of


def test_is_a_world_and_owns_the_servers_while_open(library, settings):
    world = library.world
    with scene_of(library, settings) as scene:
        assert isinstance(scene, World)
        assert world.settings.synchronous_mode
        assert world.settings.fixed_delta_seconds == 0.1
        assert world.lights_frozen
        assert (world.weather.sun_altitude_angle, world.weather.wind_intensity) == (45.0, 0.0)
        assert scene.off_track_m == pytest.approx(1.75)
    assert is_put_back(world)
    scene.close()  # twice is fine


def test_before_it_is_open_it_asks_nothing(library, settings):
    scene = scene_of(library, settings)
    assert library.clients == []
    assert scene.traits.exclusive
    for ask in (scene.describe, lambda: scene.state, lambda: scene.blocked):
        with pytest.raises(NotOpenError, match="as a context manager"):
            ask()
    with scene:
        description = scene.describe()
    assert list(description.paths) == ["straight", "right", "left"]
    assert description.facts["junction_id"] == 100
    assert description.box.contraction
    with pytest.raises(CarlaError, match="never closed"), scene:
        pass


@pytest.mark.parametrize("where", [(-24.0, -1.75, 0.0), (1.75, -20.0, math.pi / 2), (3.0, 2.0, -2.5)])
def test_colours_depth_and_pose_belong_together(library, settings, where):
    """Each pixel, taken back to the world by our pose and depth, is the point that the server painted there."""
    world = library.world
    world.walls = [((5.0, -40.0), (40.0, -22.0), None), ((0.0, 10.0), (10.0, 25.0), None)]
    with scene_of(library, settings) as scene:
        scene.reset(*where)
        rgb, depth = scene.observe()
        seen = np.isfinite(depth) & (depth < 60.0)
        assert seen.mean() > 0.4
        assert np.isinf(depth[:5]).any()  # the sky
        T = planar_pose(*where) @ scene.T_car_from_camera
        points = transform_points(
            T, scene.camera_pinhole.directions() * np.where(seen, depth, 0.0)[..., None]
        )
        expected = world.colour(carla_points(scene, points))
        assert np.abs(expected - rgb.astype(float))[seen].max() <= 1.0
        ground = seen & (np.abs(points[..., 2]) < 0.01)
        assert ground.sum() > 0.3 * seen.size  # the scene's ground is z = 0 although the map's is 2.5 m up


def test_a_photograph_is_taken_from_where_it_was_asked(library, settings):
    world = library.world
    T = planar_pose(-10.0, -1.0, 0.4) @ camera_mount(0.0, 0.0, 5.0, 0.5)
    with scene_of(library, settings) as scene:
        scene.reset(-24.0, -1.75, 0.0)
        rgb = scene.photograph(T)
        d = scene.photo_pinhole.directions()
        t = T[2, 3] / -(d @ T[:3, :3].T)[..., 2]
        down = t > 0
        points = transform_points(T, d * np.where(down, t, 0.0)[..., None])
        expected = world.colour(carla_points(scene, points))
        near = down & (t < 40.0)
        assert near.mean() > 0.5
        assert np.abs(expected - rgb.astype(float))[near].max() <= 1.0


def test_car_drives_as_the_dubins_car_it_is(library, settings):
    """An ideal car on a circle, in closed form; the body follows half a wheelbase ahead, mirrored, without physics."""
    world = library.world
    with scene_of(library, settings, car={"turn_rate_lag_s": 0.0, "turn_rate_gain": 1.0}) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        for _ in range(10):
            state = scene.step(0.5, 6.0, 0.1)
        assert (state.x_m, state.y_m) == pytest.approx(
            (-20 + 12 * math.sin(0.5), -1.75 + 12 * (1 - math.cos(0.5))), abs=1e-9
        )
        assert state.yaw_rad == pytest.approx(0.5)
        (body,) = world.actors.filter("vehicle.*")
        x, y, z = carla_points(
            scene, np.array([state.x_m + 1.4 * math.cos(0.5), state.y_m + 1.4 * math.sin(0.5), 0.0])
        )
        at = body.transform.location
        assert (at.x, at.y, at.z) == pytest.approx((x, y, z), abs=1e-4)
        assert body.transform.rotation.yaw == pytest.approx(-math.degrees(0.5 + 0.6), abs=1e-3)
        assert not body.physics
    assert is_put_back(world)


def test_one_tick_for_one_step_and_its_picture(library, settings):
    world = library.world
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        before = world.ticks
        for _ in range(5):
            scene.step(0.1, 6.0, 0.1)
            first, second = scene.observe()[0], scene.observe()[0]
            assert np.array_equal(first, second)
        assert world.ticks == before + 5
        scene.step(0.0, 6.0, 0.3)
        assert world.ticks == before + 8
        assert scene.repeated_frames == 0


def test_jumps_settle_and_steps_do_not(library, settings):
    world = library.world
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe(depth=False)
        assert world.ticks == 3  # two to settle, one for the picture
        scene.observe_at(-10.0, -1.75, 0.0, depth=False)
        assert world.ticks == 6
        scene.step(0.0, 6.0, 0.1)  # from elsewhere: a jump for the camera
        scene.observe(depth=False)
        assert world.ticks == 10
        scene.step(0.0, 6.0, 0.1)
        scene.observe(depth=False)
        assert world.ticks == 11
        scene.reset(*(scene.state.x_m, scene.state.y_m, scene.state.yaw_rad))
        scene.observe(depth=False)
        assert world.ticks == 12


def test_the_body_is_out_of_sight_of_other_pictures(library, settings):
    world, heights = library.world, []
    draw = world.picture

    def noting(actor):
        heights.append(world.actors.filter("vehicle.*")[0].transform.location.z)
        return draw(actor)

    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        world.picture = noting
        scene.observe_at(-20.0, -1.75, 0.0, depth=False)
        assert heights[-1] > 50.0
        scene.observe(depth=False)
        assert heights[-1] == pytest.approx(2.5, abs=1e-4)


def test_six_seconds_along_a_path_give_both_images_and_leave_no_actor(library, settings):
    with scene_of(library, settings) as scene:
        scene.reset(*scene.paths["left"].start_pose)
        for _ in range(60):
            rgb, depth = scene.observe()
            scene.step(0.0, 6.0, 0.1)
    assert depth.shape == rgb.shape[:2] == (46, 84)
    assert not library.world.actors


def test_photographs_need_no_car_at_all(library, settings):
    with scene_of(library, settings) as scene:
        scene.photograph(planar_pose(-10.0, 0.0, 0.0) @ camera_mount(0.0, 0.0, 2.0))
        assert not library.world.actors.filter("vehicle.*")


def test_the_car_stops_at_what_is_solid(library, settings, carla):
    world = library.world
    with scene_of(library, settings) as scene:
        ends = carla_points(scene, np.array([[-10.0, -6.0, 0.0], [-10.0, 6.0, 0.0]]))
        world.walls = [(tuple(ends[0, :2]), tuple(ends[1, :2]), carla.CityObjectLabel.Buildings)]
        scene.reset(-20.0, -1.75, 0.0)
        for _ in range(15):
            state = scene.step(0.0, 6.0, 0.1)
        assert scene.blocked
        assert -10.0 - 3.85 - 0.7 < state.x_m < -10.0 - 3.85 + 1e-6  # its bumper is 3.85 m ahead
        assert state.speed_mps == 0.0
        scene.reset(-5.0, -1.75, 0.0)
        scene.step(0.0, 6.0, 0.1)
        assert not scene.blocked


def test_leaves_and_paint_stop_nobody(library, settings, carla):
    world = library.world
    with scene_of(library, settings) as scene:
        ends = carla_points(scene, np.array([[-14.0, -6.0, 0.0], [-14.0, 6.0, 0.0]]))
        world.walls = [(tuple(ends[0, :2]), tuple(ends[1, :2]), carla.CityObjectLabel.Vegetation)]
        scene.reset(-20.0, -1.75, 0.0)
        assert scene.step(0.0, 6.0, 0.5).x_m == pytest.approx(-17.0)
        assert not scene.blocked


def test_the_world_has_an_end(library, settings):
    with scene_of(library, settings, junction={"reach_m": 25.0}) as scene:
        scene.reset(-24.0, 0.0, math.pi)
        for _ in range(5):
            scene.step(0.0, 6.0, 0.1)
        assert scene.blocked
