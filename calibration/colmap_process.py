"""The process that COLMAP runs in: ``python -m calibration.colmap_process PARENT_PID``, started by `calibration.structure_from_motion`.

It reads its job from standard input and writes progress, then the model or an error, to standard output, all of them pickled. It ends with its parent at any time, which COLMAP's database and our files withstand.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import signal
import sys

from advnerf_core.errors import AdvnerfError
from calibration.photo_model import ReconstructionError

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run one job."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(sys.argv[1]):
        return
    root, sources, work, config = pickle.load(sys.stdin.buffer)
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries must not mix with the answers

    def say(answer: object) -> None:
        pickle.dump(answer, answers)
        answers.flush()

    from calibration.colmap_model import put_together

    try:
        answer: object = put_together(root, sources, work, config, lambda share, text: say((share, text)))
    except (AdvnerfError, OSError) as error:
        # Others have arguments of their own, with which they could not be made again.
        kind = ReconstructionError if isinstance(error, ReconstructionError) else AdvnerfError
        answer = kind(str(error))
    say(answer)


if __name__ == "__main__":
    main()
