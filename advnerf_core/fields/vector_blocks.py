"""Blocks of matrix products for CPU kernels, as numba intrinsics that keep their sums in vector registers.

A loop nest over a whole tile stores and reloads its sums for every few multiply-adds, and numba has no vectors to keep them in. An
intrinsic writes LLVM code for one block: a few rows of the result by `LANES` samples. LLVM splits these vectors into those of the
machine. Each sum has the same order for any number of rows, so that machines differ only in their rounding of multiply-adds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 16  # samples
# Rows whose sums are kept at once; processors with AVX-512 have twice the registers.
ROWS = 8 if dict(get_host_cpu_features()).get("avx512vl") else 4
OUTER_ROWS, OUTER_COLUMNS = 4, 2

_FLOAT, _INT = ir.FloatType(), ir.IntType(64)
_VECTOR = ir.VectorType(_FLOAT, LANES)
_ZEROS = ir.Constant(_VECTOR, [0.0] * LANES)
_UNDEFINED = ir.Constant(_VECTOR, ir.Undefined)
_FIRST_LANE = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)


class _Emitter:
    """Emits vector code over the arrays among an intrinsic's arguments."""

    def __init__(self, context: Any, builder: Any, kinds: Any, values: Any) -> None:
        self.builder = builder
        self.values = [
            context.make_array(kind)(context, builder, value).data if isinstance(kind, types.Array) else value
            for kind, value in zip(kinds, values, strict=True)
        ]

    def at(self, pointer: Any, row: Any, row_length: Any, column: Any) -> Any:
        index = self.builder.add(self.builder.mul(row, row_length), column)
        return self.builder.gep(pointer, [index])

    def load(self, pointer: Any) -> Any:
        value = self.builder.load(self.builder.bitcast(pointer, _VECTOR.as_pointer()))
        value.align = 4
        return value

    def store(self, value: Any, pointer: Any) -> None:
        self.builder.store(value, self.builder.bitcast(pointer, _VECTOR.as_pointer())).align = 4

    def splat(self, scalar: Any) -> Any:
        first = self.builder.insert_element(_UNDEFINED, scalar, ir.Constant(ir.IntType(32), 0))
        return self.builder.shuffle_vector(first, _UNDEFINED, _FIRST_LANE)

    def zero_where_not_positive(self, value: Any, deciding: Any) -> Any:
        # NaN compares as false, and stays.
        return self.builder.select(self.builder.fcmp_ordered("<=", deciding, _ZEROS), _ZEROS, value)

    def multiply_add(self, a: Any, b: Any, held: Any) -> None:
        kind = ir.FunctionType(_VECTOR, [_VECTOR] * 3)
        function = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.fmuladd.v{LANES}f32")
        self.builder.store(self.builder.call(function, [a, b, self.builder.load(held)]), held)

    def total(self, value: Any) -> Any:
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(
            self.builder.module, ir.FunctionType(_FLOAT, [_FLOAT, _VECTOR]), name
        )
        return self.builder.call(function, [ir.Constant(_FLOAT, 0.0), value], fastmath=("reassoc",))

    def held(self, value: Any) -> Any:
        """A vector that becomes a register."""
        place = cgutils.alloca_once(self.builder, _VECTOR)
        self.builder.store(value, place)
        return place


def _checked(*kinds: Any) -> None:
    for kind in kinds:
        if isinstance(kind, types.Array) and not (kind.layout == "C" and kind.dtype == types.float32):
            raise TypeError(f"expected contiguous float32 arrays, got {kind}")


def product_block(rows: int, ending: str = "") -> Callable[..., None]:
    """An intrinsic ``(weight, bias, x, y, mask, j, n, K, width)`` for rows ``j..j + rows`` of ``weight @ x + bias``, columns ``n..n + LANES``.

    Its arrays are ``weight [J, K]``, ``bias [J]``, ``x [K, width]``, ``y [J, width]``, ``mask [J, width]``, contiguous float32.

    Args:
        ending: ``rectified``: negative results become zero; ``masked``: those become zero whose ``mask`` is not positive.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Emitter(context, builder, signature.args, arguments)
        weight, bias, x, y, mask, j, n, length, width = code.values
        of_row = [builder.add(j, _INT(row)) for row in range(rows)]
        sums = [code.held(code.splat(builder.load(builder.gep(bias, [row])))) for row in of_row]
        with cgutils.for_range(builder, length) as loop:
            column = code.load(code.at(x, loop.index, width, n))
            for row, held in zip(of_row, sums, strict=True):
                factor = builder.load(code.at(weight, row, length, loop.index))
                code.multiply_add(code.splat(factor), column, held)
        for row, held in zip(of_row, sums, strict=True):
            value = builder.load(held)
            if ending:
                deciding = value if ending == "rectified" else code.load(code.at(mask, row, width, n))
                value = code.zero_where_not_positive(value, deciding)
            code.store(value, code.at(y, row, width, n))
        return context.get_dummy_value()

    def block(typing, weight, bias, x, y, mask, j, n, length, width):  # type: ignore[no-untyped-def]
        _checked(weight, bias, x, y, mask)
        size = types.int64
        return types.void(weight, bias, x, y, mask, size, size, size, size), emit

    return intrinsic(block)


def outer_block(rows: int, columns: int) -> Callable[..., None]:
    """An intrinsic ``(grad, x, out, j, k, K, width)`` that adds rows ``j..j + rows``, columns ``k..k + columns`` of ``grad @ x^T`` to ``out``.

    Its arrays are ``grad [J, width]``, ``x [K, width]``, ``out [J, K]``, contiguous float32; ``width`` is a multiple of `LANES`.
    """

    def emit(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        code = _Emitter(context, builder, signature.args, arguments)
        grad, x, out, j, k, length, width = code.values
        of_row = [builder.add(j, _INT(row)) for row in range(rows)]
        of_column = [builder.add(k, _INT(column)) for column in range(columns)]
        sums = [[code.held(_ZEROS) for _ in of_column] for _ in of_row]
        with cgutils.for_range(builder, builder.udiv(width, _INT(LANES))) as loop:
            n = builder.mul(loop.index, _INT(LANES))
            parts = [code.load(code.at(x, column, width, n)) for column in of_column]
            for row, held in zip(of_row, sums, strict=True):
                slope = code.load(code.at(grad, row, width, n))
                for part, each in zip(parts, held, strict=True):
                    code.multiply_add(slope, part, each)
        for row, held in zip(of_row, sums, strict=True):
            for column, each in zip(of_column, held, strict=True):
                place = code.at(out, row, length, column)
                builder.store(builder.fadd(builder.load(place), code.total(builder.load(each))), place)
        return context.get_dummy_value()

    def block(typing, grad, x, out, j, k, length, width):  # type: ignore[no-untyped-def]
        _checked(grad, x, out)
        size = types.int64
        return types.void(grad, x, out, size, size, size, size), emit

    return intrinsic(block)
