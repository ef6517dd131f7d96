"""Start a program that dies with its supervisor: ``python -I -S shim.py <supervisor pid> <program> <arguments...>``.

Run by path and without site packages, so that it costs a few milliseconds. It sets PR_SET_PDEATHSIG, which survives the
exec, and checks afterwards that the supervisor did not die before it was set.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Bind this process to its parent's life and become the program."""
    supervisor, program = int(sys.argv[1]), sys.argv[2:]
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0) != 0:
        sys.exit(f"shim: prctl failed: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != supervisor:
        sys.exit("shim: the supervisor is gone")
    os.execvp(program[0], program)


if __name__ == "__main__":
    main()
