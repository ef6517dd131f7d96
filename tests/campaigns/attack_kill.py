"""Does a killed attack end as if nothing had happened? About three minutes on two cores in full.

Each round starts the attack in a process of its own, kills it (SIGKILL) at a random moment, starts it again in the same folder
until it ends, and compares the bytes of what it found with those of an attack that was left alone.
"""

from __future__ import annotations

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
from tests.support.attack_toy import toy_problem
from tests.support.live.processes import REPOSITORY

METHODS = ("gradient", "cem", "evolution", "random")
EVALUATIONS = 30
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
    command = [sys.executable, "-m", "tests.campaigns.attack_kill", str(folder), method, str(evaluations)]
    return subprocess.Popen(command, cwd=REPOSITORY)


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


def kill_many(kills: int, evaluations: int = EVALUATIONS, seed: int = 0) -> tuple[int, int]:
    """How many ended with the same bytes, of how many that were hit while at work."""
    moments, same, struck, methods = random.Random(seed), 0, 0, METHODS[:kills]
    with tempfile.TemporaryDirectory() as name:
        wanted, lasted = {}, {}
        for method in methods:
            folder = Path(name) / method
            folder.mkdir()
            process = start(folder, method, evaluations)
            while process.poll() is None and not (folder / STATE).exists():
                time.sleep(0.002)
            began = time.monotonic()
            if process.wait() != 0:
                raise RuntimeError(f"expected the {method} attack to end well; see what it printed above")
            # From the first state to the end, which is where a kill can strike.
            lasted[method] = time.monotonic() - began
            wanted[method] = (folder / RESULT).read_bytes()
        round_number = 0
        while struck < kills and round_number < 3 * kills:
            method = methods[round_number % len(methods)]
            folder = Path(name) / str(round_number)
            folder.mkdir()
            after_s = moments.uniform(0.0, 0.9 * lasted[method])
            got, hit = killed_and_resumed(folder, method, evaluations, after_s)
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
    run_in(Path(sys.argv[1]), sys.argv[2], int(sys.argv[3]))
