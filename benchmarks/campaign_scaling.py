"""Question: how many attacks an hour does an experiment run here, with one worker and with two?

The cells are real: gradient attacks on the finished room of ``make experiment``, each in a process of its own, shortened to a few
iterations so that what a cell costs besides (starting Python, loading scene and policy) shows rather than hides.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import time
from pathlib import Path
from statistics import median

from benchmarks.results import record_row
from nodes.experiment.run.run import Options, run_cells
from nodes.experiment.steps.run import load_experiment

COMMAND = "python -m benchmarks.campaign_scaling runs/full"
_FILE = """name: scaling
base: {experiment}
setting: full
gate: {{}}
attack: {{starts: 1, evaluations: {iterations}}}
deploy: {{through: nothing}}
over:
  variant: {{green_screen: {{run_folder: {folder}}}}}
  victim: [hardened]
  method: [gradient]
  seed: [{seeds}]
"""


def measure(
    folder: Path, work: Path, jobs: int, threads: int, cells: int, iterations: int
) -> tuple[float, float]:
    """Wall time and processor time of an experiment of its own [s]; the second is what it costs also where others share the cores."""
    # The gate's verdict stays: it is judged once, before anything is timed.
    shutil.rmtree(work / "cells", ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    file = work / "scaling.experiment.yaml"
    experiment = Path("launch/room.experiment.yaml").resolve()
    seeds = ", ".join(str(100 + seed) for seed in range(cells))
    file.write_text(
        _FILE.format(seeds=seeds, experiment=experiment, folder=folder.resolve(), iterations=iterations)
    )
    loaded = load_experiment(file, None, [], work)
    began, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    ended = run_cells(loaded, loaded.cells, Options(jobs, threads, gate=False), print)
    seconds = time.monotonic() - began
    wrong = [end for end in ended if end.how != "done"]
    if wrong or len(ended) != cells:
        raise SystemExit(f"expected {cells} finished cells, got {wrong or len(ended)}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    """Measure one and two workers, and write the rows."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("--cells", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=3, help="runs of each way, in turns; medians count")
    parser.add_argument("--work", type=Path, default=Path("runs/scaling"))
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    load_before = os.getloadavg()[0]
    shutil.rmtree(arguments.work, ignore_errors=True)
    measure(
        arguments.run_folder, arguments.work, 1, 1, 1, 1
    )  # imports, the compiled kernels, the gate: not what is asked
    runs: dict[tuple[int, int], list[tuple[float, float]]] = {(1, 1): [], (1, 2): [], (2, 1): []}
    for _ in range(arguments.repeats):  # in turns, so that other load on the machine hits all
        for (jobs, threads), taken in runs.items():
            taken.append(
                measure(
                    arguments.run_folder, arguments.work, jobs, threads, arguments.cells, arguments.iterations
                )
            )
    measured = {
        key: (median(wall for wall, _ in taken), median(cpu for _, cpu in taken))
        for key, taken in runs.items()
    }
    for (jobs, threads), (wall_s, cpu_s) in measured.items():
        rate = 3600 * arguments.cells / wall_s
        print(
            f"{jobs} workers x {threads} threads: {wall_s:.1f} s, {rate:.0f} cells an hour, {cpu_s:.1f} s of processor time"
        )
    seconds = {key: wall_s for key, (wall_s, _) in measured.items()}
    gain = seconds[1, 1] / seconds[2, 1]
    note = (
        f"{arguments.cells} gradient attacks of {arguments.iterations} iterations on one start, one thread each: {seconds[1, 1]:.0f} s with 1 "
        f"worker, {seconds[2, 1]:.0f} s with 2; 1 worker with 2 threads {seconds[1, 2]:.0f} s; medians of {arguments.repeats} in turns; {measured[1, 1][1] / arguments.cells:.1f} s of a core per cell; load before {load_before:.1f}"
    )
    print(f"gain {gain:.2f}; {note}")
    if not arguments.dry:
        record_row("campaign, 2 workers against 1", gain, "x", ">= 1.7 x", gain >= 1.7, COMMAND, note)


if __name__ == "__main__":
    main()
