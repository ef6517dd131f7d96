"""What only Zenoh does: routers, programs that do not announce themselves, and who may be reached."""

import socket
import time

import numpy as np
import psutil
import pytest

from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.transports import open_transport
from nodes.linking.ros2.zenoh_settings import ZenohSettings, open_to_others, session_config
from nodes.runtime.errors import BusError, SecurityError
from nodes.runtime.messages import encode, image_message
from tests.support.live.processes import free_ports
from tests.support.live.ros2_programs import DOMAIN_ID
from tests.support.waiting import wait_for

pytest.importorskip("zenoh")
import zenoh

from tests.support.live.strange_zenoh import config, made

pytestmark = pytest.mark.live
only_zenoh = pytest.mark.parametrize("transport", ["zenoh"], indirect=True)

IMAGE, TWIST = "sensor_msgs/msg/Image", "geometry_msgs/msg/TwistStamped"
IMAGES, COMMANDS = Endpoint("/image_raw", IMAGE, False, 5), Endpoint("/cmd_vel", TWIST, True, 10)
PICTURE = encode(image_message(np.zeros((8, 8, 3), np.uint8), time.time_ns(), "camera"))


@pytest.fixture
def open_side(inbox):
    """Open a session with settings of its own."""
    made = []

    def make(sends=(), takes=(), **settings):
        found = ZenohSettings(**settings)
        made.append(open_transport("zenoh", DOMAIN_ID, "lo", found, sends, takes, inbox))
        return made[-1]

    yield make
    for each in made:
        each.close()


def free_endpoint():
    return f"tcp/localhost:{free_ports(1)[0]}"


def answers(side, inbox):
    """Send a picture, and take what has come."""
    side.write(0, PICTURE)
    time.sleep(0.02)
    return [heard for batch in inbox.take() for heard in batch]


@only_zenoh
@pytest.mark.parametrize("kind", ["unannounced", "without_attachment"])
def test_a_program_that_is_not_announced_never_counts(side_of, program, inbox, kind):
    side = side_of([IMAGES], [COMMANDS])
    stranger = program("tests.support.live.ros2_strangers")
    stranger.ask(kind, seconds=4.0)
    got = wait_for(lambda: answers(side, inbox), "an answer")
    assert all(heard.writer not in heard.present for heard in got)
    assert side.present(0) == ()
    # Beside one that is announced it is a second publisher.
    program("tests.support.live.ros2_strangers", "--honest")
    stranger.ask(kind, seconds=10.0)
    wait_for(lambda: (answers(side, inbox), len(side.present(0)) >= 2)[1], "both")
    assert any(name.startswith("not announced") for name in side.present(0))


@only_zenoh
def test_pictures_of_a_program_that_is_not_announced_are_noticed(side_of, program):
    side = side_of([IMAGES], watched=[0])
    program("tests.support.live.ros2_strangers").ask("unannounced_images")
    wait_for(lambda: side.rivals(0), "the rival")
    wait_for(lambda: side.rivals(0) == (), "the rival to leave")


@only_zenoh
def test_another_definition_is_named(side_of, program):
    side = side_of([IMAGES], [COMMANDS])
    program("tests.support.live.ros2_strangers").ask("wrong_definition")
    wait_for(lambda: "another definition" in side.mismatch(0), "the mismatch")
    assert side.present(0) == ()


def test_a_missing_router_is_named_and_may_come_later(open_side):
    endpoint = free_endpoint()
    side = open_side(takes=[COMMANDS], connect=(endpoint,))
    assert f"no Zenoh router at {endpoint} yet" in side.mismatch(0)
    open_side(router=True, listen=(endpoint,))
    wait_for(lambda: side.mismatch(0) == "", "the router")


def test_this_node_can_be_the_router(open_side, inbox):
    endpoint = free_endpoint()
    router = open_side([IMAGES], [COMMANDS], router=True, listen=(endpoint,))
    other = open_side([COMMANDS], [IMAGES], connect=(endpoint,))
    third = open_side(takes=[COMMANDS], connect=(endpoint,))
    wait_for(lambda: router.readers_of(0) == 1 and len(router.present(0)) == 1, "each other")
    wait_for(lambda: other.readers_of(0) == 2 and len(third.present(0)) == 1, "the third")
    with pytest.raises(BusError, match="another router may run on this computer"):
        open_side(router=True, listen=(endpoint,))


def test_programs_find_each_other_without_a_router(open_side):
    endpoint = free_endpoint()
    one = open_side([IMAGES], connect=(), listen=(endpoint,))
    open_side(takes=[IMAGES], connect=(endpoint,))
    wait_for(lambda: one.readers_of(0) == 1, "a direct connection")
    two = open_side([Endpoint("/other", IMAGE, True, 5)], multicast=True)
    open_side(takes=[Endpoint("/other", IMAGE, True, 5)], multicast=True)
    wait_for(lambda: two.readers_of(0) == 1, "each other by multicast")


def test_a_router_that_other_computers_reach_is_refused(open_side):
    with socket.create_server(("0.0.0.0", 0)) as server:
        port = server.getsockname()[1]
        assert open_to_others(port)
        with pytest.raises(SecurityError, match="accepts connections from other computers"):
            open_side(takes=[COMMANDS], connect=(f"tcp/localhost:{port}",))
    with socket.create_server(("127.0.0.1", 0)) as server:
        assert not open_to_others(server.getsockname()[1])
    with socket.create_server(("::", 0), family=socket.AF_INET6) as server:
        assert open_to_others(server.getsockname()[1])
    with socket.create_server(("::1", 0), family=socket.AF_INET6) as server:
        assert not open_to_others(server.getsockname()[1])


def test_a_router_that_is_opened_later_is_refused_then(open_side):
    port = free_ports(1)[0]
    side = open_side(takes=[COMMANDS], connect=(f"tcp/localhost:{port}",))
    with socket.create_server(("0.0.0.0", port)), pytest.raises(SecurityError, match="other computers"):
        wait_for(lambda: (side.mismatch(0), False)[1], "the refusal", 20.0)


@pytest.mark.parametrize("host", ["192.168.1.5", "car.local", "0.0.0.0", "[::]", "[fe80::1]"])
def test_endpoints_on_other_computers_need_another_interface(host):
    for which in ("connect", "listen"):
        settings = ZenohSettings(**{which: (f"tcp/{host}:7447",)})
        with pytest.raises(SecurityError, match="is not on this computer"):
            session_config(settings, "lo", local=True)
        assert "access_control" not in session_config(settings, "eth0", local=False)


def passes(values, endpoint):
    """Whether a sample gets from a program to a session that it reaches on an endpoint."""
    inner = zenoh.open(made({**values, "listen/endpoints": [endpoint], "connect/endpoints": []}))
    outer, got = zenoh.open(config("peer", connect=[endpoint])), []
    with inner, outer:
        inner.declare_subscriber("0/cmd_vel/type/hash", got.append)
        wait_for(lambda: list(inner.info.peers_zid()), "the connection")
        for _ in range(20):
            outer.put("0/cmd_vel/type/hash", b"command")
            time.sleep(0.05)
        return bool(got)


def test_a_program_on_another_interface_is_not_heard_even_if_it_is_connected():
    address = _address_of_this_computer()
    if address is None:
        pytest.skip("this computer has the loopback interface only")
    outside = f"tcp/{address}:{free_ports(1)[0]}"
    assert not passes(session_config(ZenohSettings(), "lo", local=True), outside)
    assert passes(session_config(ZenohSettings(), "lo", local=True), free_endpoint())
    assert passes(session_config(ZenohSettings(), "eth0", local=False), outside)


def _address_of_this_computer():
    for name, addresses in psutil.net_if_addrs().items():
        for each in addresses:
            if name != "lo" and each.family == socket.AF_INET:
                return each.address
    return None


@pytest.mark.parametrize(
    "wrong", ["localhost:7447", "udp/localhost:7447", "tcp/localhost", "tcp/a:1#iface=eth0", ""]
)
def test_wrong_endpoints_are_one_line(wrong):
    with pytest.raises(ValueError, match="expected endpoints such as tcp/localhost:7447"):
        ZenohSettings(connect=(wrong,))
