import contextlib
import errno
import os
import resource
import select
import socket
import stat
import time
from pathlib import Path

import numpy as np
import pytest
import zmq
from zmq.utils import z85

from nodes.gateway import GatewayConfig, GatewayNode
from nodes.linking.clock_offset import Exchange, OffsetFilter
from nodes.linking.keys import DRIVE, WATCH, KeyFolder
from nodes.linking.link import Link, LinkConfig, on_our_clock
from nodes.runtime.bus import Bus
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import SecurityError, TopicError
from nodes.runtime.inbox import Inbox
from nodes.runtime.messages import drive_message, encode, header, type_hash_prefix, types
from nodes.runtime.wire import Meta, pack_meta
from tests.support.live.processes import free_ports
from tests.support.messages import filled
from tests.support.waiting import wait_for

ENDED_EARLY = (
    "the connection ended in the handshake: its launch is down behind a tunnel or port forward (start it), or "
    "advnerf car keys list does not show the same key robot on both hosts"
)
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"


class Host:
    """A bus and its gateway, stepped by hand."""

    def __init__(self, run_dir, config):
        self.bus = Bus(run_dir)
        self.eyes = Bus(run_dir)
        self.node = GatewayNode(config, self.bus.subscribers)
        for topic in self.node.publications:
            self.bus.publisher(topic)
        for topic in self.node.subscriptions:
            self.bus.subscribe(topic)

    def step(self):
        from nodes.runtime.clock import SystemClock

        now = SystemClock().now()
        outs = self.node.tick(now)
        for received in self.bus.receive():
            outs += self.node.handle(received.topic, None, received.info, now)
        for item in self.node.inbox.take():
            outs += self.node.receive(item, now)
        for topic, message in outs:
            self.bus.publish(topic, message)
        return self.eyes.receive()

    def close(self):
        self.node.close()
        self.node.inbox.close()
        self.bus.close()
        self.eyes.close()


@pytest.fixture
def lab(tmp_path):
    """Keys of a car, a workstation that may drive and a visitor who may watch; ports; and a factory of hosts."""
    keys = {name: KeyFolder(tmp_path / f"keys_{name}") for name in ("robot", "workstation", "visitor")}
    public = {name: folder.new(name) for name, folder in keys.items()}
    for name in ("workstation", "visitor"):
        keys[name].add("robot", public["robot"])
        keys["robot"].add(name, public[name])
    keys["robot"].allow("workstation", DRIVE)
    keys["robot"].allow("visitor", WATCH)
    watch_port, drive_port = free_ports(2)
    hosts = []

    class Lab:
        def host(self, name, **options):
            config = GatewayConfig(
                watch_port=watch_port,
                drive_port=drive_port,
                **{"keys": keys[name].path, "key": name, **options},
            )
            run_dir = tmp_path / f"run_{name}_{len(hosts)}"
            run_dir.mkdir()
            hosts.append(Host(run_dir, config))
            return hosts[-1]

        def robot(self):
            host = self.host(
                "robot", listen="127.0.0.1", exports=("/vicon/car",), imports=("/policy/drive", "/arm")
            )
            for topic in ("/policy/drive", "/arm", "/clock/offset"):
                host.eyes.subscribe(topic)
            return host

        def workstation(self, name="workstation", **options):
            options = {
                "connect": "127.0.0.1",
                "exports": ("/policy/drive",),
                "imports": ("/vicon/car",),
                **options,
            }
            host = self.host(name, **options)
            host.eyes.subscribe("/vicon/car")
            return host

        def run(self, duration_s, until=lambda got: False, act=lambda: None):
            got, end = [], time.monotonic() + duration_s
            while time.monotonic() < end and not until(got):
                act()
                for host in hosts:
                    got += [(host, received) for received in host.step()]
                time.sleep(0.005)
            return got

    lab = Lab()
    lab.keys = keys
    lab.ports = {WATCH: watch_port, DRIVE: drive_port}
    yield lab
    for host in hosts:
        host.close()


def drives(got):
    return [received for _, received in got if received.topic == "/policy/drive"]


def hello(host, topic="/policy/drive"):
    return lambda: host.eyes.publish(topic, drive_message(0.5, 0.1, time.time_ns()))


def test_secret_keys_are_private_and_names_are_unique(tmp_path):
    keys = KeyFolder(tmp_path / "keys")
    public = keys.new("robot")
    file = tmp_path / "keys" / "secret" / "robot.key"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
    # The pair belongs together, by ZeroMQ's own arithmetic.
    assert zmq.curve_public(keys.secret("robot").encode()).decode() == public
    with pytest.raises(SecurityError, match="already has a key robot"):
        keys.new("robot")
    with pytest.raises(SecurityError, match="expected a name"):
        keys.new("../robot")
    file.chmod(0o644)
    with pytest.raises(SecurityError, match="got 0644: other users may have read it"):
        keys.secret("robot")


def test_rights_are_separate_and_can_be_taken_back(tmp_path):
    keys = KeyFolder(tmp_path)
    public = keys.new("alice")
    keys.allow("alice", WATCH)
    assert keys.allowed(WATCH) == {public: "alice"}
    assert keys.allowed(DRIVE) == {}
    keys.allow("alice", DRIVE)
    assert keys.rows()[0].rights == (WATCH, DRIVE)
    assert keys.revoke("alice", DRIVE) == (DRIVE,)
    assert keys.allowed(WATCH)
    assert not keys.allowed(DRIVE)
    keys.revoke("alice")
    assert keys.rows()[0].rights == ()
    keys.allow("alice", DRIVE)
    assert keys.allow("alice", WATCH) == (DRIVE,)
    assert (keys.rows()[0].rights, keys.allow("alice", WATCH)) == ((WATCH,), ())
    for ask in (keys.allow, keys.revoke):
        with pytest.raises(SecurityError, match="expected the right watch or drive, got drvie"):
            ask("alice", "drvie")
    keys.add("bob", zmq.curve_keypair()[0].decode())
    with pytest.raises(SecurityError, match="this public key is known as bob; allow or revoke bob"):
        keys.add("carol", keys.public("bob"))
    with pytest.raises(
        SecurityError, match="expected the public key of carol, got alice, a key of this host"
    ):
        keys.add("carol", public)
    keys.revoke("alice")
    with pytest.raises(SecurityError, match="has no such right"):
        keys.revoke("alice")
    with pytest.raises(SecurityError, match="expected a public key at"):
        keys.allow("carol", WATCH)
    with pytest.raises(SecurityError, match="40 Z85 characters"):
        keys.add("carol", "short")


def test_an_address_for_all_without_keys_is_refused(tmp_path):
    for address in ("0.0.0.0", "192.168.1.20", "::", "robot.local"):
        config = GatewayConfig(listen=address, watch_port=5590, drive_port=5591)
        with pytest.raises(SecurityError, match="any computer could connect"):
            GatewayNode(config, lambda topic: 0)
    with pytest.raises(ValueError, match="either listen or connect"):
        GatewayConfig(listen="127.0.0.1", connect="127.0.0.1")
    with pytest.raises(ValueError, match="in circles"):
        GatewayConfig(listen="127.0.0.1", exports=("/arm",), imports=("/arm",))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (
            {"listen": "192.168.1.300"},
            "expected an IP address, or the name of a computer, got '192.168.1.300'",
        ),
        ({"connect": "nonsense host"}, "expected an IP address"),
        (
            {"connect": "robot.local", "watch_port": 5571},
            "expected two ports, got watch_port and drive_port 5571",
        ),
        ({"connect": "robot.local", "key": "Laptop Ü"}, "expected a name of at most 32 letters a-z"),
    ],
)
def test_addresses_ports_and_names_that_cannot_be_are_told_at_once(given, told):
    with pytest.raises(ValueError, match=told):
        GatewayConfig(**given)
    assert GatewayConfig(connect="fe80::1%eth0").connect == "fe80::1%eth0"
    assert GatewayConfig(connect="my_car-2.lab").connect == "my_car-2.lab"


def test_messages_cross_with_their_count_stamp_and_publisher_and_clocks_are_compared(lab):
    robot, workstation = lab.robot(), lab.workstation()
    got = lab.run(60.0, lambda got: len(drives(got)) > 3, hello(workstation))
    host, last = [(h, r) for h, r in got if r.topic == "/policy/drive"][-1]
    assert host is robot
    assert last.message().drive.speed == pytest.approx(0.5)
    assert last.info.instance_id == workstation.eyes.instance_id
    assert 0 <= time.monotonic_ns() - last.info.publish_mono_ns < 60 * NS_PER_S
    offsets = [r.message() for _, r in got + lab.run(0.6) if r.topic == "/clock/offset"]
    assert offsets
    assert offsets[-1].peer == "workstation"
    assert abs(offsets[-1].offset_s) <= offsets[-1].error_s < 0.5  # one computer: the truth is zero
    assert robot.node.status()[0] == workstation.node.status()[0] == "active"


def test_watch_only_key_sees_but_cannot_drive_or_arm(lab, capfd):
    robot = lab.robot()
    visitor = lab.workstation("visitor", exports=("/policy/drive", "/arm"))
    robot.eyes.publisher("/vicon/car")
    arm = filled(types.Arm, arm=True, source="operator", ask_id="a")

    def act():
        robot.eyes.publish("/vicon/car", encode(types.PoseStamped(header=header(0), pose=IDENTITY)))
        hello(visitor)()
        visitor.eyes.publish("/arm", arm)

    def tried(got):
        return robot.node.counters()["refused"] and any(r.topic == "/vicon/car" for _, r in got)

    got = lab.run(60.0, tried, act) + lab.run(0.5, act=act)
    assert any(r.topic == "/vicon/car" and h is visitor for h, r in got)
    assert not [r for _, r in got if r.topic in ("/policy/drive", "/arm")]
    assert robot.node.counters()["refused"] > 0
    assert "at the drive door: its key" in capfd.readouterr().err


IDENTITY = types.Pose(
    position=types.Point(x=0.0, y=0.0, z=0.0), orientation=types.Quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
)


def test_revocation_ends_a_running_connection(lab):
    lab.robot()
    workstation = lab.workstation()
    assert lab.run(60.0, drives, hello(workstation))
    lab.keys["robot"].revoke("workstation", DRIVE)
    wait_for(lambda: not drives(lab.run(0.8, act=hello(workstation))), "the end of the connection")
    lab.keys["robot"].allow("workstation", DRIVE)
    assert drives(lab.run(60.0, drives, hello(workstation)))


def test_a_host_that_is_refused_says_by_which_door_and_what_to_do_and_counts_nothing_as_sent(lab, capfd):
    lab.robot()
    workstation = lab.workstation()
    assert lab.run(60.0, drives, hello(workstation))
    lab.keys["robot"].allow("workstation", WATCH)
    told = (
        "fault",
        "refused at the drive door of robot: our key workstation is not on its list; "
        "allow it there with advnerf car keys allow workstation --right drive",
    )
    lab.run(60.0, lambda got: workstation.node.status() == told, hello(workstation))
    before = workstation.node.counters()["sent"]
    lab.run(2.0, act=hello(workstation))
    assert (workstation.node.status(), workstation.node.counters()["sent"]) == (told, before)
    said = capfd.readouterr().err
    assert f"link: {told[1]}" in said
    assert "link: refused handshake at the drive door: its key is not on the list" in said

    lab.keys["robot"].allow("workstation", DRIVE)
    assert drives(lab.run(60.0, drives, hello(workstation)))
    assert workstation.node.status()[0] == "active"


def test_a_host_that_knows_another_key_of_the_car_says_what_to_compare(lab):
    lab.robot()
    lab.keys["visitor"].path.joinpath("public", "robot.pub").write_bytes(zmq.curve_keypair()[0])
    visitor = lab.workstation("visitor", exports=())
    lab.run(60.0, lambda got: visitor.node.status()[0] == "fault")
    assert visitor.node.status()[1] == f"refused at the watch door of robot: {ENDED_EARLY}"


def test_a_port_that_accepts_and_closes_is_no_fault_of_the_keys_alone(lab):
    """As of a tunnel or a port forward to a car that is down."""
    tunnel = [socket.create_server(("127.0.0.1", port)) for port in lab.ports.values()]

    def accept_and_close():
        for end in select.select(tunnel, [], [], 0.0)[0]:
            end.accept()[0].close()

    workstation, told = lab.workstation(), ("fault", f"refused at the drive door of robot: {ENDED_EARLY}")
    try:
        lab.run(60.0, lambda got: workstation.node.status() == told, accept_and_close)
    finally:
        for end in tunnel:
            end.close()
    assert workstation.node.status() == told
    lab.robot()
    assert lab.run(60.0, drives, hello(workstation))


@contextlib.contextmanager
def no_descriptor_left():
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    with open(os.devnull) as lowest:
        limit = lowest.fileno()
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def test_a_list_that_cannot_be_read_for_want_of_descriptors_ends_no_connection_and_admits_nobody(lab, capfd):
    robot = lab.robot()
    workstation = lab.workstation()
    assert lab.run(60.0, drives, hello(workstation))
    keeper = robot.node._link._keeper
    key = z85.decode(lab.keys["robot"].public("workstation"))
    with no_descriptor_left():
        with pytest.raises(OSError, match="Too many open files"):
            lab.keys["robot"].allowed(DRIVE)
        capfd.readouterr()
        said = []

        def was_looked_for(got):
            said.append(capfd.readouterr().err)
            return "the list of those who may drive cannot be read, and stays" in "".join(said)

        lab.run(60.0, was_looked_for, hello(workstation))
        assert drives(lab.run(60.0, drives, hello(workstation)))
        assert keeper._user([b"1.0", b"1", b"drive", b"127.0.0.1", b"", b"CURVE", key]) == ""
    assert keeper._user([b"1.0", b"1", b"drive", b"127.0.0.1", b"", b"CURVE", key]) == "workstation"
    lab.keys["robot"].revoke("workstation", DRIVE)
    wait_for(lambda: not drives(lab.run(0.8, act=hello(workstation))), "the end of the connection")


def test_a_door_that_cannot_be_opened_for_want_of_descriptors_is_opened_later(lab, capfd):
    robot = lab.robot()
    workstation = lab.workstation()
    assert lab.run(60.0, drives, hello(workstation))
    link, failed = robot.node._link, []
    opened = link._context.socket

    def one_failure(*kind):
        if not failed:
            failed.append(kind)
            raise zmq.ZMQError(errno.EMFILE)
        return opened(*kind)

    link._context.socket = one_failure
    lab.keys["robot"].revoke("workstation", DRIVE)
    lab.run(60.0, lambda got: failed)
    lab.keys["robot"].allow("workstation", DRIVE)
    assert drives(lab.run(60.0, drives, hello(workstation)))
    assert "the drive door cannot be opened now: Too many open files" in capfd.readouterr().err


@pytest.mark.parametrize("damage", ["a folder", "no key", "gone", "a loop"])
def test_what_is_no_key_allows_nobody(lab, damage):
    keys = lab.keys["robot"]
    file = keys.path / DRIVE / "workstation.pub"
    file.unlink()
    if damage == "a folder":
        file.mkdir()
    elif damage == "no key":
        file.write_text("abc")
    elif damage == "a loop":
        file.symlink_to(file)
    else:
        file.parent.rmdir()
    assert keys.allowed(DRIVE) == {}
    assert set(keys.allowed(WATCH).values()) == {"visitor", "workstation"}


class Stranger:
    """A client of our own making at the drive door."""

    def __init__(self, lab, secret=None, public=None, server=None):
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.PUB)
        self.socket.linger = 0
        if secret:
            self.socket.curve_secretkey, self.socket.curve_publickey = secret.encode(), public.encode()
            self.socket.curve_serverkey = (server or lab.keys["robot"].public("robot")).encode()
        self.socket.connect(f"tcp://127.0.0.1:{lab.ports[DRIVE]}")

    def say(self, *frames):
        self.socket.send_multipart(frames)

    def close(self):
        self.socket.close()
        self.context.term()


def good_frames(topic=b"/policy/drive", cdr=None):
    meta = Meta(time.monotonic_ns(), time.time_ns(), 0, type_hash_prefix(ACKERMANN), 1)
    return [topic, pack_meta(meta), encode(drive_message(0.5, 0.1, time.time_ns())) if cdr is None else cdr]


@pytest.mark.parametrize("kind", ["no key", "unknown key", "wrong server key"])
def test_strangers_do_not_get_in(lab, kind, capfd):
    robot = lab.robot()
    public, secret = (half.decode() for half in zmq.curve_keypair())
    server = zmq.curve_keypair()[0].decode() if kind == "wrong server key" else None
    stranger = Stranger(lab, *(() if kind == "no key" else (secret, public, server)))
    try:
        got = lab.run(0.7, act=lambda: stranger.say(*good_frames()))
    finally:
        stranger.close()
    assert not drives(got)
    assert robot.node.counters()["refused"] > 0
    assert "link: refused" in capfd.readouterr().err


def test_malformed_and_oversized_messages_of_an_allowed_key_are_refused(lab, capfd):
    robot = lab.robot()
    keys = lab.keys["workstation"]
    friend = Stranger(lab, keys.secret("workstation"), keys.public("workstation"))
    good = good_frames()
    bad = [
        [b"/policy/drive"],
        [b"/policy/drive", b"", b""],
        [b"/policy/drive", good[1][:-1], good[2]],
        [b"/policy/drive", good[1], good[2][:-3]],
        [b"/policy/drive", good[1], b"\xff" * 200],
        [b"/policy/drive", good[1], bytes(1 << 20)],
        [b"/policy/drive", pack_meta(Meta(0, 0, 0, b"wrong!!!", 1)), good[2]],
        [b"/policy/drive/more", good[1], good[2]],
        [b"/policy/drive", *[b""] * 500],
    ]
    try:
        assert drives(lab.run(60.0, drives, lambda: friend.say(*good_frames())))
        before = robot.node.counters()["refused"]
        for frames in bad:
            friend.say(*frames)
        got = lab.run(60.0, lambda got: robot.node.counters()["refused"] >= before + len(bad))
        assert robot.node.counters()["refused"] == before + len(bad)
        assert not [r for r in drives(got) if r.info.receive_mono_ns > 0 and len(r.info.raw) != len(good[2])]
        friend.say(
            b"/policy/drive", good[1], bytes(20 << 20)
        )  # beyond the socket's own limit: ends the connection
        assert drives(lab.run(60.0, drives, lambda: friend.say(*good_frames())))  # and the honest go on
    finally:
        friend.close()
    assert "expected three frames" in capfd.readouterr().err


@pytest.mark.parametrize("listens", [True, False])
def test_something_follows_every_message_soon_so_that_tcp_notices_a_loss(listens, tmp_path):
    watch_port, drive_port = free_ports(2)
    context = zmq.Context()
    other = context.socket(zmq.SUB)
    other.subscribe(b"_pulse")
    keys = KeyFolder(tmp_path / "keys")
    public = keys.new("robot").encode()
    keys.allow("robot", DRIVE)
    # One key pair serves both ends.
    secret = keys.secret("robot").encode()
    other.curve_publickey, other.curve_secretkey = public, secret
    if listens:
        other.curve_serverkey = public
    else:
        other.curve_server = True
    if listens:
        other.connect(f"tcp://127.0.0.1:{watch_port}")
    else:
        other.bind(f"tcp://127.0.0.1:{drive_port}")
    config = LinkConfig(
        "127.0.0.1", listens, watch_port, drive_port, keys, "robot", "robot", (), ("/policy/drive",)
    )
    inbox = Inbox(10)
    link = Link(config, inbox)
    try:
        for _ in range(6):  # without pulses nothing comes by itself
            assert other.poll(60_000)
            assert other.recv_multipart() == [b"_pulse"]
    finally:
        link.close()
        inbox.close()
        other.close(linger=0)
        context.term()


def test_without_keys_a_link_carries_nothing_towards_the_end_that_listens():
    watch_port, drive_port = free_ports(2)
    ports = {"watch_port": watch_port, "drive_port": drive_port}
    for config in (
        GatewayConfig(listen="127.0.0.1", imports=("/policy/drive", "/arm"), **ports),
        GatewayConfig(connect="127.0.0.1", exports=("/arm",), **ports),
    ):
        with pytest.raises(
            SecurityError,
            match=r"without keys a link can only be used to watch, .*/arm.* could drive the car",
        ):
            GatewayNode(config, lambda topic: 1)


def test_without_keys_others_watch_and_no_door_leads_in(lab, capfd):
    robot = lab.host("robot", listen="127.0.0.1", exports=("/vicon/car",), keys=None)
    watcher = lab.workstation(exports=(), keys=None)
    robot.eyes.publisher("/vicon/car")
    pose = encode(types.PoseStamped(header=header(0), pose=IDENTITY))
    got = lab.run(
        60.0,
        lambda got: any(r.topic == "/vicon/car" for _, r in got),
        lambda: robot.eyes.publish("/vicon/car", pose),
    )
    assert any(host is watcher and r.topic == "/vicon/car" for host, r in got)
    with socket.socket() as stranger:
        assert stranger.connect_ex(("127.0.0.1", lab.ports[DRIVE])) == errno.ECONNREFUSED
    state, text = robot.node.status()
    assert state == "active"
    assert "can only watch" in text
    said = capfd.readouterr().err
    assert "a connection without a key started" in said
    assert "allowed key" not in said


def connections(ports):
    """Both ends of every established TCP connection of this host to one of the ports, as the kernel writes them."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    wanted = {f"{port:04X}" for port in ports}
    return {(row[1], row[2]) for row in rows if row[3] == "01" and row[2].split(":")[1] in wanted}


def test_whoever_was_let_in_stays_and_does_not_knock_again(lab):
    workstation, ports = lab.workstation(), lab.ports.values()
    lab.robot()
    lab.run(60.0, until=lambda got: len(connections(ports)) == 2)
    before = connections(ports)
    lab.run(1.7)  # an end that was refused knocks again after a second
    assert len(before) == 2
    assert connections(ports) == before
    assert workstation.node.counters()["refused"] == 0


def test_a_topic_that_nobody_reads_does_not_travel(lab):
    robot = lab.robot()
    workstation = lab.workstation(imports=("/camera/image_raw", "/vicon/car"))
    robot.eyes.publisher("/vicon/car")
    got = lab.run(
        60.0,
        lambda got: any(r.topic == "/vicon/car" for _, r in got),
        lambda: robot.eyes.publish("/vicon/car", encode(types.PoseStamped(header=header(0), pose=IDENTITY))),
    )
    assert any(r.topic == "/vicon/car" for _, r in got)
    assert workstation.node._link._doors._subscribed == {"/vicon/car"}


def test_publish_time_moves_to_our_clock_by_its_age():
    meta = Meta(10**18, 5 * NS_PER_S, 7, b"12345678", 9)
    moved = on_our_clock(meta, 5 * NS_PER_S + 200_000_000, 40 * NS_PER_S)
    assert moved.publish_mono_ns == 40 * NS_PER_S - 200_000_000
    assert (moved.publish_real_ns, moved.sequence, moved.instance_id) == (5 * NS_PER_S, 7, 9)
    # A clock that is ahead must not make a message younger than new.
    assert on_our_clock(meta, 4 * NS_PER_S, 40 * NS_PER_S).publish_mono_ns == 40 * NS_PER_S


def exchange(asked_s, there_s, back_s, offset_s, work_s=0.001):
    received = asked_s + there_s + offset_s
    times = (asked_s, received, received + work_s, asked_s + there_s + work_s + back_s)
    return Exchange(*(round(t * NS_PER_S) for t in times))


def test_clock_offset_of_asymmetric_ways_is_within_its_bound_and_follows_a_step():
    rng = np.random.default_rng(3)
    offsets = OffsetFilter()
    for i in range(50):
        there, back = rng.exponential(0.02, 2) + 0.001
        best = offsets.add(exchange(i * 0.2, there, back, 0.05))
        assert abs(best.offset_s - 0.05) <= best.round_trip_s / 2 + 1e-9
    assert best.offset_s == pytest.approx(0.05, abs=0.01)
    stepped = offsets.add(exchange(20.0, 0.002, 0.002, -0.3))
    assert stepped.offset_s == pytest.approx(-0.3, abs=1e-6)


def test_unknown_topic_is_an_error_of_the_configuration():
    with pytest.raises(TopicError, match="unknown topic '/nothing'"):
        GatewayConfig(listen="127.0.0.1", exports=("/nothing",))
