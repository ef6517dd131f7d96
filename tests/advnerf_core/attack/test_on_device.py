"""Searches in plain torch, on the CPU and on a GPU, against those with the processor's kernels."""

import dataclasses

import pytest
import torch

from advnerf_core.attack.adjoint import adjoint_gradient
from advnerf_core.attack.device import use_device
from advnerf_core.attack.methods import SearchRun
from advnerf_core.attack.on_device import (
    PolicyThere,
    all_on_chosen_device,
    on_chosen_device,
    on_device,
    said_of_device,
)
from advnerf_core.attack.robustness import Disturbances
from advnerf_core.attack.search.gradient import gradient_attack
from advnerf_core.attack.search.together import gradient_attacks
from advnerf_core.errors import DeviceError
from advnerf_core.scene.surrogate import Surrogate
from tests.support.attack_toy import MOUNT, VIEW, painted_room, toy_problem
from tests.support.devices import DEVICES
from tests.support.placed_toy import Leaning, moving

here_only = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
every_device = pytest.mark.parametrize("device", DEVICES)
LENS = VIEW.resized(33, 11)


class Weighted(torch.nn.Module):
    """A smooth policy with weights of its own."""

    stateless = True

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.layer = torch.nn.Conv2d(3, 4, 5, 3, dtype=torch.float64)
        self.requires_grad_(False)

    def forward(self, images, goals=None):
        return 0.25 * torch.tanh(4.0 * self.layer(images).sin().mean((1, 2, 3)))


def small(policy=None, **changes):
    problem = toy_problem(3, resolution=4, policy=(policy or Weighted()).eval())
    surrogate = Surrogate(painted_room, LENS, MOUNT, problem.sensor.objects, dtype=torch.float64)
    return dataclasses.replace(problem, sensor=surrogate, time_batch=2, **changes)


@every_device
@pytest.mark.parametrize(
    "changes",
    [{}, {"cache_bytes": 0}, {"disturbances": Disturbances(0.02, 0.1, 0.02, 0.01, 0.01, seed=3)}],
    ids=["plain", "rendered again", "disturbed"],
)
def test_loss_and_gradient_are_those_of_the_processor(device, changes):
    problem = small(**changes)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(1))
    ours, theirs = adjoint_gradient(problem, theta), adjoint_gradient(on_device(problem, device), theta)
    assert theirs.gradient.device == theta.device
    assert theirs.loss == pytest.approx(ours.loss, abs=1e-9)
    torch.testing.assert_close(theirs.gradient, ours.gradient, atol=1e-9, rtol=1e-7)
    assert float(ours.gradient.abs().max()) > 1e-6


@every_device
def test_searches_alone_and_together_end_where_those_of_the_processor_do(device):
    problem = small()
    wanted = gradient_attack(problem, 2, run=SearchRun(5))
    there = on_device(problem, device)
    alone = gradient_attack(there, 2, run=SearchRun(5))
    together = gradient_attacks([there, there], [4, 5], 2)
    for found in (alone, together[1]):
        torch.testing.assert_close(found.theta, wanted.theta, atol=1e-8, rtol=0)
        assert found.best.predicted_total_cte_m == pytest.approx(wanted.best.predicted_total_cte_m, abs=1e-8)


@every_device
def test_a_search_for_places_has_the_gradient_of_the_processor(device):
    problem = moving(objects=2)
    theta = problem.sensor.initial_theta(torch.Generator().manual_seed(1))
    ours, theirs = adjoint_gradient(problem, theta), adjoint_gradient(on_device(problem, device), theta)
    assert theirs.loss == pytest.approx(ours.loss, abs=1e-9)
    torch.testing.assert_close(theirs.gradient, ours.gradient, atol=1e-9, rtol=1e-7)
    assert float(ours.gradient[:8].abs().max()) > 1e-6


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_the_environment_chooses_the_device(monkeypatch):
    monkeypatch.setenv("ADVNERF_DEVICE", "cuda")
    first, second = all_on_chosen_device([small(), small()])
    assert first.sensor is second.sensor
    assert said_of_device() == {"device": torch.cuda.get_device_name()}


def test_a_policy_without_weights_stays_where_it_is():
    images = torch.rand(2, 3, 22, 66, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    policy = Leaning().eval()
    assert torch.equal(PolicyThere(policy, torch.device("meta"))(images), policy(images))


def test_the_processor_searches_where_nothing_else_is_asked_for(monkeypatch):
    problem = small()
    monkeypatch.delenv("ADVNERF_DEVICE", raising=False)
    assert on_chosen_device(problem) is problem
    use_device("cpu")
    assert on_chosen_device(problem) is problem
    assert said_of_device() == {}  # attack ids of the processor stay what they were


def test_another_device_is_refused(monkeypatch):
    monkeypatch.setenv("ADVNERF_DEVICE", "tpu")
    with pytest.raises(DeviceError, match="expected cpu or cuda in ADVNERF_DEVICE, got 'tpu'"):
        on_chosen_device(small())


@here_only
def test_a_missing_gpu_is_said_before_anything_begins(monkeypatch):
    monkeypatch.setenv("ADVNERF_DEVICE", "cpu")
    with pytest.raises(DeviceError, match="expected an NVIDIA GPU that torch can use"):
        use_device("cuda")
