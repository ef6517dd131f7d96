import numpy as np
import pytest
import torch

from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.dynamics import Ackermann, Dynamics
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.path import Arc, Path

TRACK = Path.rounded_square(4.0, 1.1)
PLAIN = Ackermann(0.25, 0.8, 0.1)
LAGGED = ActuatedAckermann(0.25, 0.8, 0.1, lag_s=0.10)


def _drive(dynamics: Dynamics, starts: np.ndarray, steps: int, delay_s: float) -> np.ndarray:
    """Cross-track errors ``[steps, B]`` of the expert in closed loop."""
    expert = Expert(TRACK, ExpertConfig(delay_s=delay_s))
    states = torch.zeros(len(starts), dynamics.state_size, dtype=torch.float64)
    states[:, :3] = torch.from_numpy(starts)
    ctes = []
    for _ in range(steps):
        states = dynamics.step(states, torch.from_numpy(expert.steer_states(states.numpy())))
        ctes.append(TRACK.project(states[:, :2].numpy()).cte_m)
    return np.stack(ctes)


@pytest.mark.parametrize(("dynamics", "delay_s"), [(PLAIN, 0.05), (LAGGED, 0.15)])
def test_three_laps_stay_on_the_line(dynamics: Dynamics, delay_s: float) -> None:
    steps = int(3 * TRACK.length_m / 0.08)
    ctes = np.abs(_drive(dynamics, np.array([[-1.1, -2.0, 0.0]]), steps, delay_s))
    assert ctes.mean() < 0.03
    assert ctes.max() < 0.06


@pytest.mark.parametrize(("dynamics", "delay_s"), [(PLAIN, 0.05), (LAGGED, 0.15)])
def test_recovers_from_large_offsets(dynamics: Dynamics, delay_s: float) -> None:
    offsets = [(s, e, p) for s in (0.5, 2.5, 5.0) for e in (-0.4, 0.0, 0.4) for p in (-0.5, 0.0, 0.5)]
    poses = TRACK.pose_at([s for s, _, _ in offsets])
    for pose, (_, lateral, heading) in zip(poses, offsets, strict=True):
        pose[:2] += lateral * np.array([-np.sin(pose[2]), np.cos(pose[2])])
        pose[2] += heading
    ctes = np.abs(_drive(dynamics, poses, 100, delay_s))
    assert ctes.max() < 0.8
    assert ctes[90:].max() < 0.03


def test_steering_is_continuous_in_the_pose() -> None:
    expert = Expert(TRACK)
    s = np.linspace(0.0, TRACK.length_m, 20_000)
    pose = TRACK.pose_at(s)
    for lateral in (-0.3, 0.0, 0.3):
        steering = expert.steer(
            pose[:, 0] - lateral * np.sin(pose[:, 2]), pose[:, 1] + lateral * np.cos(pose[:, 2]), pose[:, 2]
        )
        # Half a millimetre on: at most the slope of the smoothed curvature step.
        assert np.abs(np.diff(steering)).max() < 0.002


def test_feed_forward_is_the_corner_and_limits_hold() -> None:
    expert = Expert(TRACK)
    x, y, yaw = TRACK.pose_at(1.8 + 0.5 * 1.1 * np.pi / 2)
    assert float(expert.steer(x, y, yaw)) == pytest.approx(np.arctan(0.25 / 1.1), abs=1e-6)
    far = expert.steer(np.array([-1.0, -1.0]), np.array([-3.0, -1.2]), np.array([-1.5, 1.5]))
    assert far.tolist() == [0.29, -0.26]


def test_without_feed_forward_it_runs_wide_by_the_stated_offset() -> None:
    circle = Path.from_segments((0.0, -5.0, 0.0), [Arc(5.0, 2.0 * np.pi)])
    expert = Expert(circle, ExpertConfig(feed_forward=0.0, delay_s=0.0, max_approach_rad=50.0))
    # At the stated offset outside the circle, driving along it, the steering is that of the circle's own curvature.
    x, y, yaw = 0.0, -5.0 - 0.2, 0.0
    assert float(expert.steer(x, y, yaw)) == pytest.approx(np.arctan(0.25 / 5.0), rel=1e-3)


def test_bad_settings_are_refused() -> None:
    with pytest.raises(ValueError, match="expected positive expert settings"):
        ExpertConfig(stiffness_1pm=0.0)
