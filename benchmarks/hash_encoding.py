"""How much faster are the hash encoding's CPU kernels than plain torch indexing? Same run, same points, same machine."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig, encode_reference
from benchmarks.results import record_row

POINTS = 131_072
TARGET = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3, help="timed rounds; the best of each counts")
    parser.add_argument("--dry-run", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()

    grid = HashGrid(HashGridConfig(levels=16, features=2, log2_entries=17))
    points = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    weights = torch.randn(POINTS, grid.config.width, generator=torch.Generator().manual_seed(1))

    kernel, plain = [], []
    with torch.no_grad():
        grid.table.normal_(generator=torch.Generator().manual_seed(2))
        difference = (grid(points) - encode_reference(points, grid.table, grid.levels)).abs().max().item()
    seconds(lambda: grid(points), weights, grid)  # compiles
    for _ in range(arguments.repeats):  # alternating, so that other load on the machine hits both
        kernel.append(min(seconds(lambda: grid(points), weights, grid) for _ in range(5)))
        plain.append(seconds(lambda: encode_reference(points, grid.table, grid.levels), weights, grid))
    ratio = min(plain) / min(kernel)
    note = f"forward + backward {1e3 * min(kernel):.0f} ms against {1e3 * min(plain):.0f} ms; values agree to {difference:.0e}"
    print(f"{ratio:.1f} x: {note}")
    if not arguments.dry_run:
        record_row(
            "#2 hash encoding forward + backward against plain torch indexing",
            ratio, "x", ">= 20 x", ratio >= TARGET, "python -m benchmarks.hash_encoding", note,
        )  # fmt: skip


def seconds(encode: Callable[[], torch.Tensor], weights: torch.Tensor, grid: HashGrid) -> float:
    """Wall time of one forward and backward pass [s]."""
    grid.table.grad = None
    began = time.perf_counter()
    encode().backward(weights)
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
