"""When a car counts as stalled, and when it does not: by a car that starts late, drives, and is stopped by a wall."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hardware.worlds.lab.config import CarConfig
from nodes.control.stall_check import StallGate, StallLimits
from tests.support.faulty_devices import JammableVehicle

pytestmark = pytest.mark.live

CAR = CarConfig()


def drive(seconds, command, jams=(), gate=None, dead_s=0.0, blind=(), seed=0):
    """Drive the twin's car; first problem and when it was found [s], or None.

    Args:
        seconds: How long.
        command: Commanded speed at a time [s].
        jams: From when the car is held, and how.
        gate: The gate.
        dead_s: So long the motor does not react at first.
        blind: From when to when motion capture sees nothing.
        seed: Of the noise.
    """
    gate, car, rng = gate or StallGate(StallLimits()), JammableVehicle(CAR), np.random.default_rng(seed)
    for k in range(round(100 * seconds)):
        t = 0.01 * k
        mono_ns = 10**12 + k * 10_000_000
        for start_s, how in jams:
            if t >= start_s:
                car.jam(how)
        if k % 5 == 0:
            gate.commanded(command(t), mono_ns)
            car.command(erpm=CAR.erpm_from_speed(command(t) if t >= dead_s else 0.0))
        state = car.advance(0.01)
        if not any(start <= t < end for start, end in blind):
            gate.pose(*(np.array([state.x_m, state.y_m]) + rng.normal(0.0, 5e-4, 2)), mono_ns)
        if k % 4 == 0:
            gate.motor(car.erpm / CAR.nominal_erpm_gain, mono_ns)
        if problem := gate.problem(mono_ns):
            return t, problem
    return None


@pytest.mark.parametrize(
    ("how", "words"), [("locked", "the car does not move"), ("spinning", "the wheels spin")]
)
@pytest.mark.parametrize("speed", [0.3, 0.8, -0.8, 1.3])
def test_a_jam_is_found_in_its_time(how, words, speed):
    found_s, problem = drive(6.0, lambda t: speed, jams=[(3.0, how)])
    assert 3.95 <= found_s <= 4.2
    assert f"stalled for 1.0 s: commanded {speed:.2f} m/s" in problem
    assert words in problem


@settings(max_examples=20)
@given(
    speed=st.one_of(st.floats(0.0, 1.3), st.floats(-0.87, 0.0)),
    dead_s=st.floats(0.0, 0.6),
    seed=st.integers(0, 1000),
    blind_s=st.floats(0.0, 0.25),
)
def test_no_drive_is_a_stall(speed, dead_s, seed, blind_s):
    blind = [(2.0, 2.0 + blind_s), (2.4, 2.4 + blind_s)]

    def command(t):
        return speed if t < 3.0 else (0.0 if t < 4.0 else -speed)

    assert drive(6.0, command, dead_s=dead_s, blind=blind, seed=seed) is None


def test_a_car_that_nobody_sees_is_judged_by_its_motor():
    found_s, problem = drive(6.0, lambda t: 0.8, jams=[(2.0, "locked")], blind=[(2.0, math.inf)])
    assert 2.95 <= found_s <= 3.3
    assert "the car does not move (the motor controller measures 0.00 m/s)" in problem
    # Wheels that spin are motion as long as nothing sees that the car stands; that it is not seen is another fault.
    assert drive(6.0, lambda t: 0.8, jams=[(2.0, "spinning")], blind=[(2.0, math.inf)]) is None


def test_only_the_sources_that_are_asked_for():
    def drive_by_motor(how):
        gate = StallGate(StallLimits(sources=("erpm",)))
        return drive(4.0, lambda t: 0.8, jams=[(0.0, how)], gate=gate)

    assert drive_by_motor("spinning") is None  # on a stand
    assert "does not move" in drive_by_motor("locked")[1]


def test_a_stop_ends_the_stall():
    gate = StallGate(StallLimits())
    assert drive(4.0, lambda t: 0.8, jams=[(0.0, "locked")], gate=gate) is not None
    gate.stopped()
    assert gate.problem(10**13) == ""


@pytest.mark.parametrize("speed", [math.nan, math.inf])
def test_a_measurement_that_is_no_number_is_no_rest(speed):
    gate = StallGate(StallLimits(sources=("erpm",)))
    for k in range(200):
        gate.commanded(0.8, k * 10_000_000)
        gate.motor(speed, k * 10_000_000)
        assert gate.problem(k * 10_000_000) == ""
