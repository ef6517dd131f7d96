"""What the page knows of a policy's view, from its file alone."""

import onnx
import pytest
import torch

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.onnx_policy import export_onnx
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from nodes.operator_page.pictures import view_of_policy

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0), width=100, height=33)


@pytest.fixture
def network():
    torch.manual_seed(0)
    return PilotNet(0).eval().requires_grad_(False)


def test_the_view_of_a_policy_of_ours_and_of_an_exported_one(tmp_path, network):
    save_policy(tmp_path / "policy.safetensors", network, VIEW, {})
    export_onnx(
        torch.nn.Sequential(torch.nn.Upsample((66, 200)), network),
        PolicyContract(VIEW),
        tmp_path / "policy.onnx",
    )
    for name in ("policy.safetensors", "policy.onnx"):
        assert view_of_policy(str(tmp_path / name)) == VIEW


def test_a_file_without_a_declaration_has_no_view(tmp_path, network):
    export_onnx(
        torch.nn.Sequential(torch.nn.Upsample((66, 200)), network),
        PolicyContract(VIEW),
        tmp_path / "policy.onnx",
    )
    model = onnx.load(str(tmp_path / "policy.onnx"))
    del model.metadata_props[:]
    onnx.save(model, str(tmp_path / "bare.onnx"))
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    for name in ("bare.onnx", "broken.onnx", "missing.onnx", "policy.txt"):
        assert view_of_policy(str(tmp_path / name)) is None
