"""The process of one cell, isolated from other cells. ``python -m nodes.experiment.run.worker`` reads its job from stdin.

It writes the result, or the error, to the run folder; the exit code says which. A killed worker writes neither, and leaves its folder:
the next run of the experiment resumes there.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal, NoReturn, TextIO

from advnerf_core.files import write_atomically
from advnerf_core.plugins import exit_refused, in_one_line, is_signal
from advnerf_core.run_module import module_command
from nodes.experiment.engine.artefact import digests_in
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.cells import Bench, run_cell, search_cell
from nodes.experiment.run.store import LOG, Store
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import VictimUnknownError
from nodes.experiment.steps.keys import cell_settings, settings_hash, stages_needed
from nodes.experiment.steps.run import load_experiment
from nodes.lab.trials.trial_runner import LIVE_LOCK
from nodes.runtime.errors import RuntimeFault
from nodes.runtime.locks import HeldError, hold
from nodes.runtime.machine import machine_name
from nodes.runtime.progress import Report
from nodes.runtime.termination import ends_in_order, wait_or_kill

Phase = Literal["search", "whole"]
_DONE, _FAILED, _ELSEWHERE, _CHANGED = 0, 1, 3, 4
_PROGRESS_PERIOD_S = 5.0
_LOOKED_AT_S = 1.0
# Longer than CarlaScene waits for a server that is gone.
_ENDING_S = 20.0
_THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class ChangedError(RuntimeFault):
    """An input of a cell changed between the plan and the run."""


# No fault of the cell, whose next run may find its inputs as they were: kept as an error it would not be run again.
_OF_INPUTS = (ChangedError, VictimUnknownError)


@dataclass(frozen=True)
class Job:
    """One cell to run; plain data, so that it can go to another machine.

    Attributes:
        folder: The run folder for results; the same folder on every machine.
        settings_hash: Hash of everything that the result depends on, at planning time.
        phase: ``search``: only the part that may run beside others; ``whole``: all of it.
        registration: Digest of the registration that it is run under; empty without one.
        alone: Whether it needs the machine for itself, see `runs_alone`.
        control_m: Total CTE of each live drive of the set's published control [m]; empty without one. Live drives differ from run to run, and
            all cells of a set are compared with one control.
    """

    folder: str
    file: str
    setting: str
    overrides: tuple[str, ...]
    cell: Cell
    settings_hash: str
    threads: int
    phase: Phase = "whole"
    registration: str = ""
    alone: bool = False
    control_m: tuple[float, ...] = ()

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.cell.name

    @classmethod
    def from_json(cls, text: str) -> Job:
        """The job from the `json.dumps` of its values."""
        data = json.loads(text)
        read = {name: tuple(data[name]) for name in ("overrides", "control_m")}
        return cls(**{**data, **read, "cell": Cell(**data["cell"])})


@dataclass(frozen=True)
class Ended:
    """How the process of a cell ended.

    Attributes:
        how: ``done``, ``failed`` (the error is stored), ``elsewhere`` (another process runs it), or ``lost`` (killed, or its inputs
            changed: the next run resumes it).
        seconds: Wall time [s].
    """

    name: str
    how: Literal["done", "failed", "elsewhere", "lost"]
    text: str
    seconds: float


def run_in_process(job: Job) -> Ended:
    """Run a cell in a separate process and wait for it; called in a thread here, or in a worker of a cluster."""
    began = time.monotonic()
    store = Store(Path(job.folder))
    environment = {
        **os.environ,
        "PYTHONUNBUFFERED": "1",
        **dict.fromkeys(_THREAD_VARIABLES, str(job.threads)),
    }
    process = subprocess.Popen(
        module_command("nodes.experiment.run.worker", str(os.getpid())),
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        env=environment,
    )
    try:
        _, errors = process.communicate(json.dumps(asdict(job)).encode())
    except BaseException:
        # Asked to end before it is killed: a cell may have a world to restore, such as a CARLA server's.
        process.terminate()
        wait_or_kill(process, _ENDING_S)
        raise
    code, seconds = process.returncode, time.monotonic() - began
    said = (errors.decode("utf-8", "replace").strip().splitlines() or [""])[-1]
    if code == _DONE:
        return Ended(job.name, "done", _not_driven(job, store), seconds)
    if code == _ELSEWHERE:
        return Ended(job.name, "elsewhere", said, seconds)
    if code == _CHANGED:
        return Ended(job.name, "lost", said, seconds)
    # A process that was asked to end closed its resources, and reports it by the shell's exit code.
    if code < 0 or is_signal(code):
        by = signal.Signals(-code if code < 0 else code - 128)
        return Ended(
            job.name, "lost", f"killed by {by.name}; it goes on when the experiment is run again", seconds
        )
    error = store.error(job.name, job.settings_hash)
    if error:
        return Ended(job.name, "failed", error, seconds)
    # The worker's own error handling was not reached, for example because a library cannot be loaded.
    store.keep_error(job.name, job.settings_hash, said or f"the worker ended with exit code {code}")
    return Ended(job.name, "failed", said, seconds)


def run_here(job: Job, store: Store, experiment: Experiment, bench: Bench, report: Report) -> Ended:
    """Run a cell in this process, which holds the lock of live graphs if it needs it; an error is stored, and other cells continue."""
    began = time.monotonic()
    store.lock_file(job.name).parent.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(store.lock_file(job.name))
    except HeldError as held:
        return Ended(job.name, "elsewhere", f"{job.name} is being run by process {held.owner}", 0.0)
    with lock:
        work = _begin(job, store, experiment)
        try:
            with exit_refused():
                _run(job, store, work, experiment, report, bench)
        except _OF_INPUTS as error:
            return Ended(job.name, "lost", in_one_line(error), time.monotonic() - began)
        except Exception as error:
            text = in_one_line(error)
            store.keep_error(job.name, job.settings_hash, text)
            (work / LOG).write_text(traceback.format_exc(), encoding="utf-8")
            return Ended(job.name, "failed", text, time.monotonic() - began)
    return Ended(job.name, "done", _not_driven(job, store), time.monotonic() - began)


def _begin(job: Job, store: Store, experiment: Experiment) -> Path:
    return store.begin(job.name, job.settings_hash, cell_settings(experiment, job.cell.inside))


def _not_driven(job: Job, store: Store) -> str:
    """Message about a finished cell that was not driven live; empty for any other."""
    result = store.result(job.name) if job.phase == "whole" else None
    return (
        f"not driven live: {result.not_driven_live}" if result is not None and result.not_driven_live else ""
    )


def main() -> None:
    """Run the job on stdin."""
    with ends_in_order():
        _die_with(int(sys.argv[1]))
        _run_job()


def _run_job() -> None:
    job = Job.from_json(sys.stdin.read())
    store = Store(Path(job.folder))
    store.lock_file(job.name).parent.mkdir(parents=True, exist_ok=True)
    with take_cell(store, job.name):
        experiment = _checked(job, store)
        work = _begin(job, store, experiment)
        with open(work / LOG, "a", encoding="utf-8", buffering=1) as log:
            os.dup2(log.fileno(), 1)
            try:
                with exit_refused():
                    _run(job, store, work, experiment, _log_progress())
            except _OF_INPUTS as error:
                _end_changed(error)
            except Exception as error:
                traceback.print_exc(file=log)
                store.keep_error(job.name, job.settings_hash, in_one_line(error))
                raise SystemExit(_FAILED) from None


def take_cell(store: Store, name: str) -> TextIO:
    """Lock a cell for this process. A process that only reads its state holds it for an instant, which is waited for."""
    end_s = time.monotonic() + _LOOKED_AT_S
    while True:
        try:
            return hold(store.lock_file(name))
        except HeldError as held:
            if time.monotonic() > end_s:
                print(f"{name} is being run by process {held.owner}", file=sys.stderr)
                raise SystemExit(_ELSEWHERE) from None
            time.sleep(0.05)


def _checked(job: Job, store: Store) -> Experiment:
    """The current experiment, checked before the cell is touched."""
    try:
        _use_threads(job.threads)
        whole = load_experiment(Path(job.file), job.setting, job.overrides, Path(job.folder))
        experiment = whole.of(job.cell)
        if settings_hash(experiment, job.cell.inside) != job.settings_hash:
            raise ChangedError(
                f"{job.name}: its settings or inputs changed after the experiment was started; run it again"
            )
    except _OF_INPUTS as error:
        _end_changed(error)
    except Exception as error:
        store.keep_error(job.name, job.settings_hash, in_one_line(error))
        raise SystemExit(_FAILED) from None
    return experiment


def _end_changed(error: Exception) -> NoReturn:
    print(in_one_line(error), file=sys.stderr)
    raise SystemExit(_CHANGED) from None


def _run(
    job: Job, store: Store, work: Path, experiment: Experiment, report: Report, bench: Bench | None = None
) -> None:
    began = time.monotonic()
    if job.phase == "search":
        search_cell(experiment, job.cell.inside, work, report, bench)
        _add_seconds(work, time.monotonic() - began)
        return
    found = run_cell(experiment, job.cell.inside, work, report, bench, job.control_m)
    ours = {
        "scenario": job.cell.scenario,
        "victim": job.cell.victim,
        "method": job.cell.method,
        "seed": job.cell.seed,
        "settings_hash": job.settings_hash,
        "settings": dict(cell_settings(experiment, job.cell.inside).resolved),
        "registration": job.registration,
        "stages": digests_in(experiment.folder, stages_needed(experiment.config, job.cell.victim)),
        "machine": found.get("machine") or machine_name(),
        "date": found.get("date") or datetime.now(timezone.utc).isoformat(timespec="seconds"),
    }
    spent_s = _add_seconds(work, time.monotonic() - began)
    store.keep_result(job.name, {**found, **ours, "seconds": round(spent_s, 1)})


def wait_for_live() -> TextIO:
    """The lock of live graphs, once no other process has it."""
    while True:
        try:
            return hold(LIVE_LOCK)
        except HeldError:
            time.sleep(0.5)


def _add_seconds(work: Path, seconds: float) -> float:
    """Computing time of a cell over all runs that stopped properly [s]."""
    file = work / "seconds"
    total = seconds + (float(file.read_text()) if file.exists() else 0.0)
    write_atomically(file, f"{total:.3f}\n")
    return total


def _log_progress() -> Any:
    said_s = [-_PROGRESS_PERIOD_S]

    def report(fraction: float, text: str = "") -> None:
        now_s = time.monotonic()
        if now_s - said_s[0] >= _PROGRESS_PERIOD_S:
            said_s[0] = now_s
            print(f"{100 * fraction:.0f} % {text}", flush=True)

    return report


def _use_threads(threads: int) -> None:
    from advnerf_core.parallel import set_thread_count

    set_thread_count(threads)
    if "torch" in sys.modules:  # importing it takes seconds, and not every kind of cell needs it
        sys.modules["torch"].set_num_threads(threads)


def _die_with(parent: int) -> None:
    """End with the waiting process, on Linux; on other systems an orphan finishes its cell, which is a valid result."""
    if sys.platform == "linux":
        import ctypes

        ctypes.CDLL(None, use_errno=True).prctl(1, signal.SIGTERM)
        if os.getppid() != parent:
            raise SystemExit(_FAILED)


if __name__ == "__main__":
    main()
