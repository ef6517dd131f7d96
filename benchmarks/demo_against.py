"""The demo of this commit against that of another one, in turns: ``python -m benchmarks.demo_against COMMIT`` (20 to 30 minutes).

Both run from clean worktrees with empty run folders and without compiled kernels, as after a clone, and with the packages of this
environment. Each run is kept in ``--out``, so that the benchmark can be stopped between runs: ``--runs 1`` makes only the next one.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from benchmarks.results import REPOSITORY, record_row

COMMAND = "python -m benchmarks.demo_against"
TARGET, PICTURE_LIMIT_S = 0.5, 60.0
_DEMO = re.compile(r"^demo:.*\n(?:\t.*\n)*?\t@?\$\(BIN\)/advnerf (.*)$", re.MULTILINE)
# Lines that the demo ends with: its setting, and what its parts took and gave.
_SAID = ("setting ", "held-out views: ", "total CTE of the victims", "seconds: ")


@contextmanager
def worktree(commit: str) -> Iterator[Path]:
    """A clean worktree of a commit, which goes with the context."""
    with tempfile.TemporaryDirectory(prefix="advnerf-") as above:
        folder = Path(above) / "tree"
        git = ["git", "-C", str(REPOSITORY), "worktree"]
        subprocess.run([*git, "add", "--quiet", "--detach", str(folder), commit], check=True)
        try:
            yield folder
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def demo_command(makefile: str) -> list[str]:
    """The arguments of ``advnerf`` that ``make demo`` of a Makefile ends with."""
    found = _DEMO.search(makefile)
    if found is None:
        raise SystemExit("expected a Makefile whose target demo runs $(BIN)/advnerf, got another one")
    return found[1].split()


def run_demo(commit: str) -> dict[str, Any]:
    """Run the demo of a commit; its core-seconds (user), seconds, seconds to the first picture (0 for none), and last lines."""
    with worktree(commit) as tree, tempfile.TemporaryDirectory() as cache:
        environment = {
            **os.environ,
            "PYTHONPATH": str(tree),
            "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
            "XDG_CACHE_HOME": cache,
        }
        command = [sys.executable, "-m", "nodes.cli", *demo_command((tree / "Makefile").read_text())]
        log = tree / "demo.log"
        before_s, began_s, picture_s = _user_s(), time.monotonic(), 0.0
        with log.open("w") as stream:
            process = subprocess.Popen(
                command, cwd=tree, env=environment, stdin=subprocess.DEVNULL, stdout=stream, stderr=stream
            )
            while process.poll() is None:
                if not picture_s and any((tree / "runs" / "demo").glob("recorded/now.jpg")):
                    picture_s = time.monotonic() - began_s
                time.sleep(0.1)
        wall_s, text = time.monotonic() - began_s, log.read_text()
        print(text)
        if process.returncode != 0:
            raise SystemExit(f"the demo of {commit} ended with {process.returncode} after {wall_s:.0f} s")
        said = [line for line in text.splitlines() if line.startswith(_SAID)]
        return {"user_s": _user_s() - before_s, "wall_s": wall_s, "picture_s": picture_s, "said": said}


def _user_s() -> float:
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime


def record(commit: str, before: list[dict[str, Any]], after: list[dict[str, Any]]) -> None:
    """Write the rows: the best of each by core-seconds, as other load only adds to them."""
    old, new = (min(each, key=lambda run: run["user_s"]) for each in (before, after))
    command, said = f"{COMMAND} {commit}", "; ".join(new["said"])
    for what, key in (("user core-seconds", "user_s"), ("wall", "wall_s")):
        ratio = new[key] / old[key]
        note = f"{new[key]:.0f} s against {old[key]:.0f} s, best of {len(after)} and {len(before)} in turns. {said}"
        line = f"make demo: {what} against {commit}"
        record_row(line, round(ratio, 3), "x", f"<= {TARGET:g}", ratio <= TARGET, command, note)
    picture_s = statistics.median(run["picture_s"] for run in after)
    line, met = "make demo: first true picture after the start", 0.0 < picture_s <= PICTURE_LIMIT_S
    note = "The recorded victim of the reference build, labelled, beside the pipeline."
    record_row(line, round(picture_s, 1), "s", f"<= {PICTURE_LIMIT_S:g} s", met, command, note)


def main() -> None:
    """Make the runs that are missing, in turns, and record them once all are there."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("commit", help="the commit of before")
    parser.add_argument("--turns", type=int, default=1, help="runs of each")
    parser.add_argument("--runs", type=int, default=1000, help="runs to make now")
    parser.add_argument("--out", type=Path, default=Path("runs/demo_against"), help="folder of the runs")
    options = parser.parse_args()
    git = ["git", "-C", str(REPOSITORY), "rev-parse", "--short=8", "HEAD"]
    head = subprocess.run(git, check=True, capture_output=True, text=True).stdout.strip()
    kept: dict[str, list[dict[str, Any]]] = {options.commit: [], head: []}
    left = options.runs
    for turn in range(options.turns):
        for commit, runs in kept.items():
            file = options.out / f"{commit}_{turn}.json"
            if not file.exists():
                if left == 0:
                    return
                left -= 1
                write_json(file, run_demo(commit))
            runs.append(read_json(file))
    record(options.commit, *kept.values())


if __name__ == "__main__":
    main()
