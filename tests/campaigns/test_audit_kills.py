"""Is anything of an audit lost? Killed at random moments and started again; 50 kills in full.

What is started again is a fork of a process that has imported the program, so that a kill costs the audit's own work and not seconds of imports.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import sys
import time
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import numpy as np
import pytest

from tests.campaigns.campaign import Campaign
from tests.support.circle_place import audit, command, make_folder

# The smallest schedule, judged from the fewest starts.
_OPTIONS = ("--ci", "--evaluations", "1", "--starts", "5", "--set", "horizon=20")
_SEED, _FROM_NOTHING = 38, 5  # every fifth audit learns its place itself
_FORKS = multiprocessing.get_context("forkserver")
_FORKS.set_forkserver_preload(["nodes.cli.main", "nodes.audit.run", "nodes.audit.policies", "numba", "torch"])


def run(folder: Path, output: str) -> None:
    """The command, in the process of its own that this is called in."""
    from nodes.cli.main import main

    os.chdir(folder)
    sys.path.append(str(folder))
    sys.argv = ["advnerf", *command("seduced", *_OPTIONS, output=output)[3:]]
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    main()


def started(folder: Path, output: str) -> ForkServerProcess:
    """The audit, running."""
    process = _FORKS.Process(target=run, args=(folder, output))
    process.start()
    return process


def ended(folder: Path, output: str) -> tuple[int | None, float]:
    """Exit code of the audit, and how long it took [s]."""
    began_s = time.monotonic()
    process = started(folder, output)
    process.join()
    return process.exitcode, time.monotonic() - began_s


def with_place(folder: Path, output: str) -> None:
    """Give an audit the place that the whole one has learned."""
    for half in ("half", "other-half"):
        shutil.copytree(folder / "whole" / half, folder / output / half)


@pytest.mark.campaign
def test_a_killed_audit_ends_with_the_result_of_a_whole_one(campaign: Campaign, tmp_path: Path) -> None:
    make_folder(tmp_path)
    whole = audit(tmp_path, "seduced", *_OPTIONS, output="whole")
    assert whole.returncode == 1, whole.stdout + whole.stderr
    result = (tmp_path / "whole" / "audit.json").read_bytes()
    with_place(tmp_path, "again")
    code, lasts_s = ended(tmp_path, "again")
    assert (code, (tmp_path / "again" / "audit.json").read_bytes()) == (1, result)
    wanted, delays_s = campaign.size(2, 50), np.random.default_rng(_SEED)
    kills, same, runs = 0, 0, 0
    while kills < wanted:
        runs += 1
        output, code = f"killed_{runs}", None
        if runs % _FROM_NOTHING:
            with_place(tmp_path, output)
        while code is None and kills < wanted:  # each time it ends earlier, as what is finished is kept
            process = started(tmp_path, output)
            process.join(float(delays_s.uniform(0.0, lasts_s)))
            code = process.exitcode
            if code is None:
                process.kill()
                process.join()
                kills += 1
        if code is None:
            code, _ = ended(tmp_path, output)
        same += (tmp_path / output / "audit.json").read_bytes() == result and code == 1
        print(f"{kills} kills, {same} of {runs} audits as the whole one", flush=True)
    campaign.record(
        "audit, killed at random moments and started again: same bytes of the result",
        same,
        f"of {runs}",
        f"{runs} of {runs}",
        same == runs,
        f"{kills} kills, up to {lasts_s:.0f} s after the start, which is how long one lasts; every fifth audit learns its place itself",
    )
    assert same == runs
