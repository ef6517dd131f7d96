import io
import pickle
import re
import sys
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml
from torch import nn

from advnerf_core.attack.adjoint import BlackBoxError
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.exported_policy import export_program
from advnerf_core.policies.guess import guess_contract
from advnerf_core.policies.load import is_factory, load_adapted, load_any_policy, load_driver
from advnerf_core.policies.onnx_policy import OnnxNetwork, export_onnx
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from tests.support.onnx_models import steering_of

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
SMALL = replace(VIEW, width=40, height=22)


def net(goal_size=0):
    torch.manual_seed(0)
    return PilotNet(goal_size).eval().requires_grad_(False)


def images(count=3, contract=None):
    size = (66, 200) if contract is None else contract.size
    return torch.rand(count, 3, *size, generator=torch.Generator().manual_seed(1))


def strange(goals=0):
    """A declaration that leaves nothing as it is."""
    return PolicyContract(
        VIEW, "BGR", 255.0, (1.0, 2.0, 3.0), (50.0, 60.0, 70.0), "NHWC", "deg", "right", goal_size=goals
    )


class Strange(nn.Module):
    """PilotNet as someone else would have trained it; inverts the declaration by hand."""

    def __init__(self, goals=0):
        super().__init__()
        self.inner = net(goals)

    def forward(self, given, goals=None):
        bgr = (given * torch.tensor([50.0, 60.0, 70.0]) + torch.tensor([1.0, 2.0, 3.0])) / 255.0
        rgb = bgr.flip(-1).permute(0, 3, 1, 2)
        return -self.inner(rgb, goals)[:, None] * (180.0 / np.pi)


@pytest.mark.parametrize("goals", [0, 2])
def test_a_declaration_makes_any_convention_ours(goals):
    goal = torch.rand(3, goals) if goals else None
    policy = adapt(Strange(goals).eval(), strange(goals))
    assert not policy.training
    torch.testing.assert_close(policy(images(), goal), net(goals)(images(), goal), atol=1e-6, rtol=1e-4)


def test_an_adapted_policy_has_the_networks_gradient():
    x, y = images().requires_grad_(), images().requires_grad_()
    adapt(Strange().eval(), strange())(x).sum().backward()
    net()(y).sum().backward()
    torch.testing.assert_close(x.grad, y.grad, atol=1e-7, rtol=1e-3)


def test_numpy_and_torch_convert_alike():
    x = images(2)
    for contract in (strange(), PolicyContract(VIEW)):
        np.testing.assert_allclose(contract.to_network(x.numpy()), contract.to_network(x).numpy(), rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"colour_space": "GBR"}, "colour_space: expected RGB or BGR or YUV or GRAY, got 'GBR'"),
        ({"output_unit": "degrees"}, "output_unit: expected rad or deg or normalised or 1/m"),
        ({"std": (1.0, 0.0, 1.0)}, "std > 0"),
        ({"goal_size": -1}, "goal size >= 0"),
        ({"colour": "RGB"}, "unknown key colour; valid keys: view, colour_space"),
        ({"view": {"width": 3}}, "expected a policy view"),
    ],
)
def test_a_wrong_declaration_is_one_error(change, message):
    data = PolicyContract(VIEW).to_dict()
    assert PolicyContract.from_dict(data) == PolicyContract(VIEW)
    with pytest.raises(PolicyContractError, match=message):
        PolicyContract.from_dict({**data, **change})


def test_wrong_inputs_and_outputs_are_refused():
    policy = adapt(lambda given: torch.zeros(len(given), 2), PolicyContract(VIEW))
    with pytest.raises(PolicyContractError, match=r"\[B, 3, 66, 200\], got \[1, 3, 22, 40\]"):
        policy(torch.zeros(1, 3, 22, 40))
    with pytest.raises(PolicyContractError, match="return the column that steers"):
        policy(images())
    with pytest.raises(PolicyContractError, match=r"expected steering as a tensor of torch .* got ndarray"):
        adapt(lambda given: np.zeros(len(given)), PolicyContract(VIEW))(images())
    with pytest.raises(PolicyContractError, match="initial_memory"):
        adapt(net(), PolicyContract(VIEW, stateless=False))


@pytest.mark.parametrize("goals", [0, 2])
def test_onnx_steers_as_torch_does(tmp_path, goals):
    policy = adapt(Strange(goals).eval(), strange(goals))
    file = tmp_path / "policy.onnx"
    export_onnx(policy.network, policy.contract, file)
    loaded = load_any_policy(file)
    assert (loaded.policy.differentiable, loaded.policy.stateless, loaded.policy.goal_size) == (
        False,
        True,
        goals,
    )
    assert loaded.view == VIEW
    goal = torch.rand(5, goals) if goals else None
    torch.testing.assert_close(loaded.policy(images(5), goal), policy(images(5), goal), atol=1e-5, rtol=1e-3)
    rgb = (np.random.default_rng(0).random((66, 200, 3)) * 255).astype(np.uint8)
    driver = load_driver(file, loaded.sha256)
    one = torch.from_numpy(rgb).permute(2, 0, 1)[None] / 255.0
    goal = (0.5,) * goals
    expected = float(policy(one, torch.tensor([goal]) if goals else None)[0])
    assert driver.steer(rgb, goal) == pytest.approx(expected, abs=1e-5)
    with pytest.raises(PolicyContractError, match="expected the policy abc"):
        load_driver(file, "abc")


def test_a_foreign_onnx_file_is_declared_beside_it(tmp_path):
    import onnx

    file = tmp_path / "policy.onnx"
    export_onnx(net(), PolicyContract(VIEW), file)
    model = onnx.load(file)
    del model.metadata_props[:]
    for value in (model.graph.input[0], model.graph.output[0]):
        value.type.tensor_type.shape.dim[0].dim_value = 1  # a fixed batch, as many exporters leave it
    onnx.save(model, file)
    with pytest.raises(
        PolicyContractError, match=r"says nothing about its colours.*policy\.onnx\.policy\.yaml"
    ):
        OnnxNetwork(file)
    beside = tmp_path / "policy.onnx.policy.yaml"
    beside.write_text(yaml.safe_dump({"view": VIEW.to_dict(), "positive": "right"}))
    steering = steering_of(OnnxNetwork(file), images(4).numpy())
    np.testing.assert_allclose(steering, -net()(images(4)).numpy(), atol=1e-5)
    beside.write_text("{view: [")
    with pytest.raises(PolicyContractError, match="cannot read the declaration"):
        OnnxNetwork(file)
    file.write_bytes(b"garbage")
    with pytest.raises(PolicyContractError, match="expected an ONNX model"):
        OnnxNetwork(file)
    with pytest.raises(PolicyContractError, match="No such file"):
        OnnxNetwork(tmp_path / "none.onnx")


def test_an_exported_program_keeps_its_gradient(tmp_path):
    policy = adapt(Strange(2).eval().requires_grad_(False), strange(2))
    file = tmp_path / "policy.pt2"
    export_program(policy.network, policy.contract, file)
    loaded = load_any_policy(file).policy
    x, goal = images(5).requires_grad_(), torch.rand(5, 2)
    steering = loaded(x, goal)
    torch.testing.assert_close(steering, policy(images(5), goal), atol=1e-5, rtol=1e-3)
    (slope,) = torch.autograd.grad(steering.sum(), x)
    y = images(5).requires_grad_()
    (expected,) = torch.autograd.grad(policy(y, goal).sum(), y)
    torch.testing.assert_close(slope, expected, atol=1e-6, rtol=1e-3)
    assert all(not parameter.requires_grad for parameter in loaded.parameters())


def test_what_cannot_be_exported_is_one_error(tmp_path):
    pooled = nn.Sequential(nn.AdaptiveAvgPool2d((7, 7)), nn.Flatten(), nn.Linear(147, 1)).eval()
    with pytest.raises(PolicyContractError, match="cannot be written as ONNX"):
        export_onnx(pooled, PolicyContract(VIEW), tmp_path / "a.onnx")

    class Branching(nn.Module):
        def forward(self, given):
            return given.mean((1, 2, 3)) if float(given.mean()) > 0.5 else given.sum((1, 2, 3))

    with pytest.raises(PolicyContractError, match="cannot be exported"):
        export_program(Branching().eval(), PolicyContract(VIEW), tmp_path / "a.pt2")
    assert list(tmp_path.iterdir()) == []


class Bomb:
    def __reduce__(self):
        return (sys.exit, ("a stranger's code ran",))


@pytest.mark.parametrize("member", ["sample", "weights", "garbage"])
def test_a_program_with_pickled_objects_is_refused_unread(tmp_path, member):
    good, bad = tmp_path / "good.pt2", tmp_path / "bad.pt2"
    export_program(net(), PolicyContract(VIEW), good)
    if member == "garbage":
        bad.write_bytes(b"garbage")
    else:
        with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as target:
            for name in source.namelist():
                content = source.read(name)
                if member == "sample" and name.endswith("model.pt"):
                    buffer = io.BytesIO()
                    torch.save(Bomb(), buffer, pickle_module=pickle)
                    content = buffer.getvalue()
                if member == "weights" and name.endswith("weights_config.json"):
                    content = content.replace(b'"use_pickle": false', b'"use_pickle": true')
                    assert b'"use_pickle": true' in content
                target.writestr(name, content)
    with pytest.raises(
        PolicyContractError, match="can run code: refused" if member != "garbage" else "exported program"
    ):
        load_adapted(bad)


FACTORY = """
import torch
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.view import PolicyView
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract
CONTRACT = PolicyContract(PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)))
def good():
    torch.manual_seed(3)
    return adapt(PilotNet().eval(), CONTRACT)
def training():
    return adapt(PilotNet(), CONTRACT)
def bare():
    return PilotNet().eval()
def broken():
    return 1 / 0
"""


def test_a_factory_is_found_frozen_and_named_by_its_content(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "somebodys_policy.py").write_text(FACTORY)
    loaded = load_any_policy("somebodys_policy:good")
    assert loaded.sha256 == load_any_policy("somebodys_policy:good").sha256
    assert not any(parameter.requires_grad for parameter in loaded.policy.parameters())
    assert load_any_policy("somebodys_policy:good", loaded.sha256).view == VIEW
    for name, message in {
        "training": r"training mode; call \.eval\(\)",
        "bare": r"to return adapt\(network, PolicyContract\(...\)\), got PilotNet",
        "broken": "failed: ZeroDivisionError",
        "none": "cannot find somebodys_policy:none",
    }.items():
        with pytest.raises(PolicyContractError, match=message):
            load_any_policy(f"somebodys_policy:{name}")
    for number, (code, message) in enumerate(
        {
            "import os\nos = = 1\n": "my_broken_0 cannot be loaded: SyntaxError: invalid syntax",
            "print(undefined)\n": "my_broken_1 cannot be loaded: NameError: name 'undefined'",
            "import sys\nsys.exit(0)\n": "my_broken_2 cannot be loaded: SystemExit: 0",
        }.items()
    ):
        (tmp_path / f"my_broken_{number}.py").write_text(code)
        with pytest.raises(PolicyContractError, match=message):
            load_any_policy(f"my_broken_{number}:factory")


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("policy.tflite", "; convert it with tf2onnx"),
        ("policy.pt", "; such files run code when they are opened: write a .pt2 with torch.export.save or"),
        ("policy.engine", "; it is for one GPU: give the .onnx"),
        ("policy.py", "; name a function in it: package.module:factory"),
        ("POLICY.ONNX", "; write its ending in small letters"),
        ("policy", "; correct the name"),
    ],
)
def test_files_of_other_kinds_are_told_what_makes_a_policy_of_them(tmp_path, name, advice):
    (tmp_path / name).touch()
    told = re.escape(f"{tmp_path / name}{advice}")
    for reads in (load_any_policy, guess_contract):
        with pytest.raises(PolicyContractError, match=told):
            reads(tmp_path / name)


def test_a_function_in_a_file_is_told_how_modules_are_named(tmp_path):
    for spec in ("pol.py:drive", "./sub/pol.py:drive"):
        assert not is_factory(spec)
        with pytest.raises(
            PolicyContractError, match=r"got .*pol\.py:drive; write pol:drive, and start in the folder"
        ):
            load_any_policy(spec)
    assert is_factory("py:drive")


def test_our_own_file_is_one_of_them(tmp_path):
    digest = save_policy(tmp_path / "policy.safetensors", net(), VIEW, {})
    loaded = load_any_policy(tmp_path / "policy.safetensors", digest)
    adapted, sha256 = load_adapted(tmp_path / "policy.safetensors")
    assert sha256 == digest == load_driver(tmp_path / "policy.safetensors").sha256
    torch.testing.assert_close(adapted(images()), loaded.policy(images()))


def test_a_recurrent_policy_remembers_from_image_to_image(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "recurrent_policy.py").write_text(
        FACTORY
        + """
class Mean(torch.nn.Module):
    def initial_memory(self, batch):
        return torch.zeros(batch, 1)
    def forward(self, images, goals, memory):
        memory = 0.5 * memory + images.mean(dim=(1, 2, 3))[:, None]
        return memory, memory
def factory():
    return adapt(Mean().eval(), PolicyContract(CONTRACT.view, stateless=False))
"""
    )
    driver = load_driver("recurrent_policy:factory")
    white = np.full((66, 200, 3), 255, np.uint8)
    assert [driver.steer(white, ()) for _ in range(3)] == pytest.approx([1.0, 1.5, 1.75])
    driver.reset()
    assert driver.steer(white, ()) == pytest.approx(1.0)


def test_the_attack_knows_a_black_box(tmp_path):
    from advnerf_core.attack.adjoint import adjoint_gradient

    file = tmp_path / "policy.onnx"
    export_onnx(net(), PolicyContract(VIEW), file)

    class Dynamics:
        state_size, dt_s = 3, 0.1

    problem = AttackProblem(load_any_policy(file).policy, None, Dynamics(), None, torch.zeros(1, 3), 2)
    with pytest.raises(BlackBoxError, match="declares differentiable = False"):
        adjoint_gradient(problem, torch.zeros(2, 2, 3))


def udacity(**changes):
    """The public behavioural-cloning PilotNet: cropped, YUV in -1..1, a share of 25 degrees, positive to the right."""
    view = replace(VIEW, crop_top_px=60, crop_height_px=103, crop_left_px=16, crop_width_px=300)
    declared = {
        "colour_space": "YUV",
        "value_max": 255.0,
        "mean": (127.5,),
        "std": (127.5,),
        "layout": "NHWC",
    }
    return PolicyContract(
        view,
        **{
            **declared,
            "output_unit": "normalised",
            "full_steering_rad": 0.436,
            "positive": "right",
            **changes,
        },
    )


class YuvPilot(nn.Module):
    """PilotNet behind the layout of channels last; its input is YUV and its output a share of the full angle."""

    def __init__(self):
        super().__init__()
        self.inner = net()

    def forward(self, given):
        return self.inner(0.5 * given.permute(0, 3, 1, 2) + 0.5)[:, None] / 0.3


def test_yuv_and_grey_are_what_opencv_makes_of_an_8_bit_picture():
    import cv2

    rgb = np.random.default_rng(3).integers(0, 256, (66, 200, 3)).astype(np.uint8)
    planes = np.moveaxis(rgb, -1, 0)[None].astype(np.float32) / np.float32(255.0)
    yuv = PolicyContract(VIEW, "YUV", 255.0).to_network(planes)[0]
    # 8-bit OpenCV rounds the luma before it takes the differences.
    assert np.abs(np.moveaxis(yuv, 0, -1) - cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV)).max() < 1.6
    grey = PolicyContract(VIEW, "GRAY", 255.0).to_network(planes)
    assert grey.shape == (1, 1, 66, 200)
    assert np.abs(grey[0, 0] - cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)).max() < 0.6
    saturated = PolicyContract(VIEW, "YUV").to_network(
        np.array([[[[1.0]], [[0.0]], [[0.0]]]]).repeat(66, 2).repeat(200, 3)
    )
    assert saturated.max() == 1.0  # V of pure red lies beyond what 8 bits hold


@pytest.mark.parametrize("space", ["YUV", "GRAY", "BGR"])
def test_the_gradient_through_a_colour_space_agrees_with_finite_differences(space):
    contract = PolicyContract(SMALL, space, 255.0, (127.5,), (127.5,))
    weights = torch.randn(
        contract.channels, *contract.size, generator=torch.Generator().manual_seed(2)
    ).double()
    policy = adapt(lambda given: 0.1 * torch.tanh(1e-2 * (weights * given.sin()).sum((1, 2, 3))), contract)
    # Away from full saturation, where V is clipped.
    x = (0.2 + 0.6 * images(1, contract).double()).requires_grad_()
    (gradient,) = torch.autograd.grad(policy(x).sum(), x)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(4)).double()
    with torch.no_grad():
        numeric = (policy(x + 1e-6 * direction) - policy(x - 1e-6 * direction)) / 2e-6
    assert float((gradient * direction).sum()) == pytest.approx(float(numeric), rel=1e-6)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"output_unit": "1/m", "full_steering_rad": None, "wheelbase_m": 0.25},
        {"output_unit": "deg", "full_steering_rad": None, "steering_ratio": 15.0, "colour_space": "BGR"},
    ],
)
def test_a_public_pilotnet_steers_alike_live_in_onnx_and_in_an_attack(tmp_path, changes):
    contract = udacity(**changes)
    policy = adapt(YuvPilot().eval(), contract)
    assert PolicyContract.from_dict(contract.to_dict()) == contract
    file = tmp_path / "policy.onnx"
    export_onnx(policy.network, contract, file)
    frame = np.random.default_rng(0).integers(0, 256, (188, 336, 3)).astype(np.uint8)
    driver = load_driver(file)
    seen = driver.view.image(frame)
    planes = torch.from_numpy(seen).permute(2, 0, 1)[None] / 255.0
    expected = float(policy(planes)[0])
    assert abs(expected) > 1e-4
    assert driver.steer(seen, ()) == pytest.approx(expected, abs=1e-5)
    raw = float(policy.network(contract.to_network(planes))[0])
    angles = {"normalised": 0.436 * raw, "1/m": np.arctan(0.25 * raw), "deg": np.deg2rad(raw) / 15.0}
    assert expected == pytest.approx(-angles[contract.output_unit], abs=1e-7)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"full_steering_rad": None},
            "full_steering_rad: expected a number > 0 with output_unit = 'normalised'",
        ),
        ({"output_unit": "1/m", "full_steering_rad": None}, "wheelbase_m: expected a number > 0"),
        (
            {"full_steering_rad": 25.0},
            r"full_steering_rad: expected at most 1\.5 rad \(25 degrees are 0\.436\), got 25",
        ),
        (
            {"output_unit": "1/m", "full_steering_rad": None, "wheelbase_m": 2700.0},
            "wheelbase_m: expected at most 20 m, got 2700",
        ),
        ({"output_unit": "rad"}, "full_steering_rad: expected it with output_unit = 'normalised' only"),
        ({"steering_ratio": 15.0}, "steering_ratio: expected it with output_unit = 'rad' or 'deg' only"),
        ({"colour_space": "GRAY", "mean": (1.0, 2.0, 3.0)}, "mean: expected 1 number or 1"),
    ],
)
def test_a_declaration_that_contradicts_itself_is_one_error(changes, message):
    with pytest.raises(PolicyContractError, match=message):
        udacity(**changes)


def test_a_mean_for_all_channels_may_be_a_single_number_in_a_file():
    data = {"view": VIEW.to_dict(), "mean": 127.5, "std": 127.5, "value_max": 255}
    assert PolicyContract.from_dict(data).mean == (127.5,)
    in_python = PolicyContract(VIEW, mean=127.5, std=[127.5], value_max=255)  # type: ignore[arg-type]
    assert in_python == PolicyContract.from_dict(data)
    with pytest.raises(PolicyContractError, match="mean: expected a number, got 'grey'"):
        PolicyContract(VIEW, mean="grey")  # type: ignore[arg-type]
