"""Half precision, numbered outputs and scores of steering values."""

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import TensorProto

from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.bins import SteeringBins
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.load import load_any_policy, load_driver
from tests.support.onnx_models import VIEW, mean_model, network_model, save_beside

FLOAT, HALF = TensorProto.FLOAT, TensorProto.FLOAT16
IMAGES = np.random.default_rng(0).integers(0, 256, (5, 8, 12, 3)).astype(np.uint8)


@pytest.mark.parametrize(("outside", "inside"), [(HALF, HALF), (FLOAT, HALF), (HALF, FLOAT)])
def test_half_precision_steers_as_onnx_runtime_does(tmp_path, outside, inside):
    weights = np.random.default_rng(1).normal(0.0, 0.05, (1, 3, 8, 12))
    nodes = [
        ("Cast", ["images"], ["inner"], {"to": inside}),
        ("Mul", ["inner", "weights"], ["weighted"], {}),
        ("ReduceMean", ["weighted"], ["mean"], {"axes": [1, 2, 3], "keepdims": 0}),
        ("Cast", ["mean"], ["steering"], {"to": outside}),
    ]
    held = {"weights": weights.astype(np.float16 if inside == HALF else np.float32)}
    model = network_model(nodes, {"images": (outside, ["B", 3, 8, 12])}, {"steering": (outside, ["B"])}, held)
    file = save_beside(model, tmp_path / "policy.onnx", {"value_max": 255})
    kind = np.float16 if outside == HALF else np.float32
    given = np.moveaxis(IMAGES, -1, 1).astype(kind)
    expected = onnxruntime.InferenceSession(file.read_bytes()).run(None, {"images": given})[0]
    assert np.ptp(expected) > 1e-3
    driver = load_driver(file)
    assert [driver.steer(image, ()) for image in IMAGES] == pytest.approx(expected.tolist(), abs=1e-6)
    found = load_any_policy(file).policy(torch.from_numpy(IMAGES).permute(0, 3, 1, 2) / 255.0)
    assert found.dtype == torch.float32
    assert found.tolist() == pytest.approx(expected.tolist(), abs=1e-6)


def test_an_output_may_be_named_by_its_number(tmp_path):
    file = save_beside(
        mean_model({"throttle": 0.7, "angle": -0.2}), tmp_path / "policy.onnx", {"output_index": 1}
    )
    assert load_driver(file).steer(np.full((8, 12, 3), 255, np.uint8), ()) == pytest.approx(-0.2)
    save_beside(mean_model({"throttle": 0.7}), file, {"output_index": 1})
    with pytest.raises(PolicyContractError, match=r"output_index: expected 0 to 0 of throttle .*got 1"):
        load_driver(file)
    with pytest.raises(PolicyContractError, match="expected output_name or output_index, got both"):
        PolicyContract(VIEW, output_name="a", output_index=1)


VALUES, SCORES = (-1.0, 0.0, 0.5), np.array([[0.1, 2.0, 1.9], [3.0, -1.0, 0.0], [90.0, 900.0, 0.0]])


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
def test_scores_of_steering_values(kind):
    scores = kind(SCORES)
    assert SteeringBins(values=VALUES).value(scores).tolist() == [0.0, -1.0, 0.0]
    shares = np.exp(SCORES - SCORES.max(1, keepdims=True))
    shares /= shares.sum(1, keepdims=True)
    expected = pytest.approx((shares * VALUES).sum(1).tolist(), abs=1e-12)
    assert SteeringBins(values=VALUES, choice="softmax").value(scores).tolist() == expected
    assert SteeringBins(values=VALUES, choice="mean").value(kind(shares)).tolist() == expected


def test_a_classifier_steers_and_has_a_gradient_where_its_choice_has_one(tmp_path):
    file = save_beside(
        mean_model([0.0, 1.0, 2.0], columns=True),
        tmp_path / "policy.onnx",
        {
            "bins": {"values": VALUES, "choice": "softmax"},
            "output_unit": "normalised",
            "full_steering_rad": 0.4,
        },
    )
    weights = np.exp([0.0, 1.0, 2.0])
    expected = 0.4 * float((weights * VALUES).sum() / weights.sum())
    assert load_driver(file).steer(np.full((8, 12, 3), 255, np.uint8), ()) == pytest.approx(
        expected, abs=1e-6
    )

    def network(images):
        return images.mean((1, 2, 3))[:, None] * torch.tensor([0.0, 1.0, 2.0], dtype=images.dtype)

    soft = adapt(network, PolicyContract(VIEW, bins=SteeringBins(values=VALUES, choice="softmax")))
    grey = torch.full((1, 3, 8, 12), 0.4, dtype=torch.float64, requires_grad=True)
    assert soft.differentiable
    assert torch.autograd.gradcheck(lambda grey: soft(grey.expand(1, 3, 8, 12)), grey[:, :1, :1, :1])
    assert not adapt(network, PolicyContract(VIEW, bins=SteeringBins(values=VALUES))).differentiable
    save_beside(mean_model([0.0, 1.0], columns=True), file, {"bins": {"values": VALUES}})
    with pytest.raises(PolicyContractError, match=r"bins.values: expected 2 for the output steering .*got 3"):
        load_driver(file)
