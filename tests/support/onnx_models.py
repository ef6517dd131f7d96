"""Small ONNX models whose answers are known without running them."""

import numpy as np
import onnx
import yaml
from onnx import TensorProto, helper, numpy_helper

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.answer import answer
from advnerf_core.policies.view import PolicyView

VIEW = PolicyView(Pinhole(12, 8, 6.0, 6.0, 6.0, 4.0), crop_top_px=0, crop_height_px=8, width=12, height=8)
IMAGE = ("B", 3, 8, 12)


def mean_model(gains, kind=TensorProto.FLOAT, columns=False):
    """A model whose outputs are ``gain * mean(images)``: one output ``[B, 1]`` for each gain, or one ``[B, N]`` for all."""
    nodes = [
        helper.make_node("Cast", ["images"], ["real"], to=TensorProto.FLOAT),
        helper.make_node("ReduceMean", ["real"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Flatten", ["mean"], ["column"]),
    ]
    weights = []
    rows = {"steering": gains} if columns else {name: [gain] for name, gain in gains.items()}
    for name, row in rows.items():
        weights.append(numpy_helper.from_array(np.array([row], np.float32), f"gain_{name}"))
        nodes.append(helper.make_node("Mul", ["column", f"gain_{name}"], [name]))
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["B", len(row)]) for name, row in rows.items()
    ]
    image = helper.make_tensor_value_info("images", kind, list(IMAGE))
    graph = helper.make_graph(nodes, "mean", [image], outputs, weights)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)


def network_model(nodes, inputs, outputs, weights=None):
    """A model of nodes ``(operation, inputs, outputs, attributes)``, with tensors ``name: (type, shape)`` and weights by name."""
    tensors = [
        [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in some.items()]
        for some in (inputs, outputs)
    ]
    made = [helper.make_node(operation, takes, gives, **more) for operation, takes, gives, more in nodes]
    constants = [numpy_helper.from_array(value, name) for name, value in (weights or {}).items()]
    graph = helper.make_graph(made, "network", *tensors, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.checker.check_model(model)
    return model


def save_beside(model, file, declared=None, weights=None):
    """Write a model with its declaration, and its weights into another file if one is named."""
    file.parent.mkdir(parents=True, exist_ok=True)
    if weights is not None:
        onnx.external_data_helper.convert_model_to_external_data(
            model, location=weights, size_threshold=0, convert_attribute=False
        )
    onnx.save(model, file)
    return declare_beside(file, declared or {})


def declare_beside(file, declared):
    """Write the declaration of a file; it has `VIEW` if it names no other."""
    declaration = {"view": VIEW.to_dict(), **declared}
    file.with_name(file.name + ".policy.yaml").write_text(yaml.safe_dump(declaration))
    return file


def steering(network, grey, count=2):
    """Steering of ``count`` images of one grey in 0..1."""
    return steering_of(network, np.full((count, 3, 8, 12), grey, np.float32))


def steering_of(network, images):
    """Steering ``[B]`` [rad] of images ``[B, 3, H, W]`` in 0..1 by an `OnnxNetwork` without memory: the whole contract, without torch."""
    raw, _ = answer(network.contract, network, images)
    return np.asarray(network.contract.to_steering_rad(raw, len(images)))
