"""Codes, sessions, host names and origins."""

import itertools
import socket

import pytest

from nodes.operator_page.certificate import certificate
from nodes.operator_page.doors import Sessions, host_is_ours, origin_is_ours, peer_is_same_user

S = 1_000_000_000


def test_a_code_opens_once():
    doors = Sessions(code_s=300.0)
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
    doors = Sessions(code_s=300.0)
    doors.renew(0)
    assert doors.enter(doors.code, "10.0.0.7", 301 * S) == ""


def guess(doors, address, ns, code="AAAAAAAA"):
    """One attempt as the server makes it. Returns the time at which it was looked at [ns] and the token; None if it must wait."""
    if doors.wait_s(address, ns):
        return None
    ns += round(doors.turn_s(address, ns) * S)
    return ns, doors.enter(code, address, ns)


def test_wrong_codes_of_one_address_wait_longer_and_longer_and_void_nothing():
    doors = Sessions(code_s=1e9)
    doors.renew(0)
    code, ns, looked_at = doors.code, 0, []
    while ns < 600 * S:
        if found := guess(doors, "10.0.0.66", ns):
            looked_at.append(found[0])
        ns += S // 10
    gaps = [(b - a) / S for a, b in itertools.pairwise(looked_at)]
    assert gaps[:7] == pytest.approx([0.1, 0.1, 1.0, 2.0, 4.0, 8.0, 16.0], abs=0.11)
    assert set(gaps[7:]) == {30.0}
    assert doors.code == code
    assert guess(doors, "10.0.0.7", ns, code)[1], "another address opens at once"


def test_many_strangers_slow_a_code_down_and_never_void_it():
    """Ten thousand addresses guess at once: the operator's code still opens, after the turns that were taken before it."""
    doors = Sessions(code_s=1e9)
    doors.renew(0)
    code = doors.code
    for number in range(50):
        assert guess(doors, f"10.{number // 250}.0.{number % 250}", 0)[1] == ""
    ns, token = guess(doors, "192.168.1.7", 0, code)
    assert token
    assert ns / S == pytest.approx(5.0, abs=0.11)
    looked_at = sorted(guess(doors, f"11.{n >> 16}.{n >> 8 & 255}.{n & 255}", 0)[0] for n in range(5000))
    per_code = 300.0 / ((looked_at[-1] - looked_at[0]) / S / (len(looked_at) - 1))
    assert per_code / 2**40 < 3e-9, "the chance to guess one code"
    assert len(doors._guessers) <= 4096


def test_sessions_are_untouched_by_wrong_codes():
    doors = Sessions()
    token = doors.admit("10.0.0.7", 0)
    for _ in range(2000):
        doors.enter("AAAAAAAA", "10.0.0.7", 1)
    assert doors.knows(token, "10.0.0.7", 1)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("10.0.0.1", "10.0.0.2", False),
        ("2001:db8::1", "2001:db8::ffff:1", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("::ffff:10.0.0.1", "10.0.0.1", True),
        ("::ffff:10.0.0.1", "::ffff:10.0.0.2", False),
        ("fe80::1%eth0", "fe80::2%eth0", True),
    ],
)
def test_guesses_count_for_an_address_or_for_a_network_that_one_host_can_fill(one, other, same):
    doors = Sessions()
    for _ in range(10):
        doors.enter("AAAAAAAA", one, 1)
    assert (doors.wait_s(other, 1) > 0.0) == same


def test_no_code_is_no_empty_code():
    assert Sessions().enter("", "10.0.0.7", 1) == ""
    assert not Sessions().knows("", "10.0.0.7", 1)


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
