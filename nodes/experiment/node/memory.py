"""Peak memory of one gradient of a request against the horizon, in a process of its own.

``python -m nodes.experiment.node.memory REQUEST_FILE TICKS...`` prints each horizon and its peak above idle [MiB].
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from nodes.experiment.node.job import REQUEST
from nodes.experiment.node.prepare import load_request, prepare, request_text
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.memory import in_a_child, print_peaks


def measured_mib(request: Experiment, horizons: Sequence[int]) -> Iterator[tuple[int, float]]:
    """Horizons [ticks] and their peaks above idle [MiB], one after the other."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / REQUEST
        file.write_text(request_text(request))
        yield from in_a_child("nodes.experiment.node.memory", file, horizons)


def main() -> None:
    """Measure horizons of a request."""
    file, *horizons = sys.argv[1:]
    prepared = prepare(load_request(Path(file), folder=Path(file).parent))
    print_peaks(prepared.problem, prepared.space, [int(ticks) for ticks in horizons])


if __name__ == "__main__":
    main()
