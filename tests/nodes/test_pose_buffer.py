import numpy as np
import pytest

from advnerf_core.geometry import make_transform, rotation_x, rotation_z, yaw_of
from nodes.control.pose_buffer import PoseBuffer

pytestmark = pytest.mark.live

SPEED_MPS, RADIUS_M = 1.5, 1.0


def on_circle(t_s):
    """A car at 1.5 m/s on a circle of 1 m."""
    angle = SPEED_MPS / RADIUS_M * t_s
    T = make_transform(
        rotation_z(angle + np.pi / 2), [RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), 0.0]
    )
    return T @ make_transform(rotation_x(0.05), [0, 0, 0])


def filled(rate_hz=50.0, until_s=1.0, **options):
    buffer = PoseBuffer(**options)
    for k in range(int(until_s * rate_hz) + 1):
        buffer.add(round(k / rate_hz * 1e9), on_circle(k / rate_hz))
    return buffer


def errors(buffer, times_s, limit_s=0.0):
    found = [buffer.at(round(t * 1e9), limit_s) for t in times_s]
    position = [np.linalg.norm(f.T[:3, 3] - on_circle(t)[:3, 3]) for f, t in zip(found, times_s, strict=True)]
    heading = [abs(yaw_of(f.T) - yaw_of(on_circle(t))) for f, t in zip(found, times_s, strict=True)]
    return np.array(position), np.array(heading)


def test_interpolation_on_a_circle_is_off_by_the_sagitta_only():
    times = np.linspace(0.1, 0.9, 333)
    position, heading = errors(filled(), times)
    sagitta = (SPEED_MPS * 0.02) ** 2 / (8 * RADIUS_M)
    assert position.max() <= sagitta * 1.01  # 0.11 mm
    assert heading.max() < 1e-4
    # The newest pose instead would be off by millimetres.
    newest = np.array(
        [np.linalg.norm(on_circle(np.floor(t * 50) / 50)[:3, 3] - on_circle(t)[:3, 3]) for t in times]
    )
    assert np.median(newest) > 100 * np.median(position)


def test_extrapolation_is_constant_velocity_flagged_and_bounded():
    buffer = filled()
    pose = buffer.at(1_030_000_000, 0.05)
    assert pose.extrapolated_s == pytest.approx(0.03)
    assert np.linalg.norm(pose.T[:3, 3] - on_circle(1.03)[:3, 3]) < 2e-3
    assert buffer.at(1_051_000_000, 0.05) is None
    assert buffer.at(1_030_000_000) is None


def test_stamps_before_the_first_in_gaps_or_without_poses_have_no_pose():
    buffer = filled(max_gap_s=0.1)
    assert buffer.at(-1) is None
    buffer.add(1_500_000_000, on_circle(1.5))
    assert buffer.at(1_250_000_000, 1.0) is None
    assert buffer.at(1_500_000_000) is not None
    assert buffer.at(1_510_000_000, 1.0) is None  # velocity across the gap is not known either
    assert PoseBuffer().at(0, 1.0) is None


def test_the_order_of_arrival_does_not_matter():
    order = np.random.default_rng(0).permutation(51)
    shuffled = PoseBuffer()
    for k in order:
        shuffled.add(round(k / 50 * 1e9), on_circle(k / 50))
        shuffled.add(round(k / 50 * 1e9), np.eye(4))  # a duplicate stamp changes nothing
    ordered = filled()
    for t in np.linspace(0, 1.02, 97):
        a, b = (buffer.at(round(t * 1e9), 0.05) for buffer in (ordered, shuffled))
        assert np.array_equal(a.T, b.T)


def test_old_poses_are_forgotten():
    buffer = filled(until_s=10.0, keep_s=2.0)
    assert len(buffer) == 101
    assert buffer.at(7_900_000_000) is None
    assert buffer.reaches(10_000_000_000)
    assert not buffer.reaches(10_000_000_001)
    buffer.add(1, np.eye(4))
    assert len(buffer) == 101
    with pytest.raises(ValueError, match="expected positive times"):
        PoseBuffer(keep_s=0.0)


@pytest.mark.parametrize("ahead_s", [3.0, 3600.0])
def test_a_pose_of_a_wrong_clock_does_not_lock_out_the_right_ones(ahead_s):
    buffer = filled(until_s=10.0, keep_s=2.0)
    buffer.add(round((10.0 + ahead_s) * 1e9), on_circle(10.0))
    for k in range(1, 20):
        buffer.add(10_000_000_000 + k * 20_000_000, on_circle(10.0 + 0.02 * k))
    assert buffer.reaches(10_380_000_000)
    assert not buffer.reaches(10_380_000_001)
    assert buffer.at(10_250_000_000) is not None
