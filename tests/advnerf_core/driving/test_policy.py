from pathlib import Path

import numpy as np
import pytest
import torch

from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.rollout import drive
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import PolicyFileError, load_policy, save_policy
from advnerf_core.policies.view import PolicyView

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))


def _network(goal_size: int = 0) -> PilotNet:
    torch.manual_seed(0)
    return PilotNet(goal_size).eval()


def test_size_and_bound() -> None:
    # Bojarski et al. count about 250 thousand parameters, 27 million connections.
    assert sum(p.numel() for p in _network().parameters()) == pytest.approx(250_000, rel=0.02)
    network = _network()
    with torch.no_grad():
        network.head[-1].bias.fill_(100.0)
    assert network(torch.rand(2, 3, 66, 200)).tolist() == pytest.approx([0.30, 0.30])


def test_float64_gradient_matches_finite_differences() -> None:
    network = _network().double()
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(1, 3, 66, 200, dtype=torch.float64, generator=generator, requires_grad=True)
    direction = torch.randn(image.shape, dtype=torch.float64, generator=generator)
    (gradient,) = torch.autograd.grad(network(image).sum(), image)
    eps = 1e-6
    with torch.no_grad():
        numeric = (network(image + eps * direction) - network(image - eps * direction)) / (2 * eps)
    assert float((gradient * direction).sum()) == pytest.approx(float(numeric), rel=1e-6)


def test_goals_change_the_output_and_are_checked() -> None:
    network = _network(goal_size=3)
    images = torch.rand(2, 3, 66, 200)
    one_hot = torch.eye(3)
    assert not torch.allclose(network(images, one_hot[[0, 0]]), network(images, one_hot[[1, 1]]))
    with pytest.raises(ValueError, match=r"expected goals \[2, 3\], got None"):
        network(images)
    with pytest.raises(ValueError, match=r"expected goals \[2, 0\]"):
        _network()(images, one_hot[:2])
    with pytest.raises(ValueError, match="expected images"):
        network(torch.rand(2, 66, 200, 3))


def test_images_to_tensor() -> None:
    image = np.random.default_rng(0).integers(0, 256, (66, 200, 3), dtype=np.uint8)
    tensor = images_to_tensor(image)
    assert tensor.shape == (1, 3, 66, 200)
    np.testing.assert_allclose(tensor[0, 2].numpy(), image[..., 2] / 255.0, atol=1e-7)


def test_file_round_trip_and_hash(tmp_path: Path) -> None:
    network = _network()
    file = tmp_path / "policy.safetensors"
    digest = save_policy(file, network, VIEW, {"frames": 12})
    loaded = load_policy(file, digest)
    images = torch.rand(2, 3, 66, 200)
    assert torch.equal(loaded.policy(images), network(images))
    assert (loaded.view, loaded.metadata, loaded.sha256) == (VIEW, {"frames": 12}, digest)
    assert not any(p.requires_grad for p in loaded.policy.parameters())
    assert save_policy(tmp_path / "again.safetensors", network, VIEW, {"frames": 12}) == digest
    assert save_policy(tmp_path / "other.safetensors", network, VIEW, {"frames": 13}) != digest
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "again.safetensors",
        "other.safetensors",
        "policy.safetensors",
    ]


def test_bad_files_are_explained(tmp_path: Path) -> None:
    file = tmp_path / "policy.safetensors"
    with pytest.raises(PolicyFileError, match="train a policy first"):
        load_policy(file)
    file.write_bytes(b"not a policy")
    with pytest.raises(PolicyFileError, match="unreadable"):
        load_policy(file)
    save_policy(file, _network(), VIEW, {})
    with pytest.raises(PolicyFileError, match="expected the policy abc"):
        load_policy(file, "abc")
    content = bytearray(file.read_bytes())
    content[-1] ^= 0x40
    file.write_bytes(content)
    with pytest.raises(PolicyFileError, match="damaged"):
        load_policy(file)


def test_drive_replays_by_hand() -> None:
    network, dynamics = _network(), Ackermann(0.25, 0.8, 0.1)
    seen = []

    def observe(states: torch.Tensor) -> torch.Tensor:
        seen.append(states)
        return (states[:, :3].sum(1).sin().abs()[:, None, None, None] * torch.ones(1, 3, 66, 200)).float()

    start = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.5, 0.2]], dtype=torch.float64)
    rollout = drive(network, observe, dynamics, start, steps=4)
    assert rollout.states.shape == (5, 2, 3)
    assert rollout.controls.shape == (4, 2)
    assert rollout.states.dtype == torch.float64
    assert torch.equal(torch.stack(seen), rollout.states[:-1])
    state = start
    for t in range(4):
        state = dynamics.step(state, network(observe(state)).double().detach())
        torch.testing.assert_close(state, rollout.states[t + 1])
    with pytest.raises(ValueError, match="at least one step"):
        drive(network, observe, dynamics, start, steps=0)
