"""The contract of a world, held against a junction of a scripted server: one that is right, and some that are wrong."""

import numpy as np
import pytest

from hardware.worlds import CarlaConfig, CarlaScene
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.named import NamedWorld


@pytest.fixture
def named(library, settings):
    return NamedWorld(
        "carla", lambda config: CarlaScene(config, library), CarlaConfig.model_validate(settings), ""
    )


def test_a_good_server(named, library):
    findings = check_world(named)
    assert [f"{finding.name}: {finding.text}" for finding in findings if not finding.met] == []
    assert not library.world.settings.synchronous_mode
    assert not library.world.actors


@pytest.mark.parametrize("higher_m", [0.3, -0.3])
def test_ground_that_is_not_where_the_map_says(named, library, higher_m):
    library.world.ground_m += higher_m
    (ground,) = [each for each in check_world(named, only=["ground"]) if each.name == "ground"]
    assert not ground.met
    assert f"got a median of {higher_m:+.3f} m" in ground.text


def test_a_server_that_does_not_render(named, library):
    library.world.colour = lambda points: np.zeros(points.shape)
    pictures = check_world(named)[-1]
    assert (pictures.name, pictures.met) == ("pictures", False)
    assert "got a picture of one colour" in pictures.text
