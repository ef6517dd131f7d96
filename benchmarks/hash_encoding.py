"""How much faster are the hash encoding's CPU kernels than plain torch indexing? Same run, same points, same machine."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from statistics import median

import torch

from advnerf_core.fields.hash_grid import HashGrid, HashGridConfig, encode_reference
from benchmarks.results import record_row
from benchmarks.timing import runs_in_turns

POINTS = 131_072
TARGET = 20.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9, help="timed runs of each, in turns; medians count")
    parser.add_argument("--dry-run", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()

    grid = HashGrid(HashGridConfig(levels=16, features=2, log2_entries=17))
    points = torch.rand(POINTS, 3, generator=torch.Generator().manual_seed(0))
    weights = torch.randn(POINTS, grid.config.width, generator=torch.Generator().manual_seed(1))

    with torch.no_grad():
        grid.table.normal_(generator=torch.Generator().manual_seed(2))
        difference = (grid(points) - encode_reference(points, grid.table, grid.levels)).abs().max().item()
    runs = runs_in_turns(
        {
            "kernels": lambda: one_pass(lambda: grid(points), weights, grid),
            "plain": lambda: one_pass(
                lambda: encode_reference(points, grid.table, grid.levels), weights, grid
            ),
        },
        arguments.repeats,
    )
    kernels_s, plain_s = median(runs["kernels"]), median(runs["plain"])
    ratio = plain_s / kernels_s
    note = (
        f"forward + backward {1e3 * kernels_s:.0f} ms against {1e3 * plain_s:.0f} ms, medians of {arguments.repeats} in turns "
        f"(kernels {_span_ms(runs['kernels'])}, plain {_span_ms(runs['plain'])} ms); values agree to {difference:.0e}"
    )
    print(f"{ratio:.1f} x: {note}")
    if not arguments.dry_run:
        record_row(
            "hash encoding forward + backward against plain torch indexing",
            ratio,
            "x",
            ">= 20 x",
            ratio >= TARGET,
            "python -m benchmarks.hash_encoding",
            note,
        )


def one_pass(encode: Callable[[], torch.Tensor], weights: torch.Tensor, grid: HashGrid) -> None:
    """One forward and backward pass."""
    grid.table.grad = None
    encode().backward(weights)


def _span_ms(seconds: list[float]) -> str:
    return f"{1e3 * min(seconds):.0f} to {1e3 * max(seconds):.0f}"


if __name__ == "__main__":
    main()
