"""Does a killed attack end as if nothing had happened? ``python -m benchmarks.attack_kill`` (about three minutes on two cores).

Each round starts the attack in a process of its own, kills it (SIGKILL) at a random moment, starts it again in the same folder
until it ends, and compares the bytes of what it found with those of an attack that was left alone.
"""

from __future__ import annotations

import argparse
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from safetensors.torch import save

from advnerf_core.attack.methods import SearchRun, SearchSettings, load_method
from advnerf_core.files import write_atomically
from benchmarks.attack_toy import toy_problem
from benchmarks.results import REPOSITORY, record_row

COMMAND = "python -m benchmarks.attack_kill"
METHODS = ("gradient", "cem", "evolution", "random")
STATE, RESULT = "state.safetensors", "result.safetensors"


def run_in(folder: Path, method: str, evaluations: int) -> None:
    """The whole attack, or the rest of it; ends in a file of what was found and of every loss."""
    torch.set_num_threads(1)
    problem, state = toy_problem(6, resolution=16, dtype=torch.float32), folder / STATE
    settings = SearchSettings(evaluations, population=4)
    result = load_method(method).search(problem, settings, SearchRun(seed=3, state_path=state))
    losses = torch.tensor([evaluation.loss_m for evaluation in result.history], dtype=torch.float64)
    write_atomically(folder / RESULT, save({"theta": result.theta, "losses": losses}))


def start(folder: Path, method: str, evaluations: int) -> subprocess.Popen[bytes]:
    """The attack in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.attack_kill", "--child", str(folder), "--methods", method]
    return subprocess.Popen([*command, "--evaluations", str(evaluations)], cwd=REPOSITORY)


def finished(folder: Path, method: str, evaluations: int) -> bytes:
    """Run to the end; the bytes of its result."""
    if start(folder, method, evaluations).wait() != 0:
        raise RuntimeError(f"expected the attack in {folder} to end well; see what it printed above")
    return (folder / RESULT).read_bytes()


def killed_and_resumed(folder: Path, method: str, evaluations: int, after_s: float) -> tuple[bytes, bool]:
    """Kill at a moment, then run to the end; also whether the attack was really at work when it was killed."""
    process = start(folder, method, evaluations)
    while process.poll() is None and not (folder / STATE).exists():
        time.sleep(0.002)
    time.sleep(after_s)
    process.send_signal(signal.SIGKILL)
    struck = process.wait() == -signal.SIGKILL
    return finished(folder, method, evaluations), struck


def main() -> None:
    """Kill, resume, compare, print and record."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--kills", type=int, default=20, help="kills that hit an attack at work")
    parser.add_argument("--evaluations", type=int, default=30)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS), help="taken in turns")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    parser.add_argument("--trial", action="store_true", help="print, but record nothing")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        run_in(arguments.child, arguments.methods[0], arguments.evaluations)
        return
    same, struck = kill_many(arguments)
    print(f"{same} of {struck} killed attacks ended with the bytes of an undisturbed one")
    if not arguments.trial:
        note = f"{', '.join(arguments.methods)} in turns, SIGKILL at random moments of {arguments.evaluations} evaluations"
        record_row(
            "kill -9 at a random moment: attack",
            f"{same}/{struck}",
            "same bytes",
            "20/20",
            same == struck >= 20,
            COMMAND,
            note,
        )


def kill_many(arguments: argparse.Namespace) -> tuple[int, int]:
    """How many ended with the same bytes, of how many that were hit while at work."""
    moments, same, struck = random.Random(arguments.seed), 0, 0
    with tempfile.TemporaryDirectory() as name:
        wanted, lasted = {}, {}
        for method in arguments.methods:
            folder = Path(name) / method
            folder.mkdir()
            process = start(folder, method, arguments.evaluations)
            while process.poll() is None and not (folder / STATE).exists():
                time.sleep(0.002)
            began = time.monotonic()
            if process.wait() != 0:
                raise RuntimeError(f"expected the {method} attack to end well; see what it printed above")
            # From the first state to the end, which is where a kill can strike.
            lasted[method] = time.monotonic() - began
            wanted[method] = (folder / RESULT).read_bytes()
        round_number = 0
        while struck < arguments.kills and round_number < 3 * arguments.kills:
            method = arguments.methods[round_number % len(arguments.methods)]
            folder = Path(name) / str(round_number)
            folder.mkdir()
            after_s = moments.uniform(0.0, 0.9 * lasted[method])
            got, hit = killed_and_resumed(folder, method, arguments.evaluations, after_s)
            round_number += 1
            struck += hit
            same += hit and got == wanted[method]
            print(
                f"{method} killed after {after_s:.2f} s{'' if hit else ' (had ended)'}: "
                f"{'same' if got == wanted[method] else 'OTHER'} bytes",
                flush=True,
            )
    return same, struck


if __name__ == "__main__":
    main()
