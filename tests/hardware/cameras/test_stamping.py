"""Stamps of cameras against hand-made clocks."""

import numpy as np
import pytest

from hardware.cameras.stamping import Decimator, Stamper

pytestmark = pytest.mark.live

S = 1_000_000_000


class Clocks:
    def __init__(self):
        self.mono_ns, self.real_ns = 500 * S, 1_700_000_000 * S
        self.stamper = Stamper(lambda: self.mono_ns, lambda: self.real_ns)

    def at(self, seconds, stamp_ns):
        self.mono_ns, self.real_ns = 500 * S + round(seconds * S), 1_700_000_000 * S + round(seconds * S)
        return self.stamper.convert(stamp_ns)


def test_monotonic_stamp_keeps_its_instant_on_both_clocks():
    assert Clocks().at(0.1, 500 * S + 70_000_000) == (1_700_000_000 * S + 70_000_000, 500 * S + 70_000_000)


def test_stamp_of_the_real_time_clock_is_recognised():
    assert Clocks().at(0.1, 1_700_000_000 * S + 70_000_000) == (
        1_700_000_000 * S + 70_000_000,
        500 * S + 70_000_000,
    )


@pytest.mark.parametrize("stamp_ns", [None, 3 * S, 900 * S])
def test_device_without_a_usable_clock_is_stamped_on_receipt(stamp_ns):
    clocks = Clocks()
    assert clocks.at(0.1, stamp_ns) == (1_700_000_000 * S + 100_000_000, 500 * S + 100_000_000)
    assert clocks.stamper.replaced == 1


def test_stamp_slightly_ahead_is_now():
    assert Clocks().at(0.1, 500 * S + 102_000_000)[1] == 500 * S + 100_000_000


def test_old_frame_of_a_believed_device_is_never_made_to_look_fresh():
    clocks = Clocks()
    assert clocks.at(0.0, 500 * S - 10_000_000)
    assert clocks.at(3.0, 500 * S + 1) is None
    assert clocks.stamper.refused == 1
    assert clocks.at(3.1, 503 * S) is not None


def test_clock_that_jumped_is_given_up_after_ten_frames_and_taken_back():
    clocks = Clocks()
    assert clocks.at(0.0, 500 * S - 1)
    answers = [clocks.at(0.1 * k, 100 * S + k) for k in range(1, 13)]
    assert answers[:10] == [None] * 10
    assert answers[10][1] == 500 * S + round(1.1 * S)
    assert clocks.at(2.0, 502 * S - 5)[1] == 502 * S - 5


def test_results_never_go_back_across_a_restart():
    clocks = Clocks()
    first = clocks.at(0.5, 500 * S + 490_000_000)
    clocks.stamper.restart()
    second = clocks.at(0.6, 500 * S + 400_000_000)
    assert second[1] > first[1]


@pytest.mark.parametrize(
    ("source_hz", "jitter_s"), [(30.0, 0.004), (15.0, 0.0), (60.0, 0.002), (29.97, 0.001), (10.0, 0.01)]
)
def test_decimated_rate_and_spacing(source_hz, jitter_s):
    rng = np.random.default_rng(1)
    times = np.arange(round(60 * source_hz)) / source_hz
    stamps = 500 * S + np.round((times + rng.uniform(-jitter_s, jitter_s, times.size)) * 1e9).astype(np.int64)
    decimator = Decimator(10.0, source_hz)
    kept = [int(stamp) for stamp in stamps if decimator.slot(int(stamp)) is not None]
    assert abs(len(kept) - 600) <= (600 * jitter_s * source_hz / 2 if source_hz == 10.0 else 2)
    gaps = np.diff(kept) / 1e9
    assert gaps.max() < 0.1 + 1.01 / source_hz + 2 * jitter_s


def test_decimator_refuses_a_higher_rate():
    with pytest.raises(ValueError, match="at most that of the device, 15 Hz; got 30 Hz"):
        Decimator(30.0, 15.0)
