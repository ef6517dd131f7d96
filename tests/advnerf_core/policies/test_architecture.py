"""Architectures from the table and from a user's file: they train, keep their gradient, and are the same after a file."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from advnerf_core.geometry import Pinhole
from advnerf_core.learning.augment import AugmentConfig
from advnerf_core.learning.fit import FitConfig, fit, mean_absolute_error
from advnerf_core.learning.frames import Frames, FrameSet
from advnerf_core.learning.retrain import FineTuneConfig, fine_tune
from advnerf_core.plugins import PluginError
from advnerf_core.policies.adapter import AdaptedPolicy
from advnerf_core.policies.architecture import ARCHITECTURES, Architecture, ArchitectureError
from advnerf_core.policies.conformance import FAILURE, check_policy
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.load import described_policy, load_adapted
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import (
    PolicyFileError,
    copy_policy,
    load_policy,
    policy_sha256,
    save_policy,
)
from advnerf_core.policies.view import PolicyView
from advnerf_core.policies.vit import _TransformerBlock

VIEW = PolicyView(Pinhole(336, 188, 174.0, 174.0, 168.0, 94.0))
EXAMPLE = Path(__file__).parents[3] / "examples" / "my_architecture.py"
NAMES = [*ARCHITECTURES, f"{EXAMPLE}:Mixer"]
EACH = pytest.mark.parametrize("name", NAMES, ids=[*ARCHITECTURES, "of a user"])
NO_CHANGE = AugmentConfig(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0)
# A user's network with dropout, tied weights, a frozen layer, and a module beside it.
DROPPING = """
import torch
from torch import nn
from advnerf_core.policies.network import SteeringNetwork
from sizes import WIDTH

class Dropping(SteeringNetwork):
    def __init__(self, goal_size, max_steering_rad, configuration):
        assert configuration is None
        super().__init__(goal_size, max_steering_rad, configuration)
        self.pool = nn.AdaptiveAvgPool2d((4, 8))
        self.first = nn.Linear(96, WIDTH)
        self.second = nn.Linear(WIDTH, WIDTH)
        self.again = self.second
        self.fixed = nn.Linear(WIDTH, WIDTH).requires_grad_(False)
        self.head = nn.Linear(WIDTH + goal_size, 1)

    def output(self, images, goals):
        seen = torch.tanh(self.first(self.pool(images).flatten(1)))
        seen = self.fixed(self.again(nn.functional.dropout(self.second(seen), 0.3, self.training)))
        return self.head(seen if goals is None else torch.cat([seen, goals], 1))[:, 0]
"""


def frames(count: int = 32, goal_size: int = 0, seed: int = 0) -> Frames:
    """Noise with a bright bar at a column that says how to steer."""
    rng = np.random.default_rng(seed)
    columns = rng.integers(20, 180, count)
    images = rng.integers(60, 140, (count, 66, 200, 3)).astype(np.uint8)
    for image, column in zip(images, columns, strict=True):
        image[20:, column - 6 : column + 6] = 240
    labels = (0.2 * (100 - columns) / 80).astype(np.float32)
    goals = rng.random((count, goal_size)).astype(np.float32)
    return Frames(images, np.zeros((count, 3)), labels, goals, np.zeros(count, bool))


def built(name: str, goal_size: int = 0, seed: int = 0):
    torch.manual_seed(seed)
    return Architecture(name).build(goal_size, 0.3)


@pytest.fixture
def dropping(tmp_path) -> str:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "sizes.py").write_text("WIDTH = 12\n")
    (tmp_path / "own" / "dropping.py").write_text(DROPPING)
    return f"{tmp_path}/own/dropping.py:Dropping"


@pytest.mark.parametrize(
    ("name", "configuration", "steps", "learning_rate"),
    [
        ("pilotnet", {}, 60, 1e-3),
        ("resnet", {"widths": [8, 16, 24]}, 50, 3e-3),
        ("vit_tiny", {"patch": [22, 10], "width": 32, "depth": 2}, 240, 3e-3),
        (f"{EXAMPLE}:Mixer", {}, 90, 3e-3),
    ],
    ids=[*ARCHITECTURES, "of a user"],
)
def test_it_learns_32_images_by_heart(name, configuration, steps, learning_rate) -> None:
    torch.manual_seed(0)
    policy, data = Architecture(name, configuration).build(0, 0.3), FrameSet([frames()], True, 1000)
    fit(policy, data, FitConfig(steps, 16, learning_rate, augment=NO_CHANGE))
    labels = frames().steering_rad
    assert mean_absolute_error(policy, data) < 0.1 * np.abs(labels - labels.mean()).mean()


@EACH
def test_its_gradient_is_that_of_finite_differences(name: str) -> None:
    policy = built(name, 2).double().eval()
    images, direction = torch.rand(3, 3, 66, 200).double(), torch.randn(3, 3, 66, 200).double()
    goals, step = torch.eye(3, 2).double(), 1e-5
    images.requires_grad_(True)
    policy(images, goals).sum().backward()
    with torch.no_grad():
        ahead, behind = (policy(images + side * step * direction, goals).sum() for side in (1.0, -1.0))
    assert float((images.grad * direction).sum()) == pytest.approx(
        float(ahead - behind) / (2.0 * step), rel=1e-6
    )


@EACH
@pytest.mark.parametrize("goal_size", [0, 2])
def test_a_file_gives_the_same_steering(name: str, goal_size: int, tmp_path) -> None:
    policy, file = built(name, goal_size).eval(), tmp_path / "policy.safetensors"
    digest = save_policy(file, policy, VIEW, {"kind": "test"})
    loaded = load_policy(file, digest)
    images, goals = torch.rand(4, 3, 66, 200), torch.rand(4, goal_size) if goal_size else None
    assert torch.equal(loaded.policy(images, goals), policy(images, goals))
    assert float(policy(images, goals).detach().std()) > 0.0
    assert loaded.view == VIEW
    again = tmp_path / "again" / "policy.safetensors"
    assert save_policy(again, loaded.policy, VIEW, {"kind": "test"}) == digest
    assert again.read_bytes() == file.read_bytes()


@EACH
def test_it_keeps_the_contract(name: str, tmp_path) -> None:
    save_policy(tmp_path / "p.safetensors", built(name, 2), VIEW, {})
    adapted, _ = load_adapted(tmp_path / "p.safetensors")
    found = check_policy(adapted, frames(6).images, goal=(0.3, 0.7))
    assert [each for each in found if each.verdict == FAILURE] == []
    assert {"gradient", "independent"} & {each.name for each in found}


@EACH
def test_retraining_goes_on_from_its_weights(name: str, tmp_path) -> None:
    save_policy(tmp_path / "old.safetensors", built(name), VIEW, {})
    old, config = (
        load_policy(tmp_path / "old.safetensors"),
        FineTuneConfig(steps=1, batch_size=4, learning_rate=1e-9),
    )
    done = fine_tune(old, [frames(20)], [frames(20, seed=1)], config, tmp_path / "r" / "new.safetensors")
    new, images = load_policy(done.path), torch.rand(2, 3, 66, 200)
    torch.testing.assert_close(new.policy(images), old.policy(images), atol=1e-6, rtol=0)
    assert new.metadata["fine_tuned_from"] == old.sha256
    assert type(new.policy).__name__ == type(old.policy).__name__


def test_a_transformer_block_is_that_of_torch() -> None:
    torch.manual_seed(0)
    block, tokens = _TransformerBlock(16, 4), torch.randn(2, 7, 16)
    other = nn.TransformerEncoderLayer(16, 4, 32, 0.0, "gelu", batch_first=True, norm_first=True)
    norm, first, _, second = block.perceptron
    pairs = [
        (other.self_attn.in_proj_weight, block.query_key_value.weight),
        (other.self_attn.in_proj_bias, block.query_key_value.bias),
        (other.self_attn.out_proj.weight, block.mixed.weight),
        (other.self_attn.out_proj.bias, block.mixed.bias),
        (other.norm2.weight, norm.weight),
        (other.linear1.weight, first.weight),
        (other.linear1.bias, first.bias),
        (other.linear2.weight, second.weight),
        (other.linear2.bias, second.bias),
    ]
    with torch.no_grad():
        for theirs, ours in pairs:
            theirs.copy_(ours)
    torch.testing.assert_close(block(tokens), other(tokens))


def test_residual_stages_have_the_sizes_that_were_asked_for() -> None:
    policy = Architecture("resnet", {"widths": [8, 12], "blocks": 3, "hidden": 5}).build(0, 0.3)
    assert policy.features(torch.rand(1, 3, 66, 200)).shape == (1, 12 * 17 * 50)
    assert sum(isinstance(each, nn.Conv2d) for each in policy.modules()) == 1 + 3 * 2 + 1  # one 1x1 shortcut


def test_files_of_pilotnet_are_what_they_were(tmp_path) -> None:
    """The hash was computed before there was a table of architectures."""
    policy = PilotNet(3, 0.4).double()
    with torch.no_grad():
        for number, value in enumerate(policy.state_dict().values()):
            value.copy_(torch.linspace(-0.1, 0.1, value.numel()).reshape(value.shape) / (1 + number))
    digest = save_policy(tmp_path / "p.safetensors", policy, VIEW, {"kind": "test"})
    assert digest == "b493e9983807a080a70f3a1c75eb8daafd868738d30839c7ec54d0d8a915b457"


def test_dropout_resumes_to_the_bit(dropping: str, tmp_path) -> None:
    data, config = FrameSet([frames()], True, 1000), FitConfig(12, 8, checkpoint_every=5)
    whole, stopped, resumed = (built(dropping) for _ in range(3))
    fit(whole, data, config)
    assert not torch.equal(whole.first.weight, stopped.first.weight)
    assert torch.equal(whole.fixed.weight, stopped.fixed.weight)

    class Stop(Exception):
        pass

    def stop(step: int, _: float) -> None:
        if step == 10:
            raise Stop

    with pytest.raises(Stop):
        fit(stopped, data, config, tmp_path / "c.safetensors", stop)
    fit(resumed, data, config, tmp_path / "c.safetensors")
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name


def test_the_code_of_a_user_lies_beside_the_file_and_is_checked(dropping: str, tmp_path, capsys) -> None:
    policy, file = built(dropping).eval(), tmp_path / "out" / "policy.safetensors"
    source = Path(dropping.rpartition(":")[0])
    source.write_text("raise SystemExit('the file of the training is not read again')")
    digest = save_policy(file, policy, VIEW, {})
    capsys.readouterr()
    images = torch.rand(2, 3, 66, 200)
    assert torch.equal(load_policy(file).policy(images), policy(images))
    (folder,) = file.parent.glob("architecture_*")
    assert {each.name for each in folder.iterdir()} == {"dropping.py", "sizes.py"}
    assert f"runs {folder}/dropping.py:Dropping (sha256 {policy.code_sha256[:12]})" in capsys.readouterr().err

    copy_policy(file, tmp_path / "copy" / "policy.safetensors")
    assert load_policy(tmp_path / "copy" / "policy.safetensors").sha256 == digest

    (folder / "sizes.py").write_text("WIDTH = 12  # changed\n")
    with pytest.raises(PolicyFileError, match=r"expected the code of .* with hash .*, got hash .*unchanged"):
        load_policy(file)
    (folder / "dropping.py").unlink()
    with pytest.raises(PolicyFileError, match=r"got none; copy architecture_\w+/ along"):
        load_policy(file)
    assert policy_sha256(file) == digest  # runs nothing
    adapted, sha256, network = described_policy(file)
    assert (sha256, adapted.goal_size) == (digest, 0)
    assert network == {"architecture": "dropping.py:Dropping", "code": policy.code_sha256}


def test_a_description_is_the_same_wherever_the_file_is(dropping: str, tmp_path) -> None:
    other = tmp_path / "elsewhere"
    other.mkdir()
    for each in Path(dropping.rpartition(":")[0]).parent.glob("*.py"):
        (other / each.name).write_bytes(each.read_bytes())
    described = Architecture(dropping, {"a": 1}).described()
    assert described == Architecture(f"{other}/dropping.py:Dropping", {"a": 1}).described()
    assert str(tmp_path) not in str(described)
    (other / "sizes.py").write_text("WIDTH = 13\n")
    assert described != Architecture(f"{other}/dropping.py:Dropping", {"a": 1}).described()
    assert Architecture().described() == {"hidden": [100, 50, 10]}
    assert Architecture("vit_tiny", {"depth": 2}).described()["configuration"]["width"] == 64


@pytest.mark.parametrize(
    ("name", "configuration", "message"),
    [
        ("resnt", {}, r"expected an architecture of pilotnet, resnet, vit_tiny; got 'resnt' \(did you mean"),
        (
            "resnet",
            {"width": 3},
            "configuration.width: expected a setting of resnet of widths, blocks, hidden",
        ),
        ("resnet", {"blocks": 0}, "configuration.blocks: input should be greater than or equal to 1, got 0"),
        ("resnet", {"hidden": "64"}, "configuration.hidden: input should be a valid integer, got '64'"),
        ("vit_tiny", {"patch": 7}, r"configuration.patch: expected a list in brackets, got 7; write \[7\]"),
        ("vit_tiny", {"patch": [7, 10]}, "whose height divides 66"),
        ("vit_tiny", {"width": 30}, "multiple of 4 and of heads"),
        ("nowhere.py:Net", {}, "expected a Python file at .*nowhere.py"),
        (f"{EXAMPLE}:Settings", {}, "expected a class derived from SteeringNetwork"),
        (f"{EXAMPLE}:Mixer", {"depth": 3}, "expected a setting of my_architecture.py:Mixer of width"),
        (f"{EXAMPLE}:Mixer", {"width": -3}, r"Mixer\(2, 0.3, .* failed: "),
    ],
)
def test_what_cannot_be_built_is_one_clear_error(name, configuration, message) -> None:
    with pytest.raises((PluginError, ArchitectureError), match=message):
        Architecture(name, configuration).build(2, 0.3)


@pytest.mark.parametrize(
    ("layers", "output", "message"),
    [
        ("nn.Linear(3, 1)", "self.head(images[:, :, 0, 0])", r"expected an output \[B\], got \[2, 1\]"),
        ("1.0", "images[:, 0, 0, 0]", "expected weights to train, got none; make layers in __init__"),
        (
            "nn.Linear(3, 1)",
            "self.head(nn.functional.dropout(images[:, :, 0, 0], 0.5))[:, 0]",
            "answers a picture always the same: the output is random: dropout or noise is left on",
        ),
        (
            "nn.Linear(3, 1)",
            "self.head(images[:, :, 0, 0] + self.asked())[:, 0]",
            "answers a picture always the same: declared stateless, but the output depends on the images before",
        ),
        (
            "nn.Linear(3, 1)",
            "self.head(images[:, :, 0, 0] - images[:, :, 0, 0].mean(0))[:, 0]",
            "answers a picture always the same: an image steers differently in a batch than alone",
        ),
        (
            "nn.Linear(3, 1)",
            "self.head(self.hidden[0](images[:, :, 0, 0]))[:, 0]",
            r"that loads the weights of another.*hold layers in torch.nn.ModuleList",
        ),
        (
            "nn.Linear(3, 1)",
            "self.head(images[:, :, 0, 0] @ self.mixed)[:, 0]",
            r"that loads the weights of another.*tensors in torch.nn.Parameter or register_buffer",
        ),
    ],
)
def test_a_check_finds_a_network_that_would_be_trained_for_nothing(tmp_path, layers, output, message) -> None:
    """Noise and memories were trained and saved without a word, and told as the effect of an attack."""
    (tmp_path / "own.py").write_text(
        "import torch\n"
        "from torch import nn\n"
        "from advnerf_core.policies.network import SteeringNetwork\n"
        "class Own(SteeringNetwork):\n"
        "    def __init__(self, goal_size, max_steering_rad, configuration):\n"
        "        super().__init__(goal_size, max_steering_rad, configuration)\n"
        f"        self.head, self.count = {layers}, 0\n"
        "        self.hidden, self.mixed = [nn.Linear(3, 3)], torch.randn(3, 3)\n"
        "    def asked(self):\n"
        "        self.count += 1\n"
        "        return self.count\n"
        "    def output(self, images, goals):\n"
        f"        return {output}\n"
    )
    with pytest.raises((ArchitectureError, PolicyContractError), match=message):
        Architecture(f"{tmp_path}/own.py:Own").check()


def test_only_a_known_architecture_is_written(tmp_path) -> None:
    class Own(PilotNet):
        pass

    with pytest.raises(PolicyFileError, match=r"got a Own; make it with Architecture\('file.py:Class'\)"):
        save_policy(tmp_path / "p.safetensors", Own(), VIEW, {})
    adapted = AdaptedPolicy(PilotNet().eval(), PolicyContract(VIEW))
    with pytest.raises(PolicyFileError, match=re.escape("got a AdaptedPolicy")):
        save_policy(tmp_path / "p.safetensors", adapted, VIEW, {})
