"""What the car's own nodes weigh: ``python -m benchmarks.car_nodes`` (half a minute). Resident memory of each, while it drives."""

from __future__ import annotations

import argparse
from pathlib import Path

from benchmarks.results import record_row
from tests.support.live.graph import live_graph

COMMAND = "python -m benchmarks.car_nodes"
LIMITS_MB = {
    "camera": 80.0,
    "vicon": 80.0,
    "safety": 80.0,
    "motor": 80.0,
    "recorder": 80.0,
    "compositor": 100.0,
}
SETTINGS = ("record=true", "policy.module=tests.support.live.straight_policy")
DRIVE_S = 4.0


def resident_mb(pid: int) -> float:
    """Resident memory of a process, shared libraries included [MB]."""
    rows = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(row.split()[1]) for row in rows if row.startswith("VmRSS:")) * 1024 / 1e6


def maps_torch(pid: int) -> bool:
    """Whether a process has any library of torch in its memory."""
    return "libtorch" in Path(f"/proc/{pid}/maps").read_text()


def measure() -> dict[str, float]:
    """Resident memory of every node after some seconds of driving [MB]."""
    with live_graph(SETTINGS) as graph:
        graph.operator.bus.subscribe("/status/recorder")
        graph.ready()
        graph.put_back()
        graph.operator.arm(20.0)
        graph.operator.watch(DRIVE_S)
        pids = {name: graph.operator.pid_of(name) for name in LIMITS_MB}
        if heavy := [name for name, pid in pids.items() if maps_torch(pid)]:
            raise RuntimeError(f"expected no torch in the car's nodes, found it in {heavy}")
        return {name: resident_mb(pid) for name, pid in pids.items()}


def main() -> None:
    """Print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--trial", action="store_true", help="nothing is recorded")
    options = parser.parse_args()
    sizes = measure()
    text = ", ".join(f"{name} {size:.0f}" for name, size in sizes.items())
    print(text)
    if options.trial:
        return
    heaviest = max(sizes, key=lambda name: sizes[name] / LIMITS_MB[name])
    record_row(
        "car nodes: resident memory, none with torch",
        round(sizes[heaviest], 1),
        "MB",
        "<= 80 MB each, compositor 100",
        all(sizes[name] <= limit for name, limit in LIMITS_MB.items()),
        COMMAND,
        f"nearest to its limit: {heaviest}; {text} MB",
    )


if __name__ == "__main__":
    main()
