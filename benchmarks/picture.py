"""The README's picture from a finished run: ``python -m benchmarks.picture runs/demo docs/demo.png``."""

from __future__ import annotations

import argparse
from pathlib import Path

from advnerf_core.report.maps import trajectory_map
from advnerf_core.report.plots import write_png
from advnerf_core.report.results import read_results


def main() -> None:
    """Draw the trajectories of a run from above."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("run_folder", type=Path)
    parser.add_argument("picture", type=Path)
    arguments = parser.parse_args()
    data = read_results(arguments.run_folder / "report" / "results.json")
    write_png(trajectory_map(data, zoom=True), arguments.picture, dpi=110)
    print(f"wrote {arguments.picture}")


if __name__ == "__main__":
    main()
