"""Start a program that gets a signal when its supervisor ends: ``python -I -S shim.py <supervisor pid> <signal> <program> <arguments...>``.

The script runs by path and without site packages, so that it takes only a few milliseconds. It sets PR_SET_PDEATHSIG, which survives
the exec, and then checks that the supervisor did not end before that.
"""

import ctypes
import os
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Set PR_SET_PDEATHSIG and replace this process with the program."""
    supervisor, number, program = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3:]
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0) != 0:
        sys.exit(f"shim: prctl failed: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != supervisor:
        sys.exit("shim: the supervisor has ended")
    os.execvp(program[0], program)


if __name__ == "__main__":
    main()
