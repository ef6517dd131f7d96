import numpy as np
import pytest

from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.strict import within_a_turn
from calibration import path_fit
from calibration.degeneracy import DegenerateDataError
from calibration.path_fit import driven_part, fit_path, require_forward

SQUARE = Path.rounded_square(4.0, 1.1)


def driven(path, laps=1.0, start_s=0.0, noise_m=0.002, seed=0, step_m=0.008, wobble_m=0.0):
    """What motion capture records at 100 Hz and 0.8 m/s."""
    s = start_s + np.arange(0.0, laps * path.length_m, step_m)
    pose = path.pose_at(s)
    rng = np.random.default_rng(seed)
    normal = np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2])], axis=1)
    sway = wobble_m * np.sin(s / 0.7)[:, None] * normal
    return pose[:, :2] + sway + rng.normal(0.0, noise_m, (len(s), 2))


def distance(fitted, truth):
    """Greatest distance of the fitted path from the true one [m]."""
    return np.abs(truth.project(fitted.pose_at(np.linspace(0.0, fitted.length_m, 500))[:, :2]).cte_m).max()


@pytest.mark.parametrize(("laps", "start_s"), [(1.05, 0.0), (3.1, 0.9), (1.1, 2.6)])
def test_the_track_comes_back_wherever_the_trace_begins(laps, start_s):
    fit = fit_path(driven(SQUARE, laps, start_s))
    assert fit.path.closed
    assert len(fit.path.segments) == 8
    assert distance(fit.path, SQUARE) < 0.01
    radii = [piece.radius_m for piece in fit.path.segments if isinstance(piece, Arc)]
    np.testing.assert_allclose(radii, 1.1, atol=0.05)
    assert fit.path.length_m == pytest.approx(SQUARE.length_m, abs=0.03)
    assert fit.rms_m < 0.003
    # Closed to the path's own tolerance, or Path would have refused it; and tangents continue by construction.
    end = fit.path.pose_at(fit.path.length_m - 1e-9)
    np.testing.assert_allclose(end[:2], fit.path.pose_at(0.0)[:2], atol=1e-6)


@pytest.mark.parametrize("turned", [1, -1])
@pytest.mark.parametrize("start_s", 0.7 + np.linspace(0.0, SQUARE.length_m, 9)[:-1])
def test_a_lap_begun_anywhere_in_either_direction_gives_a_path_that_a_room_may_have(start_s, turned):
    """Its start heads within a turn: the heading along the trace goes on counting."""
    truth = (
        SQUARE if turned == 1 else Path.from_segments((0.0, 2.0, 0.0), 4 * [Line(1.8), Arc(1.1, -np.pi / 2)])
    )
    fit = fit_path(driven(truth, 1.1, start_s))
    assert distance(fit.path, truth) < 0.01
    assert abs(within_a_turn(fit.path.start_pose[2])) <= np.pi + 0.01


def test_a_car_that_was_pulled_backwards_gives_no_path():
    poses = SQUARE.pose_at(np.arange(0.0, SQUARE.length_m, 0.01))
    require_forward(poses[:, :2], poses[:, 2])
    require_forward(poses[:, :2], poses[:, 2] + 1.2)  # a subject that is turned, or a car that drifts
    with pytest.raises(DegenerateDataError, match="nose points against its way on 100 % of it"):
        require_forward(poses[::-1, :2], poses[::-1, 2])


def test_a_car_that_was_carried_to_the_lap_and_away_is_measured_where_it_drove():
    """It stood on a desk for a minute first; the way through the air was fitted as a part of the path."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 2.3 * np.pi, 900)
    lap = np.stack(
        [2.0 * np.sin(angle), -2.0 * np.cos(angle), 0.01 * np.sin(angle)], axis=1
    )  # a tilted frame
    desk = np.tile([-4.0, -2.6, 0.7], (6000, 1))
    there = np.linspace([-4.0, -2.6, 0.6], [0.0, -2.0, 0.6], 200)
    away = np.linspace([*lap[-1, :2], 0.6], [-4.0, -2.6, 0.7], 250)
    recorded = np.concatenate([desk, there, lap, away])
    recorded += rng.normal(0.0, 0.0005, recorded.shape)
    assert driven_part(recorded) == slice(6200, 7100)
    assert driven_part(lap) == slice(0, 900)


def test_a_way_there_and_back_gives_no_path_where_nobody_was():
    """Each point of the trace is on such a path, and the half of it is beyond the trace's end."""
    along = np.concatenate([np.arange(-2.0, 2.0, 0.008), np.arange(2.0, -2.0, -0.008)])
    noise = np.random.default_rng(0).normal(0.0, 0.002, (len(along), 2))
    with pytest.raises(DegenerateDataError, match=r"there and back\? Drive it in one direction"):
        fit_path(np.stack([along, np.zeros_like(along)], axis=1) + noise)


@pytest.mark.parametrize("turn_rad", [0.8, 1.57])
def test_a_way_there_and_back_with_a_turn_gives_no_path(turn_rad):
    """It is nowhere far from the trace, and turns back with a radius of 0.1 m at its end."""
    way = Path.from_segments((0.0, 0.0, 0.0), [Line(1.5), Arc(0.8, turn_rad), Line(1.5)], closed=False)
    there = way.pose_at(np.arange(0.0, way.length_m, 0.008))[:, :2]
    both = np.concatenate([there, there[::-1]])
    noise = np.random.default_rng(0).normal(0.0, 0.002, both.shape)
    with pytest.raises(DegenerateDataError, match="in one direction"):
        fit_path(both + noise)


@pytest.mark.parametrize("radius_m", [0.25, 0.4])
def test_the_turns_of_small_cars_are_drivable(radius_m):
    track = Path.from_segments(
        (0.0, 0.0, 0.0), [Line(1.0), Arc(radius_m, np.pi), Line(1.0), Arc(radius_m, np.pi)], closed=True
    )
    assert fit_path(driven(track, 1.05)).rms_m < 0.02


def test_standing_still_before_and_after_changes_nothing():
    rng = np.random.default_rng(1)
    trace = driven(SQUARE, 1.05)
    still = [
        np.repeat(point[None], 300, axis=0) + rng.normal(0, 0.001, (300, 2))
        for point in (trace[0], trace[-1])
    ]
    fit = fit_path(np.concatenate([still[0], trace, still[1]]))
    assert distance(fit.path, SQUARE) < 0.01


def test_an_open_path_with_both_turns():
    truth = Path.from_segments(
        (0.5, -1.0, 0.4), [Line(1.5), Arc(0.8, 1.2), Line(1.0), Arc(1.5, -0.9), Line(0.7)], closed=False
    )
    fit = fit_path(driven(truth))
    assert not fit.path.closed
    assert [type(piece) for piece in fit.path.segments] == [Line, Arc, Line, Arc, Line]
    assert distance(fit.path, truth) < 0.01
    assert fit.path.length_m == pytest.approx(truth.length_m, abs=0.06)
    assert [piece.angle_rad for piece in fit.path.segments[1::2]] == pytest.approx([1.2, -0.9], abs=0.06)


def test_a_clockwise_circle_and_a_swaying_driver():
    circle = Path.from_segments((0.0, 1.5, 0.0), [Arc(1.5, -2.0 * np.pi)], closed=True)
    fit = fit_path(driven(circle, 2.05))
    assert distance(fit.path, circle) < 0.01
    swaying = fit_path(driven(SQUARE, 3.05, wobble_m=0.02))
    assert distance(swaying.path, SQUARE) < 0.04
    assert 0.005 < swaying.rms_m < 0.03


def test_traces_that_are_none_are_refused_with_the_reason(monkeypatch):
    with pytest.raises(DegenerateDataError, match="at least 1 m"):
        fit_path(np.random.default_rng(0).normal(0.0, 0.002, (500, 2)))
    with pytest.raises(DegenerateDataError, match=r"ends are \d.\d+ m apart"):
        fit_path(driven(SQUARE, 0.6), closed=True)
    with pytest.raises(DegenerateDataError, match="finite positions"):
        fit_path([[0.0, np.nan], [1.0, 1.0]])
    s = np.linspace(0.0, 6.0, 800)
    zigzag = np.stack([s, 0.3 * np.abs((s / 0.25) % 2 - 1)], axis=1)
    with pytest.raises(DegenerateDataError, match=r"needs \d+ lines and arcs on"):
        fit_path(zigzag)
    wavy = np.stack([s, 0.1 * np.sin(s / 0.5)], axis=1)
    monkeypatch.setattr(path_fit, "_WORST_RMS_M", 0.0005)
    with pytest.raises(DegenerateDataError, match="lines and arcs leave"):
        fit_path(wavy)


def test_jumps_and_lengths_that_no_track_has_are_refused_at_once():
    """Ten of 670 positions off by a metre had kept the fit busy for minutes."""
    trace = SQUARE.pose_at(np.arange(0.0, SQUARE.length_m, 0.02))[:, :2]
    hidden = trace.copy()
    hidden[50::60] += [1.0, 0.0]
    with pytest.raises(
        DegenerateDataError,
        match=r"within 0\.5 m, got \d+ jumps of up to 1\.0\d m, the largest at \(.*\) m: was the subject hidden",
    ):
        fit_path(hidden)
    with pytest.raises(DegenerateDataError, match=r"at most 500 m, got 1\d\d\d m: are its positions in m"):
        fit_path(10.0 * SQUARE.pose_at(np.arange(0.0, 10.0 * SQUARE.length_m, 0.02))[:, :2])
    wild = np.random.default_rng(0).uniform(-1.0, 1.0, (4000, 2)).cumsum(axis=0) * 0.1
    with pytest.raises(DegenerateDataError, match=r"this trace needs \d+ lines and arcs"):
        fit_path(wild, closed=False)
