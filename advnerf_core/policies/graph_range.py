"""Infers the value range that an ONNX network expects from its first layers, if it scales its own images, like Keras's ``Rescaling``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

# Layers that do not change the values.
_PASSED = frozenset(
    {"Cast", "Identity", "Transpose", "Reshape", "Squeeze", "Unsqueeze", "Pad", "Slice", "Crop"}
)
# Layers that scale, and the constant with which they change nothing and say nothing; a mean always says something.
_NEUTRAL = {"BatchNormalization": None, "Sub": 0.0, "Add": 0.0, "Div": 1.0, "Mul": 1.0}
# A network for images in 0..1 divides by, or compares with, nothing larger than this.
_LARGEST_OF_ONE = 8.0


def value_max_of(path: Path, image: str) -> float | None:
    """White in the images of an ONNX file, 1 or 255, by its normalisation; None without one."""
    import onnx

    graph = onnx.load(path, load_external_data=False).graph
    constants = {each.name: each for each in graph.initializer}
    constants |= {
        node.output[0]: attribute.t
        for node in graph.node
        if node.op_type == "Constant"
        for attribute in node.attribute
        if attribute.name == "value"
    }
    name = image
    while (node := next((each for each in graph.node if name in each.input), None)) is not None:
        if node.op_type not in _PASSED:
            return _scale(node, constants)
        name = node.output[0]
    return None


def _scale(node: Any, constants: dict[str, Any]) -> float | None:
    """Range implied by the first layer that changes the values."""
    # The running mean of a batch normalisation is its fourth input.
    names = node.input[3:4] if node.op_type == "BatchNormalization" else node.input
    values = [_array(constants[name]) for name in names if name in constants]
    if node.op_type not in _NEUTRAL or not values or values[0] is None:
        return None
    largest = float(np.abs(values[0]).max(initial=0.0))
    if largest == _NEUTRAL[node.op_type]:
        return None
    # Images whose mean is below 0 were scaled before the network.
    if node.op_type == "BatchNormalization" and values[0].min(initial=0.0) < 0.0:
        return None
    if node.op_type == "Mul":
        largest = 1.0 / largest if largest > 0.0 else 0.0
    return 255.0 if largest > _LARGEST_OF_ONE else 1.0


def _array(tensor: Any) -> Any:
    """Values of a tensor; None if it is stored in another file."""
    import onnx

    if onnx.external_data_helper.uses_external_data(tensor):
        return None
    return onnx.numpy_helper.to_array(tensor)
