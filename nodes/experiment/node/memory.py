"""Peak memory of one gradient of a request, each horizon in a fresh process.

``python -m nodes.experiment.node.memory REQUEST_FILE TICKS CACHE_MIB`` prints the peak above idle [MiB].
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from advnerf_core.run_module import module_command
from nodes.experiment.node.job import REQUEST
from nodes.experiment.node.prepare import load_request, prepare, request_text
from nodes.experiment.show.context import Experiment
from nodes.experiment.steps.memory import gradient_peak_mib


def peak_above_idle_mib(request: Experiment, ticks: int, cache_mib: float) -> float:
    """Measure in this process, which must be fresh."""
    prepared = prepare(request)
    return gradient_peak_mib(prepared.problem, prepared.space, ticks, cache_mib)


def measured_mib(request: Experiment, ticks: int, cache_mib: float = 0.0) -> float:
    """The same in a fresh process."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / REQUEST
        file.write_text(request_text(request))
        command = module_command("nodes.experiment.node.memory", str(file), str(ticks), str(cache_mib))
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return float(done.stdout.split()[-1])


def main() -> None:
    """Measure one horizon."""
    file = Path(sys.argv[1])
    print(peak_above_idle_mib(load_request(file, folder=file.parent), int(sys.argv[2]), float(sys.argv[3])))


if __name__ == "__main__":
    main()
