"""What ``make test`` costs in core-seconds, against an earlier commit: ``python -m benchmarks.tests_cost EARLIER`` (40 minutes).

EARLIER is the folder of a worktree of that commit, for example of ``git worktree add ../earlier af4e442``. Each tree has the
environment that its own ``make setup`` makes. Byte code is written and kernels are compiled before anything is counted.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
from pathlib import Path

from benchmarks.results import REPOSITORY, record_row

_TARGET = 0.6
_COMPILING = "tests/nodes/experiment/test_versions.py"


def environment(tree: Path) -> dict[str, str]:
    """Environment in which processes import the code of one tree and keep their byte code."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**kept, "PYTHONPATH": str(tree), "MUJOCO_GL": "egl"}


def warm(tree: Path) -> None:
    """Install what the tests need, write byte code and compile kernels."""
    subprocess.run(["make", "setup"], cwd=tree, env=environment(tree), check=True)
    for arguments in (["--collect-only", "-qq"], ["-q", _COMPILING]):
        command = [str(tree / ".venv" / "bin" / "python"), "-m", "pytest", *arguments]
        subprocess.run(command, cwd=tree, env=environment(tree), stdout=subprocess.DEVNULL)


def user_core_s(tree: Path) -> tuple[float, bool]:
    """User core-seconds of the default tests of a tree and of all processes below them, and whether they are green."""
    before_s = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    code = subprocess.run(["make", "test"], cwd=tree, env=environment(tree)).returncode
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before_s, code == 0


def main() -> None:
    """Run both in turns and record the ratio of their cheapest runs."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("earlier", type=Path, help="worktree of the earlier commit")
    parser.add_argument("--turns", type=int, default=1, help="runs of each; the cheapest counts")
    parser.add_argument("--trial", action="store_true", help="record nothing")
    options = parser.parse_args()
    trees = (options.earlier.resolve(), REPOSITORY)
    commit = subprocess.check_output(
        ["git", "rev-parse", "--short=7", "HEAD"], cwd=trees[0], text=True
    ).strip()
    for tree in trees:
        warm(tree)
    runs = [[user_core_s(tree) for tree in trees] for _ in range(options.turns)]
    earlier_s, now_s = (min(seconds for seconds, _ in of_tree) for of_tree in zip(*runs, strict=True))
    red = sum(not green for turn in runs for _, green in turn)
    print(f"{now_s:.0f} against {earlier_s:.0f} user core-seconds; {red} runs were red")
    if not options.trial:
        record_row(
            f"make test, user core-seconds against {commit}, in turns",
            now_s / earlier_s,
            "of it",
            f"<= {_TARGET}",
            now_s <= _TARGET * earlier_s,
            f"python -m benchmarks.tests_cost EARLIER --turns {options.turns}",
            f"{now_s:.0f} against {earlier_s:.0f} s; EARLIER is a worktree of {commit}, which has fewer tests"
            + f"; {red} of {2 * options.turns} runs were red" * bool(red),
        )


if __name__ == "__main__":
    main()
