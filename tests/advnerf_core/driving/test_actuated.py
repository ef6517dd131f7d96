"""The late, slow car against numerical integration, automatic differentiation and the simpler models it contains."""

import numpy as np
import pytest
import torch

from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.dynamics import Ackermann

CASES = {
    "nothing": {},
    "whole ticks": {"delay_s": 0.2},
    "a fraction": {"delay_s": 0.03, "lag_s": 0.05},
    "ticks and a fraction, lag, slew": {"delay_s": 0.27, "lag_s": 0.06, "slew_radps": 1.5},
    "slew without lag": {"delay_s": 0.05, "slew_radps": 1.0},
}


def car(**options) -> ActuatedAckermann:
    return ActuatedAckermann(0.25, 0.8, 0.1, **options)


def some(model: ActuatedAckermann, batch: int = 40) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    states = 0.2 * torch.randn(batch, model.state_size, dtype=torch.float64, generator=generator)
    states[:, 4:] = states[:, 4:].clamp(*model.steering_limits_rad)
    return states, 0.25 * torch.randn(batch, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
def test_jacobians_equal_automatic_differentiation(options):
    model = car(**options)
    states, controls = some(model)
    df_dx, df_du = model.jacobians(states, controls)

    def one(state, control):
        return model.step(state[None], control[None])[0]

    for b in range(len(states)):
        expected_dx, expected_du = torch.autograd.functional.jacobian(one, (states[b], controls[b]))
        torch.testing.assert_close(df_dx[b], expected_dx, rtol=1e-10, atol=1e-12)
        torch.testing.assert_close(df_du[b], expected_du, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("options", CASES.values(), ids=CASES)
def test_wheel_and_pose_equal_fine_integration(options):
    """Explicit Euler in 20 000 parts of the servo's own equation; the arc with the mean angle differs at second order."""
    model = car(**options)
    states, controls = (part.numpy() for part in some(model, 12))
    stepped = model.step(torch.from_numpy(states), torch.from_numpy(controls)).numpy()
    x, y, yaw, wheel = states[:, :4].T.copy()
    commands = np.column_stack([np.clip(controls, *model.steering_limits_rad), states[:, 4:]])
    parts = 20_000
    h = model.dt_s / parts
    slew = model.slew_radps or np.inf
    for i in range(parts):
        age = int(np.ceil((model.delay_s - (i + 0.5) * h) / model.dt_s - 1e-9)) if model.delay_s else 0
        error = commands[:, max(age, 0)] - wheel
        rate = np.clip(error / max(model.lag_s, h), -slew, slew)
        angle = wheel + 0.5 * h * rate
        x, y = x + h * model.speed_mps * np.cos(yaw), y + h * model.speed_mps * np.sin(yaw)
        yaw, wheel = yaw + h * model.speed_mps / model.wheelbase_m * np.tan(angle), wheel + h * rate
    np.testing.assert_allclose(stepped[:, 3], wheel, atol=2e-5)
    np.testing.assert_allclose(stepped[:, 2], yaw, atol=2e-3)
    np.testing.assert_allclose(stepped[:, :2], np.column_stack([x, y]), atol=6e-4)


def test_without_options_it_is_the_plain_bicycle_and_with_lag_the_lagging_one():
    states, controls = some(car())
    plain = Ackermann(0.25, 0.8, 0.1).step(states[:, :3], controls)
    torch.testing.assert_close(car().step(states, controls)[:, :3], plain, rtol=0, atol=1e-15)
    # A lag alone: the error decays exponentially, and the arc is that of its mean over the tick.
    lagging, left = car(lag_s=0.08).step(states, controls), np.exp(-0.1 / 0.08)
    command = controls.clamp(*car().steering_limits_rad)
    error = states[:, 3] - command
    torch.testing.assert_close(lagging[:, 3], command + left * error, rtol=0, atol=1e-15)
    arc = Ackermann(0.25, 0.8, 0.1, (-1.5, 1.5)).step(
        states[:, :3], command + (1.0 - left) * 0.08 / 0.1 * error
    )
    torch.testing.assert_close(lagging[:, :3], arc, rtol=0, atol=1e-15)


def test_a_delay_of_whole_ticks_shifts_the_controls():
    late, plain = car(delay_s=0.3), Ackermann(0.25, 0.8, 0.1)
    assert late.state_size == 7  # 0.3 / 0.1 is not 3 in binary, yet it is three ticks
    controls = torch.linspace(-0.2, 0.2, 9, dtype=torch.float64)
    state, expected = torch.zeros(1, 7, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    for tick in range(9):
        state = late.step(state, controls[tick : tick + 1])
        given = controls[tick - 3 : tick - 2] if tick >= 3 else torch.zeros(1, dtype=torch.float64)
        expected = plain.step(expected, given)
        torch.testing.assert_close(state[:, :3], expected, rtol=0, atol=1e-14)


def test_the_wheels_never_turn_faster_than_allowed():
    model = car(slew_radps=0.7, lag_s=0.02)
    states, controls = some(model)
    turned = model.step(states, controls)[:, 3] - states[:, 3]
    assert turned.abs().max() <= 0.07 + 1e-12
    assert turned.abs().max() > 0.069


def test_impossible_cars_are_refused():
    with pytest.raises(ValueError, match="finite delay and lag >= 0"):
        car(delay_s=-0.1)
    with pytest.raises(ValueError, match="expected slew_radps > 0"):
        car(slew_radps=0.0)
    with pytest.raises(ValueError, match=r"expected states \[B, 6\]"):
        car(delay_s=0.15).step(torch.zeros(1, 4), torch.zeros(1))
