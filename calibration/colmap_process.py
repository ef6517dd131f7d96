"""The process that COLMAP runs in: ``python -m calibration.colmap_process PARENT_PID``, started by `calibration.structure_from_motion`.

It reads its job from standard input and writes progress, then the model or an error, to standard output
(`calibration.colmap_messages`). It ends with its parent at any time, which COLMAP's database and our files withstand.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from advnerf_core.errors import AdvnerfError
from calibration.colmap_messages import pack_error, pack_model, pack_progress, unpack_job

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Run one job."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != int(sys.argv[1]):
        return
    root, sources, work, config = unpack_job(sys.stdin.buffer.readline())
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # output of libraries must not mix with the answers

    def say(line: bytes) -> None:
        answers.write(line)
        answers.flush()

    from calibration.colmap_model import put_together

    try:
        model = put_together(root, sources, work, config, lambda share, text: say(pack_progress(share, text)))
    except (AdvnerfError, OSError) as error:
        say(pack_error(error))
        return
    say(pack_model(model))


if __name__ == "__main__":
    main()
