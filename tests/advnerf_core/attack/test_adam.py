"""Adam against torch's own optimiser, bit for bit, and without what that imports."""

import subprocess
import sys

import pytest
import torch

from advnerf_core.attack.search.adam import Adam


def gradients(dtype):
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(7, 3, generator=generator, dtype=dtype) * 10.0**-k for k in range(12)]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_step_has_the_bits_of_torch(dtype):
    theta = torch.linspace(-2.0, 2.0, 21, dtype=dtype).reshape(7, 3)
    theirs = theta.clone().requires_grad_()
    optimiser, ours = torch.optim.Adam([theirs], lr=0.1), Adam({"theta": theta}, 0.1)
    for gradient in gradients(dtype):
        theirs.grad = gradient.clone()
        optimiser.step()
        ours.step(gradient)
        assert torch.equal(ours.theta, theirs)
    state = optimiser.state[theirs]
    assert ours.tensors.keys() == {"theta", *state}
    assert all(torch.equal(ours.tensors[name], kept) for name, kept in state.items())
    assert not torch.equal(ours.theta, theta)


def test_it_goes_on_where_it_was_left():
    first, *others = gradients(torch.float32)
    whole = Adam({"theta": torch.ones(7, 3)}, 0.05)
    whole.step(first)
    kept = whole.tensors
    resumed = Adam(kept, 0.05)
    for gradient in others:
        whole.step(gradient)
        resumed.step(gradient)
    assert torch.equal(whole.theta, resumed.theta)
    assert torch.equal(kept["step"], torch.tensor(1.0))  # what was kept is a copy


def test_it_does_not_import_the_compiler_of_torch():
    code = (
        "import sys, torch; from advnerf_core.attack.search.adam import Adam; "
        "Adam({'theta': torch.ones(2)}, 0.1).step(torch.ones(2)); print('torch._dynamo' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "False"
