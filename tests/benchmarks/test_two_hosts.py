"""The judgement on wire logs written by hand; the moved clock; and one condition with two real hosts."""

import os
import shutil
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from benchmarks import host_pair, two_hosts
from hardware.emulators.vesc_firmware import WireEvent
from tests.support.live.graph import BrokenPromise
from tests.support.live.network import Cable, available

MS = 1_000_000


def row(ms, name, speed, odometer):
    return WireEvent(ms * MS, name), speed, odometer


DRIVING = [row(0, "SET_CURRENT", 0.0, 0.0), row(50, "SET_RPM", 0.0, 0.0), row(900, "SET_RPM", 0.8, 0.5)]
STOPPED = [row(1200, "SET_CURRENT_BRAKE", 0.8, 0.74), row(1400, "STANDSTILL", 0.0, 0.84)]
# Heard 20 ms after they were published; the last one was too old when it came.
COMMANDS = [(920 * MS, 900 * MS), (1150 * MS, 905 * MS)]


def test_time_counts_from_the_last_command_that_was_fresh():
    found = host_pair.stop_of(DRIVING + STOPPED, COMMANDS)
    assert (found["by"], found["brake_ms"]) == ("SET_CURRENT_BRAKE", pytest.approx(300.0))
    assert found["distance_m"] == pytest.approx(0.34)


def test_a_car_that_drives_on_or_never_drove_was_not_stopped():
    assert host_pair.stop_of(DRIVING, COMMANDS) is None
    assert host_pair.stop_of(DRIVING[:1] + STOPPED, COMMANDS) is None


@pytest.mark.parametrize("last", [row(1500, "SET_RPM", 0.0, 0.84), row(1500, "MOVING", 0.1, 0.84)])
def test_moving_again_breaks_the_promise(last):
    with pytest.raises(BrokenPromise, match="1 commands to move came after"):
        host_pair.stop_of([*DRIVING, *STOPPED, last], COMMANDS)


def test_rolling_on_breaks_the_promise():
    with pytest.raises(BrokenPromise, match="still rolls"):
        host_pair.stop_of(DRIVING + STOPPED[:1], COMMANDS)


@pytest.mark.skipif(shutil.which("gcc") is None, reason="no compiler")
def test_the_moved_clock_moves_real_time_only(tmp_path):
    environment = {**os.environ, **host_pair.skewed_clock(tmp_path, 5.0)}
    asked = "import time, datetime; print(time.time(), time.monotonic(), datetime.datetime.now().timestamp())"
    told = subprocess.run(
        [sys.executable, "-c", asked], env=environment, capture_output=True, check=True, text=True
    )
    real, monotonic, date = map(float, told.stdout.split())
    assert real - time.time() == pytest.approx(5.0, abs=1.0)
    assert date - time.time() == pytest.approx(5.0, abs=1.0)
    assert monotonic == pytest.approx(time.monotonic(), abs=1.0)


def test_what_is_finished_is_not_run_again(tmp_path, monkeypatch):
    monkeypatch.setattr(two_hosts, "measure", lambda name, policy: {"condition": name, "met": True})
    assert list(two_hosts.run(tmp_path, two_hosts.POLICY, ["clean", "skew"])) == ["clean", "skew"]
    monkeypatch.setattr(two_hosts, "measure", lambda name, policy: pytest.fail("it ran again"))
    assert two_hosts.run(tmp_path, two_hosts.POLICY, ["skew"]) == {"skew": {"condition": "skew", "met": True}}


@pytest.mark.slow
@pytest.mark.skipif(not available(), reason="needs root, TUN devices and iproute2")
def test_a_stalled_link_stops_the_car():
    circle = (
        "policy.module=tests.support.live.straight_policy",
        "policy.speed_mps=0.8",
        "policy.steering_rad=0.08",  # 7 m between the island and the walls
    )
    result = two_hosts.measure("stall", two_hosts.POLICY, circle)
    assert result["met"], result


def test_ten_short_drives_under_loss_are_no_drive(monkeypatch):
    """Every stop was in time, but the car covered 5 of 32 m."""
    stops = [{"brake_ms": 230.0, "why": "no command from the policy for 0.22 s"}] * 10
    monkeypatch.setattr(two_hosts, "_drive", lambda pair, duration_s: (4.7, stops))
    pair = SimpleNamespace(cable=Cable())
    assert not two_hosts.CONDITIONS["loss_untuned"](pair)["met"]
    monkeypatch.setattr(two_hosts, "_drive", lambda pair, duration_s: (30.7, stops[:1]))
    assert two_hosts.CONDITIONS["loss_untuned"](pair)["met"]
