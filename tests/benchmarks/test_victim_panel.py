"""The matrix of a panel of victims, against numbers by hand."""

import numpy as np
import pytest

from benchmarks.victim_panel import claim_rows, excess_m, off_track, picture, rows_of, share_kept


def drives(totals, off):
    return [{"total_cte_m": total, "off_track": each} for total, each in zip(totals, off, strict=True)]


FOUND = {
    "victims": ["soft", "stiff"],
    "ticks": 10,
    "none": drives([[1.0, 3.0], [2.0, 2.0]], [[False, False]] * 2),
    "soft": drives([[11.0, 13.0], [4.0, 6.0]], [[True, True], [False, False]]),
    "stiff": drives([[3.0, 5.0], [5.0, 9.0]], [[False, False], [False, True]]),
}


def test_rows_are_attacked_and_columns_driven_victims():
    excess = excess_m(FOUND)
    assert excess == pytest.approx(np.array([[1.0, 0.3], [0.2, 0.5]]))
    assert off_track(FOUND).tolist() == [[1.0, 0.0], [0.0, 0.5]]
    assert share_kept(excess) == pytest.approx((0.3 + 0.2) / (1.0 + 0.5))
    soft, stiff, others = rows_of(FOUND)
    assert (soft.value, stiff.value, others.value) == (1.0, 0.5, 0.333)
    assert "50 % of its drives off the track; past the attacks on others 0.300 to 0.300 m" in stiff.note
    texts = {text.get_text() for text in picture(FOUND["victims"], excess, off_track(FOUND)).axes[0].texts}
    assert texts == {"1.00\n100 %", "0.30\n0 %", "0.20\n0 %", "0.50\n50 %"}


def test_rows_of_the_claim_are_its_numbers():
    each = [
        {"victim": "soft", "difference_m": 0.25, "off_track_points": 100.0},
        {"victim": "stiff", "difference_m": -0.05, "off_track_points": 0.0},
    ]
    points, metres = claim_rows(
        {"each": each, "off_track_points": 50.0, "difference_m": 0.1, "low_m": -0.02, "high_m": 0.22}
    )
    assert (points.value, points.note) == (50, "soft +100, stiff +0")
    assert (metres.value, metres.unit) == (-0.02, "m per tick")
    assert metres.note == "+0.100 m in the mean, to +0.220; soft +0.250, stiff -0.050"
