"""What a policy file says about itself, and what is asked for."""

import numpy as np
import onnx
import pytest
import torch
import yaml
from onnx import TensorProto, helper
from torch import nn

from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.guess import declaration_text, guess_contract
from advnerf_core.policies.load import load_any_policy
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from tests.support.onnx_models import VIEW, mean_model, network_model, save_beside

FLOAT, UINT8 = TensorProto.FLOAT, TensorProto.UINT8


def model(folder, inputs, outputs):
    """A file of constant outputs with the given names, types and shapes."""
    infos = [
        [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in some]
        for some in (inputs, outputs)
    ]
    nodes = []
    for name, _, shape in outputs:
        value = np.zeros([each if isinstance(each, int) else 1 for each in shape], np.float32)
        nodes.append(helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(value)))
    graph = helper.make_graph(nodes, "constant", *infos)
    file = folder / "policy.onnx"
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), file)
    return file


STEERING = ("steering", FLOAT, ["B", 1])


@pytest.mark.parametrize(
    ("image", "expected", "asked"),
    [
        (
            (FLOAT, ["B", 3, 66, 200]),
            {"layout": "NCHW", "colour_space": "RGB"},
            {"colour_space", "value_max"},
        ),
        ((FLOAT, [1, 120, 160, 3]), {"layout": "NHWC"}, {"colour_space", "value_max"}),
        ((UINT8, ["B", 120, 160, 1]), {"layout": "NHWC", "colour_space": "GRAY", "value_max": 255.0}, set()),
        (
            (FLOAT, ["B", 4, 84, 84]),
            {"colour_space": "GRAY", "frames": (4, "channels")},
            {"frames", "value_max"},
        ),
        (
            (UINT8, ["B", 66, 200, 9]),
            {"layout": "NHWC", "frames": (3, "channels")},
            {"frames", "colour_space"},
        ),
        (
            (FLOAT, ["B", 5, 3, 66, 200]),
            {"layout": "NCHW", "frames": (5, "time")},
            {"frames", "colour_space", "value_max"},
        ),
    ],
)
def test_the_image_input_says_layout_size_type_and_stack(tmp_path, image, expected, asked):
    contract, questions = guess_contract(model(tmp_path, [("input", *image)], [STEERING]))
    frames = contract.frames and (contract.frames.count, contract.frames.axis)
    found = {**vars(contract), "frames": frames}
    assert {name: found[name] for name in expected} == expected
    assert contract.input_shape == tuple(image[1][1:])
    assert {each.key for each in questions} == {"view", "output_unit", "positive"} | asked


def test_a_size_that_is_not_fixed_is_asked_for(tmp_path):
    contract, questions = guess_contract(model(tmp_path, [("x", FLOAT, ["B", 3, "h", "w"])], [STEERING]))
    assert contract.size == (66, 200)
    assert "in which size (not fixed in x [B, 3, h, w] float32)" in questions[0].text


def test_the_outputs_say_waypoints_columns_and_names(tmp_path):
    image = [("input", FLOAT, ["B", 3, 66, 200])]
    contract, questions = guess_contract(model(tmp_path, image, [("out", FLOAT, ["B", 8, 2])]))
    assert contract.trajectory.times_s == tuple(0.5 * number for number in range(1, 9))
    assert {each.key for each in questions} >= {"trajectory", "positive"}
    assert (
        guess_contract(model(tmp_path, image, [("trajectory", FLOAT, ["B", 20])]))[0].trajectory.times_s[-1]
        == 5.0
    )
    contract, questions = guess_contract(model(tmp_path, image, [("out", FLOAT, ["B", 2])]))
    assert contract.output_column == 0
    assert [each.choices for each in questions if each.key == "output_column"] == [("0", "1")]
    throttle = ("throttle", FLOAT, ["B", 1])
    contract, questions = guess_contract(model(tmp_path, image, [throttle, STEERING]))
    assert contract.output_name == "steering"
    assert "output_name" not in {each.key for each in questions}, "its name says it"
    _, questions = guess_contract(model(tmp_path, image, [("a", FLOAT, ["B", 1]), ("b", FLOAT, ["B", 1])]))
    assert [each.choices for each in questions if each.key == "output_name"] == [("a", "b")]


def test_memory_and_goal_are_told_apart(tmp_path):
    image, state = ("image", FLOAT, ["B", 3, 66, 200]), [1, "B", 64]
    inputs = [image, ("h_in", FLOAT, state), ("c_in", FLOAT, state), ("speed", FLOAT, ["B", 1])]
    outputs = [STEERING, ("throttle", FLOAT, ["B", 1]), ("c_out", FLOAT, state), ("h_out", FLOAT, state)]
    contract, questions = guess_contract(model(tmp_path, inputs, outputs))
    assert [(each.input, each.output, each.batch_axis) for each in contract.states] == [
        ("h_in", "h_out", 1),
        ("c_in", "c_out", 1),
    ]
    assert (contract.goal_size, contract.input_name, contract.output_name) == (1, "image", "steering")
    assert {"states", "goal_size"} <= {each.key for each in questions}
    text = declaration_text(contract, questions)
    assert "initial" in text, "what can be changed is seen"
    assert PolicyContract.from_dict(yaml.safe_load(text)) == contract


def test_an_output_is_left_to_steer_and_what_is_no_goal_is_refused(tmp_path):
    image, long = ("image", FLOAT, ["B", 3, 66, 200]), ["B", 64]
    contract, _ = guess_contract(
        model(tmp_path, [image, ("command", FLOAT, long)], [("scores", FLOAT, long)])
    )
    assert (contract.states, contract.goal_size) == ((), 64)
    with pytest.raises(PolicyContractError, match=r"at most one goal \[B, N\].*depth .*write a factory"):
        guess_contract(model(tmp_path, [image, ("depth", FLOAT, ["B", 1, 33, 100])], [STEERING]))


def scaled(folder, layers):
    """A file whose images go through constants ``(operation, value)`` and then a mean."""
    nodes, weights, name = [("Cast", ["images"], ["cast"], {"to": FLOAT})], {}, "cast"
    for number, (operation, value) in enumerate(layers):
        weights[f"value{number}"] = np.array(value, np.float32)
        nodes.append((operation, [name, f"value{number}"], [f"out{number}"], {}))
        name = f"out{number}"
    nodes.append(("ReduceMean", [name], ["steering"], {"axes": [1, 2, 3], "keepdims": 0}))
    shapes = {"images": (FLOAT, ["B", 3, 8, 12])}, {"steering": (FLOAT, ["B"])}
    onnx.save(network_model(nodes, *shapes, weights), folder / "scaled.onnx")
    return folder / "scaled.onnx"


@pytest.mark.parametrize(
    ("layers", "value_max"),
    [
        ([("Div", 255.0)], 255.0),
        ([("Mul", 1 / 127.5), ("Add", -1.0)], 255.0),
        ([("Sub", [[[104.0]], [[117.0]], [[124.0]]]), ("Div", 58.0)], 255.0),
        ([("Sub", [[[0.485]], [[0.456]], [[0.406]]]), ("Div", 0.22)], 1.0),
        ([("Mul", 2.0), ("Sub", 1.0)], 1.0),
        ([], None),
        ([("Div", 1.0)], None),
        ([("Add", 0.0)], None),
    ],
)
def test_a_network_that_scales_its_images_says_their_range(tmp_path, layers, value_max):
    contract, questions = guess_contract(scaled(tmp_path, layers))
    assert contract.value_max == (value_max or 1.0)
    assert ("value_max" in {each.key for each in questions}) == (value_max is None)


@pytest.mark.parametrize(
    ("means", "value_max"),
    [((110.0, 104.0, 90.0), 255.0), ((0.45, 0.42, 0.38), 1.0), ((0.04, -0.03, 0.01), None)],
)
def test_a_normalisation_says_the_range_unless_the_images_were_centred_before(tmp_path, means, value_max):
    weights = {name: np.ones(3, np.float32) for name in ("scale", "bias", "variance")}
    weights["mean"] = np.array(means, np.float32)
    nodes = [
        ("BatchNormalization", ["images", "scale", "bias", "mean", "variance"], ["first"], {}),
        ("ReduceMean", ["first"], ["steering"], {"axes": [1, 2, 3], "keepdims": 0}),
    ]
    file = tmp_path / "policy.onnx"
    shapes = {"images": (FLOAT, ["B", 3, 8, 12])}, {"steering": (FLOAT, ["B"])}
    onnx.save(network_model(nodes, *shapes, weights), file)
    contract, questions = guess_contract(file)
    assert contract.value_max == (value_max or 1.0)
    assert ("value_max" in {each.key for each in questions}) == (value_max is None)


def test_a_guess_with_its_answers_is_a_declaration(tmp_path):
    file = save_beside(mean_model({"steering": 0.25}), tmp_path / "policy.onnx")
    assert guess_contract(file) == (PolicyContract(VIEW), []), "a file with a declaration asks nothing"
    beside = tmp_path / "policy.onnx.policy.yaml"
    beside.unlink()
    contract, questions = guess_contract(file)
    assert questions
    beside.write_text(yaml.safe_dump({**contract.to_dict(), "output_unit": "deg"}))
    grey = torch.full((1, 3, 8, 12), 0.5)
    assert float(load_any_policy(file).policy(grey)) == pytest.approx(np.deg2rad(0.125))


def test_other_files(tmp_path):
    program = torch.export.export(nn.Sequential(nn.Flatten(), nn.Linear(288, 1)), (torch.rand(1, 3, 8, 12),))
    torch.export.save(program, tmp_path / "policy.pt2")
    contract, questions = guess_contract(tmp_path / "policy.pt2")
    assert contract.input_shape == (3, 8, 12)
    assert {each.key for each in questions} == {
        "view",
        "colour_space",
        "value_max",
        "output_unit",
        "positive",
    }
    save_policy(tmp_path / "policy.safetensors", PilotNet(2), VIEW, {})
    assert guess_contract(tmp_path / "policy.safetensors") == (PolicyContract(VIEW, goal_size=2), [])
    with pytest.raises(PolicyContractError, match=r"expected a policy file \(\.safetensors, \.onnx, \.pt2\)"):
        guess_contract(tmp_path / "policy.tflite")
    with pytest.raises(PolicyContractError, match=r"expected an input of images .*got x \[B, 20\] float32"):
        guess_contract(model(tmp_path, [("x", FLOAT, ["B", 20])], [STEERING]))
