"""A car's response from its drives: known ones are found again, and the closed form is that of small steps."""

import numpy as np
import pytest
import torch

from advnerf_core.driving.dynamics import Ackermann, Dubins
from advnerf_core.driving.measured_car import CarResponse, RespondingCar, fit_response

CARS = {
    "bicycle": Ackermann(0.33, 0.8, 0.1, (-0.35, 0.35)),
    "dubins": Dubins(0.25, 0.1),
}


def driven(car: RespondingCar, controls: np.ndarray) -> np.ndarray:
    states = car.start(torch.zeros(1, 3, dtype=torch.float64))
    poses = [states[0, :3].numpy()]
    for control in controls:
        states = car.step(states, torch.tensor([control], dtype=torch.float64))
        poses.append(states[0, :3].numpy())
    return np.array(poses)


def steered(count: int, seed: int, most: float) -> np.ndarray:
    """Smooth steering as of a policy on a winding path."""
    rng = np.random.default_rng(seed)
    return most * np.convolve(rng.normal(size=count + 8), np.ones(9) / 3.0, mode="valid")


@pytest.mark.parametrize("kind", CARS)
def test_a_known_response_is_found_again(kind: str) -> None:
    truth = CarResponse(0.93 * CARS[kind].speed_mps, 0.94, 0.004, 0.05, 0.13)
    car = RespondingCar(CARS[kind], truth)
    controls = [steered(60, seed, 0.1) for seed in range(4)]
    rng = np.random.default_rng(9)
    poses = [driven(car, each) + rng.normal(0.0, 1e-4, (61, 3)) for each in controls]
    found = fit_response(poses, controls, CARS[kind])
    assert found.speed_mps == pytest.approx(truth.speed_mps, rel=0.01)
    assert found.gain == pytest.approx(truth.gain, abs=0.02)
    assert found.offset == pytest.approx(truth.offset, abs=0.002)
    # Delay and lag add up to how late the car is; each alone is harder to tell.
    assert found.delay_s + found.lag_s == pytest.approx(0.18, abs=0.015)
    again = driven(RespondingCar(CARS[kind], found), controls[0])
    assert again == pytest.approx(poses[0], abs=0.02)


def test_an_ideal_car_is_ideal() -> None:
    ideal = CARS["bicycle"]
    controls = [steered(40, 1, 0.08)]
    states = torch.zeros(1, 3, dtype=torch.float64)
    poses = [states[0].numpy()]
    for control in controls[0]:
        states = ideal.step(states, torch.tensor([control], dtype=torch.float64))
        poses.append(states[0].numpy())
    found = fit_response([np.array(poses)], controls, ideal)
    assert found.gain == pytest.approx(1.0, abs=0.01)
    assert found.delay_s + found.lag_s < 0.005
    responding = driven(RespondingCar(ideal, CarResponse(ideal.speed_mps)), controls[0])
    assert responding == pytest.approx(np.array(poses), abs=1e-4)


def test_the_closed_form_of_a_tick_is_that_of_small_steps() -> None:
    response, small = CarResponse(0.25, 1.1, -0.02, 0.03, 0.2), 1e-5
    car = RespondingCar(Dubins(0.25, 0.1), response)
    acting, before, control = 0.3, -0.1, 0.5
    state = torch.tensor([[0.0, 0.0, 0.0, acting, before]], dtype=torch.float64)
    moved = car.step(state, torch.tensor([control], dtype=torch.float64))[0].numpy()
    turned, u = 0.0, acting
    for k in range(round(0.1 / small)):
        target = before if k * small < 0.03 else 1.1 * control - 0.02
        turned, u = turned + u * small, u + (target - u) / 0.2 * small
    assert moved[2] == pytest.approx(turned, abs=1e-5)
    assert moved[3] == pytest.approx(u, abs=1e-4)
    assert moved[4] == pytest.approx(1.1 * control - 0.02)


def test_what_cannot_be_fitted_is_refused() -> None:
    with pytest.raises(ValueError, match="drive without attack first"):
        fit_response([np.zeros((2, 3))], [np.zeros(1)], CARS["dubins"])
