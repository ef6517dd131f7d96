"""Gradients of a policy's control with respect to its images, in float32 and in bfloat16."""

import pytest
import torch
from torch import nn
from torch.nn.functional import cosine_similarity

from advnerf_core.attack.image_gradients import LEAST_COSINE, agrees_in_bfloat16, image_gradients
from advnerf_core.errors import NotFiniteError
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.number_type import layer_type
from advnerf_core.policies.pilotnet import PilotNet

CAMERA = Pinhole(200, 66, 100.0, 100.0, 100.0, 33.0)


class Brittle(nn.Module):
    """Its gradient changes its sign with the last bits of a sum."""

    stateless, differentiable, goal_size = True, True, 0

    def __init__(self):
        super().__init__()
        self.layer = nn.Linear(3 * 66 * 200, 1)
        nn.init.constant_(self.layer.weight, 1.0)

    def forward(self, images, goals=None):
        return torch.sin(self.layer(images.flatten(1)))[:, 0]


def network():
    torch.manual_seed(0)
    return PilotNet(0, 0.4).eval().requires_grad_(False)


def test_in_float32_it_is_the_derivative():
    policy = network().double()
    images = torch.rand(2, 3, 66, 200, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    slopes = torch.tensor([1.0, -3.0], dtype=torch.float64)
    gradient = image_gradients(policy, images, None, slopes)
    way = torch.randn(images.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        high, low = (slopes @ policy(images + step * way) for step in (1e-4, -1e-4))
    assert abs((high - low) / 2e-4 - (gradient * way).sum()) < 1e-6 * gradient.norm() * way.norm()


def test_a_gradient_without_numbers_is_blamed_on_the_policy():
    class Rooted(nn.Module):
        def forward(self, images, goals=None):
            return images.pow(2).sum((1, 2, 3)).sqrt()

    images = torch.rand(3, 3, 4, 5, generator=torch.Generator().manual_seed(1))
    images[1] = 0.0  # the root's value is 0 there, and its slope is not a number
    with pytest.raises(
        NotFiniteError,
        match=r"gradient of the policy's steering .* for 1 of 3 pictures; look in the policy for sqrt",
    ):
        image_gradients(Rooted(), images, None, torch.ones(3))


def test_in_bfloat16_the_direction_stays():
    policy = network()
    images = torch.rand(3, 3, 66, 200, generator=torch.Generator().manual_seed(1))
    exact, rounded = (image_gradients(policy, images, None, torch.ones(3), kind) for kind in (False, True))
    assert rounded.dtype == images.dtype
    assert rounded.shape == images.shape
    assert not torch.equal(exact, rounded)
    assert cosine_similarity(exact.double().flatten(1), rounded.double().flatten(1)).min() > LEAST_COSINE


def test_only_a_network_whose_direction_stays_is_computed_in_bfloat16():
    multiplies = layer_type() == torch.bfloat16
    assert agrees_in_bfloat16(network(), CAMERA) == multiplies
    assert not agrees_in_bfloat16(network().double(), CAMERA)
    assert not agrees_in_bfloat16(Brittle().eval(), CAMERA)
    assert not agrees_in_bfloat16(lambda images, goals: images.mean((1, 2, 3)), CAMERA)


def test_a_policy_that_detaches_its_steering_is_told_so():
    class Detached(nn.Module):
        stateless, differentiable, goal_size = True, True, 0

        def forward(self, images, goals=None):
            return images.mean((1, 2, 3)).detach()

    with pytest.raises(PolicyContractError, match="got steering without a gradient; compute it with torch"):
        image_gradients(Detached(), torch.rand(1, 3, 66, 200), None, torch.ones(1))
