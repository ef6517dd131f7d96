"""LLVM vector code inside numba kernels: what intrinsics need to load, multiply, add and store a few floats at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

INT = ir.IntType(64)
_FLOAT, _INDEX = ir.FloatType(), ir.IntType(32)


class VectorCode:
    """Emits vector code over the arguments of an intrinsic.

    Args:
        context: Target context of numba.
        kinds: Types of the arguments.
        lanes: Floats in a vector.

    Attributes:
        values: The arguments; for an array the pointer to its first element.
        zeros: A vector of zeros.
    """

    def __init__(self, context: Any, builder: Any, kinds: Any, values: Any, lanes: int) -> None:
        self.builder, self.lanes = builder, lanes
        self.kind = ir.VectorType(_FLOAT, lanes)
        self.zeros = ir.Constant(self.kind, [0.0] * lanes)
        self.values = [
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(kinds, values, strict=True)
        ]

    def at(self, pointer: Any, row: Any, row_length: Any, column: Any) -> Any:
        """Pointer to an element of a matrix."""
        index = self.builder.add(self.builder.mul(row, row_length), column)
        return self.builder.gep(pointer, [index])

    def load(self, pointer: Any) -> Any:
        """The vector that begins at a float."""
        value = self.builder.load(self.builder.bitcast(pointer, self.kind.as_pointer()))
        value.align = 4
        return value

    def store(self, value: Any, pointer: Any) -> None:
        """Write a vector from a float on."""
        place = self.builder.bitcast(pointer, value.type.as_pointer())
        self.builder.store(value, place).align = 4

    def splat(self, scalar: Any) -> Any:
        """A vector of equal floats."""
        nothing = ir.Constant(self.kind, ir.Undefined)
        first = self.builder.insert_element(nothing, scalar, ir.Constant(_INDEX, 0))
        return self.shuffled(first, nothing, [0] * self.lanes)

    def shuffled(self, a: Any, b: Any, lanes: Sequence[int]) -> Any:
        """A vector of lanes of two others, those of the second counted on."""
        order = ir.Constant(ir.VectorType(_INDEX, len(lanes)), list(lanes))
        return self.builder.shuffle_vector(a, b, order)

    def multiply_add(self, a: Any, b: Any, c: Any) -> Any:
        """``a b + c``, rounded once where the processor can."""
        kind = ir.FunctionType(self.kind, [self.kind] * 3)
        name = f"llvm.fmuladd.v{self.lanes}f32"
        return self.builder.call(cgutils.get_or_insert_function(self.builder.module, kind, name), [a, b, c])

    def total(self, value: Any) -> Any:
        """Sum of the lanes, in any order."""
        kind = ir.FunctionType(_FLOAT, [_FLOAT, self.kind])
        name = f"llvm.vector.reduce.fadd.v{self.lanes}f32"
        function = cgutils.get_or_insert_function(self.builder.module, kind, name)
        return self.builder.call(function, [ir.Constant(_FLOAT, 0.0), value], fastmath=("reassoc",))

    def register(self, value: Any) -> Any:
        """A place for a vector that loops change; it becomes a register."""
        place = cgutils.alloca_once(self.builder, self.kind)
        self.builder.store(value, place)
        return place


def signature(*arguments: Any) -> Any:
    """Signature of an intrinsic that returns nothing; its arrays must be contiguous.

    Raises:
        TypeError: An array is not.
    """
    for kind in arguments:
        if isinstance(kind, types.Array) and kind.layout != "C":
            raise TypeError(f"expected contiguous arrays, got {kind}")
    return types.void(*(kind if isinstance(kind, types.Array) else types.int64 for kind in arguments))
