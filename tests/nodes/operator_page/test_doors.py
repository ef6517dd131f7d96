"""Codes, sessions, host names and origins."""

import socket

import pytest

from nodes.operator_page.certificate import certificate
from nodes.operator_page.doors import Doors, host_is_ours, origin_is_ours, peer_is_same_user

S = 1_000_000_000


def test_a_code_opens_once():
    doors = Doors(code_s=300.0)
    assert doors.renew(0)
    code = doors.code
    assert not doors.renew(299 * S)
    token = doors.enter(f" {code[:4].lower()}-{code[4:]} ", "10.0.0.7", 1 * S)
    assert doors.knows(token, "10.0.0.7", 2 * S)
    assert not doors.knows(token, "10.0.0.8", 2 * S)
    assert not doors.knows(token, "10.0.0.7", 13 * 3600 * S)
    assert doors.enter(code, "10.0.0.7", 2 * S) == ""
    assert doors.renew(2 * S)
    assert doors.code != code


def test_an_expired_code_opens_nothing():
    doors = Doors(code_s=300.0)
    doors.renew(0)
    assert doors.enter(doors.code, "10.0.0.7", 301 * S) == ""
    assert doors.refused == 1


def test_a_code_is_replaced_after_a_thousand_wrong_ones():
    doors = Doors()
    doors.renew(0)
    code = doors.code
    for _ in range(1000):
        assert doors.enter("AAAAAAAA", "10.0.0.7", 1) == ""
    assert doors.enter(code, "10.0.0.7", 1) == ""
    assert doors.renew(1)


def test_no_code_is_no_empty_code():
    assert Doors().enter("", "10.0.0.7", 1) == ""
    assert not Doors().knows("", "10.0.0.7", 1)


@pytest.mark.parametrize(
    "host", ["127.0.0.1:8090", "localhost:8090", "192.168.1.20", "[::1]:8090", f"{socket.gethostname()}:1"]
)
def test_hosts_of_this_computer(host):
    assert host_is_ours(host)


@pytest.mark.parametrize(
    "host",
    [
        "",
        "evil.example",
        "evil.example:8090",
        "localhost.evil.example",
        "a@127.0.0.1",
        "127.0.0.1:x",
        "127.0.0.1/x",
    ],
)
def test_hosts_of_others(host):
    assert not host_is_ours(host)


def test_a_further_name_must_be_given():
    assert host_is_ours("robot.lab:8090", ("robot.lab",))
    assert not host_is_ours("robot.lab:8090")


def test_origins():
    assert origin_is_ours("http://127.0.0.1:8090", "127.0.0.1:8090", tls=False)
    for origin in (
        None,
        "null",
        "https://127.0.0.1:8090",
        "http://127.0.0.1:8091",
        "http://localhost:8090",
        "http://evil.example",
    ):
        assert not origin_is_ours(origin, "127.0.0.1:8090", tls=False)


def test_a_connection_of_this_user_is_known_by_the_kernel():
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        socket.create_connection(server.getsockname()) as client,
    ):
        accepted, peer = server.accept()
        with accepted:
            assert peer == client.getsockname()
            assert peer_is_same_user(peer, accepted.getsockname())
            assert not peer_is_same_user(("127.0.0.1", 1), accepted.getsockname())


def test_the_certificate_is_made_once_and_its_key_is_private(tmp_path):
    pytest.importorskip("cryptography")
    first = certificate(tmp_path / "page")
    assert first.key_file.stat().st_mode & 0o777 == 0o600
    assert len(first.fingerprint) == 3 * 32 - 1
    assert certificate(tmp_path / "page") == first
