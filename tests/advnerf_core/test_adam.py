"""Adam against torch's own optimisers, bit for bit, and without what those import."""

import subprocess
import sys

import pytest
import torch

from advnerf_core.adam import Adam
from advnerf_core.attack.search.descent import Descent


def gradients(dtype):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(7, 3, generator=generator, dtype=dtype) * 10.0**-k for k in range(12)]


def network():
    """Weights of three shapes, one of them in torch's other layout of images."""
    torch.manual_seed(0)
    layers = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3), torch.nn.Flatten(), torch.nn.Linear(36, 2))
    return layers.to(memory_format=torch.channels_last)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_step_has_the_bits_of_torch(dtype):
    theta = torch.linspace(-2.0, 2.0, 21, dtype=dtype).reshape(7, 3)
    theirs, ours = theta.clone().requires_grad_(), theta.clone()
    optimiser, adam = torch.optim.Adam([theirs], lr=0.1), Adam({"theta": ours})
    for gradient in gradients(dtype):
        theirs.grad = gradient.clone()
        optimiser.step()
        adam.step(0.1, {"theta": gradient})
        assert torch.equal(ours, theirs)
    state, found = optimiser.state[theirs], adam.moments["theta"]
    assert found.keys() == state.keys()
    assert all(torch.equal(found[name], kept) for name, kept in state.items())
    assert not torch.equal(ours, theta)


@pytest.mark.parametrize(
    ("make", "options"),
    [
        (torch.optim.Adam, {}),
        (torch.optim.AdamW, {"weight_decay": 0.2}),
        (torch.optim.AdamW, {"weight_decay": 0.2, "fused": True}),
    ],
)
def test_a_network_learns_as_with_torchs_classes(make, options):
    theirs, ours = network(), network()
    optimiser = make(theirs.parameters(), **options)
    adam = Adam(dict(ours.named_parameters()), **options)
    for step in range(6):
        images = torch.randn(5, 3, 5, 5, generator=torch.Generator().manual_seed(step))
        optimiser.param_groups[0]["lr"] = 0.1 / (step + 1)
        for net in (theirs, ours):
            net(images).square().sum().backward()
        optimiser.step()
        optimiser.zero_grad()
        adam.step(0.1 / (step + 1))
        for a, b in zip(theirs.parameters(), ours.parameters(), strict=True):
            assert torch.equal(a, b)
            assert b.grad is None


def test_what_has_no_gradient_stays():
    parameters = {"moves": torch.ones(2, requires_grad=True), "stays": torch.ones(2, requires_grad=True)}
    adam = Adam(parameters, weight_decay=0.5)
    (3.0 * parameters["moves"]).sum().backward()
    adam.step(0.1)
    assert torch.equal(parameters["stays"], torch.ones(2))
    assert adam.moments["stays"]["step"] == 0.0
    # Loshchilov and Hutter, algorithm 2: the first step is the rate's length, after the decay.
    torch.testing.assert_close(parameters["moves"].detach(), torch.full((2,), 1.0 - 0.1 * 0.5 - 0.1))


def test_a_descent_goes_on_where_it_was_left():
    first, *others = gradients(torch.float32)
    whole = Descent({"theta": torch.ones(7, 3)}, 0.05)
    whole.step(first)
    kept = whole.tensors
    resumed = Descent(kept, 0.05)
    for gradient in others:
        whole.step(gradient)
        resumed.step(gradient)
    assert torch.equal(whole.theta, resumed.theta)
    assert torch.equal(kept["step"], torch.tensor(1.0))  # what was kept is a copy


def test_it_does_not_import_the_compiler_of_torch():
    code = (
        "import sys, torch; from advnerf_core.adam import Adam; theta = torch.ones(2); "
        "Adam({'theta': theta}).step(0.1, {'theta': theta.clone()}); "
        "Adam({'theta': theta}, fused=True).step(0.1, {'theta': theta.clone()}); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"
