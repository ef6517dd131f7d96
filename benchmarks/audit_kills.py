"""Is anything of an audit lost? Killed at random moments and started again: ``python -m benchmarks.audit_kills [--kills 50]``."""

from __future__ import annotations

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.results import record_row
from tests.support.circle_place import audit, command, environment, make_folder

# An audit begins to write a few seconds after it was started; a kill comes up to so long after that [s].
_LATEST_S = 12.0
_SEED = 38


def killed(folder: Path, output: str, after_s: float) -> bool:
    """Start the audit in its folder and kill it; False if it had ended by then."""
    with contextlib.ExitStack() as stack:
        started = stack.enter_context(
            subprocess.Popen(
                command("seduced", "--ci", output=output), cwd=folder, env=environment(folder),
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, stdin=subprocess.DEVNULL, text=True,
            )
        )  # fmt: skip
        assert started.stdout is not None
        started.stdout.readline()  # of the learned place, once it is there
        time.sleep(after_s)
        ended = started.poll() is not None
        started.kill()
        return not ended


def main() -> int:
    """Command line; 0 if nothing was lost."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--kills", type=int, default=50)
    wanted = parser.parse_args().kills
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_folder(folder)
        whole = audit(folder, "seduced", "--ci", output="whole")
        assert whole.returncode == 1, whole.stdout + whole.stderr
        result = (folder / "whole" / "audit.json").read_bytes()
        delays_s, kills, same, runs = np.random.default_rng(_SEED), 0, 0, 0
        while kills < wanted:
            runs += 1
            output = f"killed_{runs}"
            # Until it ends by itself, which it does earlier each time, as what is finished is kept.
            while killed(folder, output, float(delays_s.uniform(0.0, _LATEST_S))):
                kills += 1
                if kills == wanted:
                    break
            ended = audit(folder, "seduced", "--ci", output=output)
            same += (
                folder / output / "audit.json"
            ).read_bytes() == result and ended.returncode == whole.returncode
            print(f"{kills} kills, {same} of {runs} audits as the whole one", flush=True)
    record_row(
        "audit, killed at random moments and started again: same bytes of the result", same, f"of {runs}", f"{runs} of {runs}", same == runs,
        f"python -m benchmarks.audit_kills --kills {wanted}", f"{kills} kills; up to {_LATEST_S:g} s after the place was there",
    )  # fmt: skip
    return int(same != runs)


if __name__ == "__main__":
    sys.exit(main())
