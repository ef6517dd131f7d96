"""Which rows of the ledger can be computed again from what is kept with the code, by the command that wrote them.

`benchmarks.kept_rows` computes them. All other rows were measured once, and what they were measured from is not kept.
"""

from __future__ import annotations

import re

from advnerf_core.report.evidence.registration import launch_file

# Name of what computes the rows again, and the commands; groups are its arguments.
KEPT_COMMANDS: dict[str, re.Pattern[str]] = {
    "retraining": re.compile(
        r"advnerf experiment run launch/junction\.experiment\.yaml --setting retrain --folder \S+"
    ),
    "gap": re.compile(r"python -m benchmarks\.gap ([\w ]+)"),
    "predictions": re.compile(r"python -m benchmarks\.predictions"),
    "paper": re.compile(r"python -m benchmarks\.paper_table"),
    "correlation": re.compile(r"python -m benchmarks\.transfer_correlation"),
    "panel": re.compile(r"python -m benchmarks\.victim_panel"),
}
NOT_KEPT = "Measured once, not kept."


def kept_by(command: str) -> tuple[str, tuple[str, ...]] | None:
    """What computes the rows of a command again, with its arguments; None where what they were measured from is not kept."""
    for name, pattern in KEPT_COMMANDS.items():
        if found := pattern.fullmatch(launch_file(command)):
            return name, tuple(each or "" for each in found.groups())
    return None
