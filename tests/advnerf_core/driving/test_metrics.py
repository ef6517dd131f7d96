import numpy as np
import pytest

from advnerf_core.driving.metrics import (
    Horizon,
    drive_metrics,
    first_still_tick,
    metrics_of_drives,
    states_at_ticks,
)
from advnerf_core.driving.path import Arc, Line, Path

LINE = Path.from_segments((0.0, 0.0, 0.0), [Line(100.0)], closed=False)


def _states(offsets: list[float]) -> np.ndarray:
    return np.array([[0.08 * k + 1.0, offset, 0.0] for k, offset in enumerate(offsets)])


def test_sum_of_magnitudes_without_the_start() -> None:
    result = drive_metrics(LINE, _states([9.0, 0.1, -0.2, 0.3]), Horizon(ticks=3))
    assert result.total_cte_m == pytest.approx(0.6)
    assert result.mean_cte_m == pytest.approx(0.2)
    assert result.max_cte_m == pytest.approx(0.3)
    assert (result.off_track, result.time_to_leaving_s, result.held_ticks) == (False, None, 0)
    assert result.ctes_m == pytest.approx((0.1, -0.2, 0.3))
    assert drive_metrics(LINE, _states([9.0, 0.1, -0.2, 0.3]), Horizon(ticks=2)).total_cte_m == pytest.approx(
        0.3
    )


def test_a_stopped_car_keeps_its_last_error_up_to_the_cap() -> None:
    early = drive_metrics(LINE, _states([0.0, 0.2, 0.5]), Horizon(ticks=10))
    assert early.total_cte_m == pytest.approx(0.2 + 9 * 0.5)
    assert (early.held_ticks, early.time_to_leaving_s) == (8, pytest.approx(0.2))
    far = drive_metrics(LINE, _states([0.0, 2.0]), Horizon(ticks=10))
    assert far.total_cte_m == pytest.approx(2.0 + 9 * 1.5)
    told = drive_metrics(LINE, _states([0.0, -2.0, -3.0, -3.0]), Horizon(ticks=3), stopped_tick=1)
    assert told.total_cte_m == pytest.approx(2.0 + 2 * 1.5)
    assert told.ctes_m[-1] == pytest.approx(-1.5)


def test_drives_of_one_path_are_measured_together_as_each_alone() -> None:
    winding = Path.from_segments((0.0, 0.0, 0.3), [Line(1.0), Arc(0.8, 1.2), Line(0.5)], closed=False)
    rng = np.random.default_rng(0)
    drives = [np.cumsum(rng.normal(0.1, 0.1, (ticks, 3)), axis=0) for ticks in (2, 9, 5, 12)]
    stopped = [None, 3, 0, 40]
    together = metrics_of_drives(winding, drives, Horizon(ticks=8), stopped)
    alone = [
        drive_metrics(winding, one, Horizon(ticks=8), tick) for one, tick in zip(drives, stopped, strict=True)
    ]
    assert together == alone
    assert [each.held_ticks for each in together] == [7, 5, 7, 0]
    assert metrics_of_drives(winding, []) == []


def test_standing_is_recognised() -> None:
    moving = _states([0.0] * 6)
    assert first_still_tick(moving) is None
    standing = np.concatenate([moving, np.repeat(moving[-1:], 4, axis=0)])
    assert first_still_tick(standing) == 5
    assert first_still_tick(standing[:8]) == 5
    assert first_still_tick(standing[:7]) is None


def test_stream_is_interpolated_at_the_ticks() -> None:
    rng = np.random.default_rng(0)
    seconds = np.sort(np.concatenate([rng.uniform(0.0, 2.0, 200), [0.0, 2.0]]))
    stamps = 1_700_000_000_000_000_000 + np.round(seconds * 1e9).astype(np.int64)
    yaw = 3.0 + 0.5 * seconds  # crosses pi
    poses = np.stack([0.8 * seconds, -0.1 * seconds, (yaw + np.pi) % (2 * np.pi) - np.pi], axis=1)
    start = 1_700_000_000_000_000_000 + 55_000_000
    states = states_at_ticks(stamps, poses, start, Horizon(ticks=15))
    ticks = 0.055 + 0.1 * np.arange(16)
    np.testing.assert_allclose(states, np.stack([0.8 * ticks, -0.1 * ticks, 3.0 + 0.5 * ticks], 1), atol=1e-7)
    assert len(states_at_ticks(stamps, poses, start, Horizon(ticks=60))) == 20


def test_bad_streams_are_explained() -> None:
    stamps, poses = np.arange(5) * 10**9, np.zeros((5, 3))
    with pytest.raises(ValueError, match=r"no gap over 0\.5 s"):
        states_at_ticks(stamps, poses, 0)
    with pytest.raises(ValueError, match="strictly increasing"):
        states_at_ticks(stamps[::-1], poses, 0)
    with pytest.raises(ValueError, match="covers the start"):
        states_at_ticks(stamps, poses, -1)
    with pytest.raises(ValueError, match="finite states"):
        drive_metrics(LINE, [[0.0, np.nan], [0.0, 0.0]])
    with pytest.raises(ValueError, match="at least one tick"):
        Horizon(ticks=0)
