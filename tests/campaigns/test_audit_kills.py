"""Is anything of an audit lost? Killed at random moments and started again; 50 kills in full."""

from __future__ import annotations

import contextlib
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest

from tests.campaigns.campaign import Campaign
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


@pytest.mark.campaign
def test_a_killed_audit_ends_with_the_result_of_a_whole_one(campaign: Campaign, tmp_path: Path) -> None:
    make_folder(tmp_path)
    whole = audit(tmp_path, "seduced", "--ci", output="whole")
    assert whole.returncode == 1, whole.stdout + whole.stderr
    result = (tmp_path / "whole" / "audit.json").read_bytes()
    wanted, delays_s = campaign.size(2, 50), np.random.default_rng(_SEED)
    kills, same, runs = 0, 0, 0
    while kills < wanted:
        runs += 1
        output = f"killed_{runs}"
        # Until it ends by itself, which it does earlier each time, as what is finished is kept.
        while killed(tmp_path, output, float(delays_s.uniform(0.0, _LATEST_S))):
            kills += 1
            if kills == wanted:
                break
        ended = audit(tmp_path, "seduced", "--ci", output=output)
        same += (
            tmp_path / output / "audit.json"
        ).read_bytes() == result and ended.returncode == whole.returncode
        print(f"{kills} kills, {same} of {runs} audits as the whole one", flush=True)
    campaign.record(
        "audit, killed at random moments and started again: same bytes of the result",
        same,
        f"of {runs}",
        f"{runs} of {runs}",
        same == runs,
        f"{kills} kills; up to {_LATEST_S:g} s after the place was there",
    )
    assert same == runs
