"""The real graph on the simulated lab: a second Tracker, a pose that jumps, a car that is held; the brake on the wire, and why."""

import pytest

from tests.support.live.faults import suffer
from tests.support.live.graph import Graph
from tests.support.spoiled import Spoiled, unspoiled

pytestmark = pytest.mark.live

_SETTINGS = ("record=false", "policy.module=tests.support.live.straight_policy")


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    graph = Graph(tmp_path_factory.mktemp("run"), _SETTINGS)
    try:
        yield graph
    finally:
        graph.close()


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        ("vicon two_senders", "two senders of subject car: 127.0.0.1:"),
        ("car jammed", "the car does not move"),
        pytest.param("vicon jump", "sideways", marks=pytest.mark.slow),
        pytest.param("car spinning", "the wheels spin but the car does not move", marks=pytest.mark.slow),
    ],
)
def test_the_car_is_stopped_and_told_why(graph, fault, reason):
    def drive():
        result = suffer(graph, fault, 1.0)
        said = graph.operator.seen["/safety/state"].reason
        if reason not in said:
            raise Spoiled(said)
        return result

    assert unspoiled(drive)["by"] == "SET_CURRENT_BRAKE"
