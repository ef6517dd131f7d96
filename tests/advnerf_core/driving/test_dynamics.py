import pytest
import torch
from torch.autograd.functional import jacobian

from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.dynamics import Ackermann, Dubins, Dynamics

ACKERMANN = Ackermann(wheelbase_m=0.25, speed_mps=0.8, dt_s=0.1)
MODELS = [Dubins(0.8, 0.1), ACKERMANN, ActuatedAckermann(0.25, 0.8, 0.1, lag_s=0.08), Dubins(8.0, 0.5)]


def _batch(model: Dynamics, controls: list[float]) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(3)
    u = torch.tensor(controls, dtype=torch.float64)
    x = torch.randn(len(u), model.state_size, dtype=torch.float64, generator=generator)
    if model.state_size == 4:
        x[:, 3] *= 0.1
    return x, u


@pytest.mark.parametrize("model", MODELS)
def test_jacobians_equal_autograd_and_finite_differences(model: Dynamics) -> None:
    x, u = _batch(model, [0.0, 1e-9, -1e-5, 0.01, 0.2, -0.2, 0.25])
    df_dx, df_du = model.jacobians(x, u)
    eps = 1e-6
    for b in range(len(u)):
        auto_x, auto_u = jacobian(lambda a, c: model.step(a[None], c[None])[0], (x[b], u[b]))
        torch.testing.assert_close(df_dx[b], auto_x, rtol=1e-12, atol=1e-13)
        torch.testing.assert_close(df_du[b], auto_u, rtol=1e-11, atol=1e-13)
        numeric_u = (
            model.step(x[b : b + 1], u[b : b + 1] + eps) - model.step(x[b : b + 1], u[b : b + 1] - eps)
        ) / (2 * eps)
        torch.testing.assert_close(df_du[b], numeric_u[0], rtol=1e-7, atol=1e-8)
        for j in range(model.state_size):
            step = eps * torch.eye(model.state_size, dtype=torch.float64)[j]
            numeric = (
                model.step((x[b] + step)[None], u[b : b + 1]) - model.step((x[b] - step)[None], u[b : b + 1])
            ) / (2 * eps)
            torch.testing.assert_close(df_dx[b, :, j], numeric[0], rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("model", MODELS[1:3])
def test_saturated_steering_has_no_effect_and_no_gradient(model: Dynamics) -> None:
    x, u = _batch(model, [0.4, -0.4])
    at_limit = torch.tensor([0.3135, -0.2634], dtype=torch.float64)
    torch.testing.assert_close(model.step(x, u), model.step(x, at_limit))
    _, df_du = model.jacobians(x, u)
    assert torch.equal(df_du, torch.zeros_like(df_du))


def test_ackermann_drives_a_full_circle_back_to_its_start() -> None:
    steering = torch.tensor([0.2], dtype=torch.float64)
    radius = 0.25 / torch.tan(steering)
    ticks = 100
    model = Ackermann(0.25, 0.8, dt_s=float(2 * torch.pi * radius / 0.8 / ticks))
    x = start = torch.tensor([[1.0, -2.0, 0.3]], dtype=torch.float64)
    for _ in range(ticks):
        x = model.step(x, steering)
    torch.testing.assert_close(x - start, torch.tensor([[0.0, 0.0, 2 * torch.pi]], dtype=torch.float64))


def test_straight_line_and_dtype() -> None:
    x = torch.tensor([[0.0, 0.0, torch.pi / 2]], dtype=torch.float32)
    moved = ACKERMANN.step(x, torch.zeros(1))
    assert moved.dtype == torch.float32
    torch.testing.assert_close(moved, torch.tensor([[0.0, 0.08, torch.pi / 2]]))


def test_servo_lag_approaches_the_plain_bicycle() -> None:
    fast = ActuatedAckermann(0.25, 0.8, 0.1, lag_s=1e-4)
    x, u = _batch(ACKERMANN, [0.2, -0.1])
    lagged = fast.step(torch.cat([x, torch.zeros(2, 1, dtype=torch.float64)], 1), u)
    torch.testing.assert_close(lagged[:, :3], ACKERMANN.step(x, u), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(lagged[:, 3], u)


def test_wrong_shapes_and_values_are_explained() -> None:
    with pytest.raises(ValueError, match=r"expected states \[B, 3\]"):
        ACKERMANN.step(torch.zeros(2, 4), torch.zeros(2))
    with pytest.raises(ValueError, match="wheelbase_m > 0"):
        Ackermann(0.0, 0.8, 0.1)
    with pytest.raises(ValueError, match="steering limits"):
        Ackermann(0.25, 0.8, 0.1, (0.3, -0.3))
