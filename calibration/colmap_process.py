"""The process that COLMAP runs in: ``python -m calibration.colmap_process PARENT_PID``, started by `calibration.structure_from_motion`.

It reads its job from standard input and writes progress, then the model or an error, to standard output, all pickled by and for the
same program. It ends with its parent, whatever it is doing: COLMAP's database and our files stand that.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys
from typing import Any

from advnerf_core.errors import AdvnerfError

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Do one job."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(sys.argv[1]):
        return
    root, sources, work, config = pickle.load(sys.stdin.buffer)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print must not get between the answers

    def say(kind: str, value: Any) -> None:
        pickle.dump((kind, value), answers)
        answers.flush()

    from calibration.colmap_model import put_together

    try:
        say("model", put_together(root, sources, work, config, lambda share, text: say("progress", (share, text))))
    except (AdvnerfError, OSError) as error:
        say("error", error)


if __name__ == "__main__":
    main()
