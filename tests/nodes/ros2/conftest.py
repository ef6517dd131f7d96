"""A place among ROS programs, and other programs there, over both transports."""

import pytest

from nodes.linking.ros2.transports import open_transport
from nodes.runtime.inbox import Inbox
from tests.support.live.ros2_programs import DOMAIN_ID, Program
from tests.support.live.zenoh_router import settings_of, zenoh_router


@pytest.fixture
def inbox():
    found = Inbox(100)
    yield found
    found.close()


@pytest.fixture(params=["dds", "zenoh"])
def transport(request):
    if request.param == "dds":
        pytest.importorskip("cyclonedds")
        yield request.param
        return
    pytest.importorskip("zenoh")
    with zenoh_router():
        yield request.param


@pytest.fixture
def side_of(inbox, transport):
    made = []

    def make(sends=(), takes=(), **how):
        settings = settings_of(transport)
        made.append(open_transport(transport, DOMAIN_ID, "lo", settings, sends, takes, inbox, **how))
        return made[-1]

    yield make
    for each in made:
        each.close()


@pytest.fixture
def program(transport):
    """Start another program."""
    made = []

    def make(module, *arguments):
        made.append(Program(transport, module, *arguments))
        return made[-1]

    yield make
    for each in made:
        each.close()
