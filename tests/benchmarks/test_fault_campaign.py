"""The campaign's judgement on wire logs written by hand, and two faults on the real graph."""

import json
import shutil

import pytest

from benchmarks.fault_campaign import FAULTS, judge, plan, run
from benchmarks.fault_stops import BrokenPromise
from hardware.emulators.vesc_firmware import WireEvent


def row(ms, name, speed, odometer):
    return WireEvent(ms * 1_000_000, name), speed, odometer


DRIVING = [row(0, "MOVING", 0.1, 0.0), row(900, "SET_RPM", 0.8, 0.5)]
STOPPED = [
    row(1200, "SET_CURRENT_BRAKE", 0.8, 0.74),
    row(1400, "STANDSTILL", 0.0, 0.84),
    row(2200, "SET_CURRENT", 0.0, 0.84),
]


def test_times_and_distances():
    found = judge("hang camera", DRIVING + STOPPED, 1_000_000_000, armed=False)
    assert (found["by"], found["stop_ms"]) == ("SET_CURRENT_BRAKE", pytest.approx(200.0))
    # 0.1 s at 0.8 m/s had passed since the last row before the fault.
    assert found["distance_m"] == pytest.approx(0.84 - 0.58)


@pytest.mark.parametrize(
    ("rows", "armed"),
    [
        (DRIVING, False),
        (DRIVING + STOPPED[:1], False),
        (DRIVING + STOPPED, True),
        ([*DRIVING, *STOPPED, row(2500, "SET_RPM", 0.0, 0.84)], False),
        ([*DRIVING, *STOPPED, row(2500, "MOVING", 0.1, 0.84)], False),
    ],
)
def test_what_breaks_the_promise(rows, armed):
    with pytest.raises(BrokenPromise):
        judge("hang camera", rows, 1_000_000_000, armed)


def test_every_kind_of_fault_is_in_the_plan_about_equally_often():
    faults = [fault for fault, _ in plan(200)]
    assert set(faults) == set(FAULTS)
    assert max(map(faults.count, FAULTS)) - min(map(faults.count, FAULTS)) <= 1
    assert plan(200) == plan(200)
    assert plan(50) == plan(200)[:50]
    assert all(0.6 <= drive_s <= 1.6 for _, drive_s in plan(200))


@pytest.mark.slow
def test_a_campaign_goes_on_where_it_was(tmp_path):
    first = run(tmp_path, 2)
    assert all("broken" not in result for result in first)
    kept = (tmp_path / "000.json").read_bytes()
    shutil.copy(tmp_path / "001.json", tmp_path / "002.json")
    assert run(tmp_path, 3)[:2] == first  # nothing is left to do, and nothing is started
    assert (tmp_path / "000.json").read_bytes() == kept
    assert json.loads(kept)["fault"] == plan(1)[0][0]
