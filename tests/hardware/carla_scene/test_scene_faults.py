"""The scene on a server that misbehaves, dies or is in other hands: what is told, and that the world is put back."""

import gc
import math

import numpy as np
import pytest

from advnerf_core.geometry import camera_mount, planar_pose, transform_points
from hardware.worlds.carla.errors import (
    CarlaBusy,
    CarlaError,
    CarlaFrameError,
    CarlaMapError,
    CarlaUnreachable,
)
from tests.support.carla.scenes import carla_points, drive, is_put_back, scene_of


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
            points = transform_points(
                T, scene.camera_pinhole.directions() * np.where(seen, depth, 0.0)[..., None]
            )
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
    scene = scene_of(library, settings).__enter__()
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
    scene = scene_of(library, settings).__enter__()
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
        scene_of(library, settings, **changes).__enter__()
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
        pytest.raises(
            CarlaError, match=r"vehicle vehicle.cart into CARLA's world, got: blueprint 'vehicle.cart' not"
        ),
    ):
        scene.reset(0.0, 0.0, 0.0)
    assert is_put_back(library.world)


def test_cameras_without_a_body(library, settings):
    with scene_of(library, settings, body={"blueprint": None, "solid": []}) as scene:
        scene.reset(-20.0, -1.75, 0.0)
        scene.step(0.0, 6.0, 0.1)
        scene.observe()
        assert {actor.type_id for actor in library.world.actors} == {
            "sensor.camera.rgb",
            "sensor.camera.depth",
        }
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
    scene = scene_of(library, settings).__enter__()
    scene.close()
    calls = list(library.world.calls)
    T = planar_pose(-10.0, 0.0, 0.0) @ camera_mount(0.0, 0.0, 2.0)
    uses = (
        lambda: scene.reset(0.0, 0.0, 0.0),
        lambda: scene.step(0.0, 6.0, 0.1),
        scene.observe,
        lambda: scene.observe_at(0.0, 0.0, 0.0),
        lambda: scene.photograph(T),
    )
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
    with pytest.raises(
        CarlaBusy, match=r"another client drives it.*advnerf scene carla release.*server.take_over"
    ):
        scene_of(library, settings).__enter__()
    assert world.settings.synchronous_mode  # not ours to change
    with scene_of(library, settings, server={**settings["server"], "take_over": True}):
        pass
    assert not world.settings.synchronous_mode  # nobody is left who would tick it


def test_traffic_would_be_in_the_pictures(library, settings, scripted, carla):
    world = library.world
    world.actors.append(
        scripted.Actor(world, scripted.Blueprint("vehicle.lincoln.mkz_2020"), carla.Transform())
    )
    with pytest.raises(CarlaBusy, match=r"1 vehicles or walkers \(vehicle.lincoln.mkz_2020\)"):
        scene_of(library, settings).__enter__()
    with scene_of(library, settings, server={**settings["server"], "allow_traffic": True}):
        pass
    assert len(world.actors) == 1


def test_a_hill_is_refused(carla, scripted, settings, TJunction):
    library = scripted.Library(
        carla, scripted.World(carla, carla.Map("written", TJunction(slope=0.05).text()))
    )
    with pytest.raises(
        CarlaMapError, match=r"expected a flat junction, heights within 0.15 m, got 2.00 m at junction 100"
    ):
        scene_of(library, settings).__enter__()
