"""What `advnerf scene carla check` finds, on a scripted server that is right, and on one that is wrong in each way."""

import cv2
import numpy as np
import pytest

from hardware.worlds import CarlaConfig
from nodes.lab.carla.check import check_server


def checks_of(library, settings, pictures=None, **changes):
    return {
        c.name: c
        for c in check_server(CarlaConfig.model_validate({**settings, **changes}), library, pictures)
    }


def test_a_good_server(library, settings, tmp_path):
    found = checks_of(library, settings, tmp_path / "look")
    states = {name: check.state for name, check in found.items()}
    expected = ["server", "map", "junction", "world", "blueprints", "pictures", "depth", "put back"]
    assert states == dict.fromkeys(expected, "ok")
    assert "100: straight 74.0 m" in found["junction"].text
    assert "lanes 3.50 m, traffic on the right" in found["junction"].text
    assert not library.world.settings.synchronous_mode
    assert not library.world.actors
    assert cv2.imread(str(tmp_path / "look" / "colour.png")).shape == (46, 84, 3)
    assert cv2.imread(str(tmp_path / "look" / "depth.png"), cv2.IMREAD_UNCHANGED).ndim == 2


def test_wrong_version_ends_it(library, settings):
    library.server_version = "0.9.13"
    found = checks_of(library, settings)
    assert list(found) == ["server"]
    assert "pip install carla==0.9.13" in found["server"].text


@pytest.mark.parametrize(
    ("server", "state", "text"),
    [
        ({"town": "Town02"}, "warning", "written; an experiment would load Town02"),
        (
            {"town": "Town02", "load_town": False},
            "failure",
            "expected Town02, got written, and server.load_town is off",
        ),
        ({"town": "Town99"}, "failure", "the server does not have Town99"),
    ],
)
def test_another_map_is_not_loaded(library, settings, server, state, text):
    library.maps.append("/Game/Carla/Maps/Town02")
    found = checks_of(library, settings, server={**settings["server"], **server})
    assert list(found) == ["server", "map"]
    assert found["map"].state == state
    assert text in found["map"].text
    assert library.clients[0].loaded == []


def test_each_thing_that_can_be_wrong(library, settings, scripted, carla):
    found = checks_of(library, settings, junction={"id": 5})
    assert (list(found)[-1], found["junction"].state) == ("junction", "failure")
    library.world.settings.synchronous_mode = True
    found = checks_of(library, settings)
    assert (list(found)[-1], found["world"].state) == ("world", "failure")
    library.world.settings.synchronous_mode = False
    found = checks_of(library, settings, body={"blueprint": "vehicle.cart"})
    assert (list(found)[-1], found["blueprints"].state) == ("blueprints", "failure")
    assert not library.world.actors
    library.world.script = dict.fromkeys(range(1, 99), "drop")
    found = checks_of(library, settings)
    assert found["pictures"].state == "failure"
    assert "no picture at all" in found["pictures"].text
    assert found["put back"].state == "ok"


def test_a_server_that_is_a_tick_late_is_a_warning(library, settings):
    library.world.late_poses = True
    found = checks_of(library, settings)
    assert found["pictures"].state == "warning"
    assert "10 of 11 pictures had to be asked for again" in found["pictures"].text
    assert found["depth"].state == "ok"


@pytest.mark.parametrize("higher_m", [0.3, -0.3])
def test_ground_that_is_not_where_the_map_says_shows_in_the_depth(library, settings, higher_m):
    library.world.ground_m += higher_m
    found = checks_of(library, settings)
    assert found["depth"].state == "failure"
    assert f"{(1.6 - higher_m) / 1.6:.2f} of what a flat road gives" in found["depth"].text


def test_a_server_that_does_not_render(library, settings):
    library.world.colour = lambda points: np.zeros(points.shape)
    assert "does the server render" in checks_of(library, settings)["picture"].text


def test_a_server_that_dies_in_the_middle(library, settings):
    library.world.script = {3: "die"}
    found = checks_of(library, settings)
    assert "did not answer to a tick" in found["pictures"].text
    assert found["put back"].state == "failure"
