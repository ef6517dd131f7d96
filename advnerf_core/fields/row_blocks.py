"""Weighted sums of table rows for four points at a time, and their transpose, as numba intrinsics.

A loop over points stores each feature of a point on its own, a tile's width apart. Four points have vectors of their features
transposed in registers, so that every load and store moves a vector. The order of each sum is that of the loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.extending import intrinsic

from advnerf_core.fields.vector_code import INT, VectorCode, signature

POINTS = 4


def gather_block(features: int, corners: int, chunk: int) -> Callable[..., None]:
    """An intrinsic ``(table, F, j, rows, weights, n, out, at, width)`` for features ``j..j + features`` of points ``n..n + POINTS``.

    Its arrays are ``table [entries, F]``, ``rows [corners * chunk]`` uint32, ``weights [corners * chunk]``, and ``out``, in which
    neighbouring features of a point are ``width`` apart. The first result is written to element ``at`` of ``out``.

    Args:
        features: 2 or 4.
        corners: Rows that are summed for a point.
        chunk: Distance between the rows of a point in ``rows``.
    """

    def emit(context: Any, builder: Any, signed: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signed.args, arguments, features)
        table, length, j, rows, weights, n, out, at, width = code.values
        sums = []
        for point in range(POINTS):
            held = code.zeros
            for corner in range(corners):
                place, weight = _corner(code, table, length, j, rows, weights, n, corner * chunk + point)
                held = code.multiply_add(code.load(place), weight, held)
            sums.append(held)
        for row, vector in enumerate(_by_feature(code, sums)):
            code.store(vector, code.at(out, INT(row), width, at))
        return context.get_dummy_value()

    def block(typing, table, length, j, rows, weights, n, out, at, width):  # type: ignore[no-untyped-def]
        return signature(table, length, j, rows, weights, n, out, at, width), emit

    return intrinsic(block)


def scatter_block(features: int, corners: int, chunk: int) -> Callable[..., None]:
    """An intrinsic ``(table, F, j, rows, weights, n, grad, at, width)`` that adds the transpose of `gather_block` to ``table``."""

    def emit(context: Any, builder: Any, signed: Any, arguments: Any) -> Any:
        code = VectorCode(context, builder, signed.args, arguments, features)
        table, length, j, rows, weights, n, grad, at, width = code.values
        four = VectorCode(context, builder, (), (), POINTS)
        of_feature = [four.load(four.at(grad, INT(row), width, at)) for row in range(features)]
        for point, slope in enumerate(_by_point(code, of_feature)):
            for corner in range(corners):
                place, weight = _corner(code, table, length, j, rows, weights, n, corner * chunk + point)
                code.store(code.multiply_add(slope, weight, code.load(place)), place)
        return context.get_dummy_value()

    def block(typing, table, length, j, rows, weights, n, grad, at, width):  # type: ignore[no-untyped-def]
        return signature(table, length, j, rows, weights, n, grad, at, width), emit

    return intrinsic(block)


def _corner(
    code: VectorCode, table: Any, length: Any, j: Any, rows: Any, weights: Any, n: Any, offset: int
) -> tuple[Any, Any]:
    """Place of a row's features, and its weight in all lanes."""
    builder = code.builder
    index = builder.add(n, INT(offset))
    row = builder.zext(builder.load(builder.gep(rows, [index])), INT)
    return code.at(table, row, length, j), code.splat(builder.load(builder.gep(weights, [index])))


def _by_feature(code: VectorCode, points: list[Any]) -> list[Any]:
    """Vectors ``[features][POINTS]`` of those ``[POINTS][features]``."""
    a, b, c, d = points
    if code.lanes == 2:
        ab, cd = code.shuffled(a, b, range(4)), code.shuffled(c, d, range(4))
        return [code.shuffled(ab, cd, [0, 2, 4, 6]), code.shuffled(ab, cd, [1, 3, 5, 7])]
    low, high = [0, 4, 1, 5], [2, 6, 3, 7]
    pairs = [code.shuffled(a, b, order) for order in (low, high)]
    others = [code.shuffled(c, d, order) for order in (low, high)]
    return [
        code.shuffled(pair, other, order)
        for pair, other in zip(pairs, others, strict=True)
        for order in ([0, 1, 4, 5], [2, 3, 6, 7])
    ]


def _by_point(code: VectorCode, features: list[Any]) -> list[Any]:
    """Vectors ``[POINTS][features]`` of those ``[features][POINTS]``."""
    if code.lanes == 4:
        return _by_feature(code, features)
    return [code.shuffled(features[0], features[1], [point, POINTS + point]) for point in range(POINTS)]
