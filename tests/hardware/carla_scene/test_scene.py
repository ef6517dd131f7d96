"""The scene's control flow on a scripted server, with the real library's geometry: what it asks for, gets, and puts back."""

import gc
import math

import numpy as np
import pytest

from advnerf_core.geometry import camera_mount, planar_pose, transform_points
from hardware.carla_scene.config import CarlaConfig
from hardware.carla_scene.errors import CarlaBusy, CarlaError, CarlaFrameError, CarlaMapError, CarlaUnreachable
from hardware.carla_scene.scene import CarlaScene
from hardware.deployment_scene import DeploymentScene


def scene_of(library, settings, **changes):
    return CarlaScene(CarlaConfig.model_validate({**settings, **changes}), library)


def drive(library, settings, steps, error=None):
    """A whole drive, which the script, or an error of ours, ends early."""
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        for _ in range(steps):
            scene.step(0.0, 6.0, 0.1)
        if error is not None:
            raise error


def is_put_back(world):
    s = world.settings
    same = not s.synchronous_mode and not s.fixed_delta_seconds and not world.lights_frozen and not world.actors
    return same and world.weather == world.library.WeatherParameters()


def carla_points(scene, world_points):
    """Independent of the code under test: mirror after the frame's matrix."""
    points = transform_points(scene.drives.frame.T_mirrored_from_world, world_points)
    return points * np.array([1.0, -1.0, 1.0])


def test_is_a_deployment_scene_and_owns_the_world_while_open(library, settings):
    world = library.world
    with scene_of(library, settings) as scene:
        assert isinstance(scene, DeploymentScene)
        assert world.settings.synchronous_mode
        assert world.settings.fixed_delta_seconds == 0.1
        assert world.lights_frozen
        assert (world.weather.sun_altitude_angle, world.weather.wind_intensity) == (45.0, 0.0)
        assert scene.off_track_m == pytest.approx(1.75)
    assert is_put_back(world)
    scene.close()  # twice is fine


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
        points = transform_points(T, scene.camera_pinhole.directions() * np.where(seen, depth, 0.0)[..., None])
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
        x, y, z = carla_points(scene, np.array([state.x_m + 1.4 * math.cos(0.5), state.y_m + 1.4 * math.sin(0.5), 0.0]))
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


# --- a server that misbehaves ---


def test_a_late_frame_is_waited_for(library, settings):
    library.world.script = dict.fromkeys(range(1, 20), "late")
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        scene.step(0.0, 6.0, 0.1)
        scene.observe()
        assert scene.repeated_frames == 0


def test_a_dropped_frame_costs_a_tick_not_the_run(library, settings):
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        library.world.script = {library.world.ticks + 1: "drop"}
        state = scene.step(0.0, 6.0, 0.1)
        rgb, _ = scene.observe()
        assert scene.repeated_frames == 1
        assert scene.state == state  # the car stood while the server was asked again
        assert np.array_equal(rgb, scene.observe_at(state.x_m, state.y_m, state.yaw_rad)[0])


def test_frames_that_never_come_are_an_error_and_the_world_is_put_back(library, settings):
    library.world.script = dict.fromkeys(range(1, 50), "drop")
    with pytest.raises(
        CarlaFrameError, match=r"picture of frame \d+ within 0.2 s of its tick, got no picture at all: are"
    ):
        drive(library, settings, 1)
    assert is_put_back(library.world)


def test_a_picture_from_elsewhere_is_not_taken(library, settings):
    """A server that moves cameras one tick late: every picture of a step is asked for again, and none is wrong."""
    world = library.world
    world.late_poses = True
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe()
        for _ in range(3):
            state = scene.step(0.3, 6.0, 0.1)
            rgb, depth = scene.observe()
            T = state.T_world_from_car @ scene.T_car_from_camera
            seen = depth < 50.0
            points = transform_points(T, scene.camera_pinhole.directions() * np.where(seen, depth, 0.0)[..., None])
            assert np.abs(world.colour(carla_points(scene, points)) - rgb.astype(float))[seen].max() <= 1.0
        assert scene.repeated_frames == 3


def test_a_camera_that_does_not_move_is_an_error(library, settings):
    with scene_of(library, settings) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.observe(depth=False)
        (camera,) = library.world.actors.filter("sensor.*")
        camera.set_transform = lambda transform: None
        scene.step(0.0, 6.0, 0.1)
        with pytest.raises(CarlaFrameError, match=r"0.600 m and 0.00 degrees away"):
            scene.observe(depth=False)


def test_a_tick_that_times_out_is_told_and_the_world_is_put_back(library, settings):
    library.world.script = {5: "hang"}
    with pytest.raises(CarlaUnreachable, match="did not answer to a tick: time-out of"):
        drive(library, settings, 10)
    assert is_put_back(library.world)


def test_a_server_that_dies_leaves_its_own_error_to_be_seen(library, settings, caplog):
    library.world.script = {5: "die"}
    with pytest.raises(CarlaUnreachable, match="did not answer to a tick"):
        drive(library, settings, 10)
    assert "the world's settings" in caplog.text
    assert library.clients[0].timeout_s <= 5.0  # closing does not wait its whole time-out for each thing


def test_closing_says_what_could_not_be_put_back(library, settings):
    scene = scene_of(library, settings)
    library.world.dead = True
    with pytest.raises(
        CarlaError,
        match=r"could not put CARLA's world back: the traffic lights: time-out.*the world's settings: time-out",
    ):
        scene.close()


@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit])
def test_an_error_in_the_middle_puts_the_world_back(library, settings, error):
    with pytest.raises(error):
        drive(library, settings, 1, error)
    assert is_put_back(library.world)


def test_a_scene_that_nobody_closes_puts_the_world_back(library, settings):
    scene = scene_of(library, settings)
    scene.reset(-20.0, -1.75, 0.0)
    scene.observe()
    assert not is_put_back(library.world)
    del scene
    gc.collect()
    assert is_put_back(library.world)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"render": {"weather": "Hail"}}, CarlaMapError, "expected a weather of ClearNight, .* got 'Hail'"),
        ({"body": {"solid": ["Brick"]}}, CarlaMapError, "expected body.solid of .*Buildings.* got 'Brick'"),
        ({"junction": {"id": 3}}, CarlaMapError, "junction 3 in the map"),
    ],
)
def test_a_scene_that_cannot_open_changes_nothing(library, settings, changes, error, message):
    with pytest.raises(error, match=message) as caught:
        scene_of(library, settings, **changes)
    assert is_put_back(library.world)
    del caught  # kept till here: what is put back is not left to the garbage collector


def test_blueprints_that_the_server_lacks(library, settings):
    with (
        scene_of(library, settings, render={"camera_attributes": {"haze": "1"}}) as scene,
        pytest.raises(CarlaError, match=r"the attribute haze of sensor.camera.rgb.*render.camera_attributes"),
    ):
        scene.observe()
    with (
        scene_of(library, settings, body={"blueprint": "vehicle.cart"}) as scene,
        pytest.raises(CarlaError, match=r"vehicle vehicle.cart into CARLA's world, got: blueprint 'vehicle.cart' not"),
    ):
        scene.reset(0.0, 0.0, 0.0)
    assert is_put_back(library.world)


def test_cameras_without_a_body(library, settings):
    with scene_of(library, settings, body={"blueprint": None, "solid": []}) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.step(0.0, 6.0, 0.1)
        scene.observe()
        assert {actor.type_id for actor in library.world.actors} == {"sensor.camera.rgb", "sensor.camera.depth"}
        assert "cast_ray" not in library.world.calls


def test_exposure_is_pinned_to_the_servers_upper_bound(library, settings):
    with scene_of(library, settings) as scene:
        scene.observe()
        rgb, depth = library.world.actors.filter("sensor.*")
        assert (rgb.values["exposure_min_bright"], rgb.values["exposure_max_bright"]) == ("12", "12")
        assert rgb.values["motion_blur_intensity"] == "0.0"
        assert depth.values["fov"] == rgb.values["fov"]
        assert float(rgb.values["fov"]) == pytest.approx(88.0)


def test_a_closed_scene_touches_nothing(library, settings):
    scene = scene_of(library, settings)
    scene.close()
    calls = list(library.world.calls)
    T = planar_pose(-10.0, 0.0, 0.0) @ camera_mount(0.0, 0.0, 2.0)
    uses = (
        lambda: scene.reset(0.0, 0.0, 0.0), lambda: scene.step(0.0, 6.0, 0.1), scene.observe,
        lambda: scene.observe_at(0.0, 0.0, 0.0), lambda: scene.photograph(T),
    )  # fmt: skip
    for use in uses:
        with pytest.raises(CarlaError, match="this one is closed"):
            use()
    assert library.world.calls == calls


@pytest.mark.parametrize("duration", [0.05, -0.1, 0.149, math.nan])
def test_a_step_is_whole_ticks(library, settings, duration):
    with scene_of(library, settings) as scene, pytest.raises(ValueError, match="whole ticks"):
        scene.step(0.0, 6.0, duration)


def test_a_world_in_other_hands(library, settings):
    world = library.world
    world.settings.synchronous_mode = True
    with pytest.raises(CarlaBusy, match=r"another client drives it.*advnerf carla release.*server.take_over"):
        scene_of(library, settings)
    assert world.settings.synchronous_mode  # not ours to change
    with scene_of(library, settings, server={**settings["server"], "take_over": True}):
        pass
    assert not world.settings.synchronous_mode  # nobody is left who would tick it


def test_traffic_would_be_in_the_pictures(library, settings, scripted, carla):
    world = library.world
    world.actors.append(scripted.Actor(world, scripted.Blueprint("vehicle.lincoln.mkz_2020"), carla.Transform()))
    with pytest.raises(CarlaBusy, match=r"1 vehicles or walkers \(vehicle.lincoln.mkz_2020\)"):
        scene_of(library, settings)
    with scene_of(library, settings, server={**settings["server"], "allow_traffic": True}):
        pass
    assert len(world.actors) == 1


def test_a_hill_is_refused(carla, scripted, settings, TJunction):
    library = scripted.Library(carla, scripted.World(carla, carla.Map("written", TJunction(slope=0.05).text())))
    with pytest.raises(
        CarlaMapError, match=r"expected a flat junction, heights within 0.15 m, got 2.00 m at junction 100"
    ):
        scene_of(library, settings)
