from collections.abc import Callable
from pathlib import Path

from nodes.runtime.arm_requests import ArmAnswer
from nodes.runtime.stopping import StopRequest


def ask_to_disarm(run_dir: Path, reason: str, silent: Callable[[float], None]) -> ArmAnswer:
    """Ask the safety node to disarm, as the operator, until it answers; ``silent`` gets the waiting time [s] while it does not."""
    request = StopRequest(run_dir, reason)
    try:
        while (report := request.report()).answer is None:
            if request.late():
                silent(report.waited_s)
            request.step(0.02)
        return report.answer
    finally:
        request.close()
