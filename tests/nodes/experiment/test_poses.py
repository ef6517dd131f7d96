"""Where objects may stand at the junction."""

import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.attack.spaces.placement import footprint
from advnerf_core.geometry import rotation_z, yaw_of
from hardware.worlds.junction.config import IntersectionConfig
from nodes.experiment.plan.sections import PolicyConfig, RobustnessConfig
from nodes.experiment.plan.space_config import LandscapeConfig, PlacesConfig, RobustnessMapConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.spaces import bounds_of, lanes_of, random_placements


def test_objects_move_about_their_places_and_off_the_lanes(trained: Experiment) -> None:
    things = trained.objects
    moved = random_placements(trained, 12, seed=3)
    assert len(moved) == 12
    for objects in moved:
        for thing, there in zip(things, objects, strict=True):
            offset_m = there.T_world_from_object[:2, 3] - [thing.x_m, thing.y_m]
            assert np.abs(offset_m).max() <= PlacesConfig(kind="places").move_m + 1e-9
            low, high = (there.scale * corner for corner in footprint(there))
            corners = np.array([[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])])
            yaw_rad = yaw_of(there.T_world_from_object)
            corners = corners @ rotation_z(yaw_rad)[:2, :2].T + there.T_world_from_object[:2, 3]
            assert not any(
                IntersectionConfig().on_road(*corner) for corner in corners
            )  # they stand on pavements, so high
            place = (*there.T_world_from_object[:2, 3], yaw_of(there.T_world_from_object), there.scale)
            assert lanes_of(trained).distance_m(place, footprint(there)) >= trained.world.off_track_m
    places = np.array([[each.T_world_from_object[:3, 3] for each in objects] for objects in moved])
    assert np.ptp(places[..., :2], axis=0).min() > 0.0
    assert np.ptp(places[..., 2], axis=0).max() == 0.0  # they stay on the ground
    assert random_placements(trained, 0, seed=3) == []


def test_cars_turn_a_little_and_hydrants_all_the_way(trained: Experiment) -> None:
    for thing, bound in zip(
        trained.objects, bounds_of(trained.objects, PlacesConfig(kind="places")), strict=True
    ):
        assert bound.yaw_rad is not None
        width_rad = bound.yaw_rad[1] - bound.yaw_rad[0]
        assert width_rad == pytest.approx(
            2 * np.pi if thing.kind == "hydrant" else 2 * PlacesConfig(kind="places").turn_rad
        )
        assert bound.scale is None


@pytest.mark.parametrize(
    ("section", "given"),
    [
        (PlacesConfig, {"kind": "places", "turn_rad": 35.0}),
        (LandscapeConfig, {"yaws_rad": [0.0, 90.0]}),
        (RobustnessMapConfig, {"turn_rad": [10.0]}),
        (RobustnessMapConfig, {"object_turns_rad": [-15.0]}),
        (RobustnessConfig, {"jitter_rad": 2.0}),
        (PolicyConfig, {"stills_heading_rad": 17.0}),
        (PolicyConfig, {"drives_heading_rad": 7.0}),
    ],
)
def test_degrees_are_refused_in_each_section(section, given):
    with pytest.raises(ValidationError, match="degrees"):
        section.model_validate(given)
