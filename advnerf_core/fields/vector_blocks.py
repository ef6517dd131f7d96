"""Blocks of matrix products for CPU kernels, as numba intrinsics that keep their sums in vector registers.

A loop nest over a whole tile stores and reloads its sums for every few multiply-adds, and numba has no vectors to keep them in. An
intrinsic writes LLVM code for one block: a few rows of the result by `LANES` samples. LLVM splits these vectors into those of the
machine. Each sum has the same order for any number of rows, so that machines differ only in their rounding of multiply-adds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite.binding import get_host_cpu_features
from numba.core import cgutils
from numba.extending import intrinsic

from advnerf_core.fields.vector_code import INT, VectorCode, signature

LANES = 16  # samples
# Rows whose sums are kept at once; processors with AVX-512 have twice the registers.
ROWS = 8 if dict(get_host_cpu_features()).get("avx512vl") else 4
OUTER_ROWS, OUTER_COLUMNS = 4, 2


def product_block(rows: int, ending: str = "") -> Callable[..., None]:
    """An intrinsic ``(weight, bias, x, y, mask, j, n, K, width)`` for rows ``j..j + rows`` of ``weight @ x + bias``, columns ``n..n + LANES``.

    Its arrays are ``weight [J, K]``, ``bias [J]``, ``x [K, width]``, ``y [J, width]``, ``mask [J, width]``, contiguous float32.

    Args:
        ending: ``rectified``: negative results become zero; ``masked``: those become zero whose ``mask`` is not positive.
    """

    def emit(context: Any, builder: Any, signed: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signed.args, arguments, LANES)
        weight, bias, x, y, mask, j, n, length, width = code.values
        of_row = [builder.add(j, INT(row)) for row in range(rows)]
        sums = [code.register(code.splat(builder.load(builder.gep(bias, [row])))) for row in of_row]
        with cgutils.for_range(builder, length) as loop:
            column = code.load(code.at(x, loop.index, width, n))
            for row, held in zip(of_row, sums, strict=True):
                factor = builder.load(code.at(weight, row, length, loop.index))
                builder.store(code.multiply_add(code.splat(factor), column, builder.load(held)), held)
        for row, held in zip(of_row, sums, strict=True):
            value = builder.load(held)
            if ending:
                deciding = value if ending == "rectified" else code.load(code.at(mask, row, width, n))
                # NaN compares as false, and stays.
                value = builder.select(builder.fcmp_ordered("<=", deciding, code.zeros), code.zeros, value)
            code.store(value, code.at(y, row, width, n))
        return context.get_dummy_value()

    def block(typing, weight, bias, x, y, mask, j, n, length, width):  # type: ignore[no-untyped-def]
        return signature(weight, bias, x, y, mask, j, n, length, width), emit

    return intrinsic(block)


def outer_block(rows: int, columns: int) -> Callable[..., None]:
    """An intrinsic ``(grad, x, out, j, k, K, width)`` that adds rows ``j..j + rows``, columns ``k..k + columns`` of ``grad @ x^T`` to ``out``.

    Its arrays are ``grad [J, width]``, ``x [K, width]``, ``out [J, K]``, contiguous float32; ``width`` is a multiple of `LANES`.
    """

    def emit(context: Any, builder: Any, signed: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signed.args, arguments, LANES)
        grad, x, out, j, k, length, width = code.values
        of_row = [builder.add(j, INT(row)) for row in range(rows)]
        of_column = [builder.add(k, INT(column)) for column in range(columns)]
        sums = [[code.register(code.zeros) for _ in of_column] for _ in of_row]
        with cgutils.for_range(builder, builder.udiv(width, INT(LANES))) as loop:
            n = builder.mul(loop.index, INT(LANES))
            parts = [code.load(code.at(x, column, width, n)) for column in of_column]
            for row, held in zip(of_row, sums, strict=True):
                slope = code.load(code.at(grad, row, width, n))
                for part, each in zip(parts, held, strict=True):
                    builder.store(code.multiply_add(slope, part, builder.load(each)), each)
        for row, held in zip(of_row, sums, strict=True):
            for column, each in zip(of_column, held, strict=True):
                place = code.at(out, row, length, column)
                builder.store(builder.fadd(builder.load(place), code.total(builder.load(each))), place)
        return context.get_dummy_value()

    def block(typing, grad, x, out, j, k, length, width):  # type: ignore[no-untyped-def]
        return signature(grad, x, out, j, k, length, width), emit

    return intrinsic(block)
