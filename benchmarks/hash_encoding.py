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
TARGETS = {17: 25.0, 19: 20.0}  # by the logarithm of a level's entries


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=9, help="timed runs of each, in turns; medians count")
    parser.add_argument("--dry-run", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()
    for log2_entries, target in TARGETS.items():
        ratio, note = compared(log2_entries, arguments.repeats)
        print(f"2^{log2_entries} entries: {ratio:.1f} x: {note}")
        if not arguments.dry_run:
            record_row(
                f"hash encoding, 16 x 2, 2^{log2_entries} entries, forward + backward against plain torch indexing",
                ratio,
                "x",
                f">= {target:g} x",
                ratio >= target,
                "python -m benchmarks.hash_encoding",
                note,
            )


def compared(log2_entries: int, repeats: int) -> tuple[float, str]:
    """How many times as fast the kernels are with so many entries a level, and how that was found."""
    grid = HashGrid(HashGridConfig(levels=16, features=2, log2_entries=log2_entries))
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
        repeats,
    )
    kernels_s, plain_s = median(runs["kernels"]), median(runs["plain"])
    note = (
        f"{1e3 * kernels_s:.0f} ms against {1e3 * plain_s:.0f} ms, medians of {repeats} in turns "
        f"(kernels {_span_ms(runs['kernels'])}, plain {_span_ms(runs['plain'])} ms); values agree to {difference:.0e}"
    )
    return plain_s / kernels_s, note


def one_pass(encode: Callable[[], torch.Tensor], weights: torch.Tensor, grid: HashGrid) -> None:
    """One forward and backward pass."""
    grid.table.grad = None
    encode().backward(weights)


def _span_ms(seconds: list[float]) -> str:
    return f"{1e3 * min(seconds):.0f} to {1e3 * max(seconds):.0f}"


if __name__ == "__main__":
    main()
