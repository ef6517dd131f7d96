"""Real processes: what is finished stays, what changed runs again, what is killed is lost alone."""

import contextlib
import json
import os
import signal
import threading
import time

import pytest

from nodes.experiment.run.maps import map_cells
from nodes.experiment.run.plan import statuses
from nodes.experiment.run.run import Options, _shares, run_cells
from nodes.experiment.run.store import Store
from nodes.experiment.run.worker import take_cell
from nodes.runtime.errors import ConfigError
from nodes.runtime.locks import hold
from tests.support.waiting import wait_for


def run(bench, jobs=2, **options):
    loaded = bench.load()
    said = []
    return run_cells(loaded, loaded.cells, Options(jobs=jobs, **options), said.append), said


def states(bench):
    loaded = bench.load()
    return {each.cell.name: each.state for each in statuses(loaded, loaded.cells)}


def test_cells_run_once_and_only_what_changed_again(here):
    ended, _ = run(here)
    assert {end.how for end in ended} == {"done"}
    assert len(ended) == 3
    threads = max(1, len(os.sched_getaffinity(0)) // 2)  # of two jobs at a time
    assert all(line.endswith(f" {threads}") for line in here.calls if line.startswith("begin"))
    assert set(states(here).values()) == {"done"}
    before = {path.name: path.stat().st_mtime_ns for path in here.cells.glob("*.json")}

    ended, said = run(here)
    assert ended == []
    assert "nothing to do" in said[-1]

    here.write(seed=[0, 1, 2], method=["none", "gradient"])
    ended, _ = run(here, here=True)
    assert [end.name for end in ended] == ["straight_hardened_gradient_2"]
    assert all(here.cells.joinpath(name).stat().st_mtime_ns == stamp for name, stamp in before.items())

    began = time.monotonic()
    here.describe(none_m=5.0)
    assert set(states(here).values()) == {"changed"}
    ended, _ = run(here, here=True)
    assert len(ended) == 4
    result = json.loads((here.cells / "straight_hardened_gradient_1.json").read_text())
    assert result["surrogate"]["total_cte_m"] == [18.0]
    assert result["scenario"] == "straight"
    assert result["seconds"] <= time.monotonic() - began


def test_a_cell_that_was_not_driven_live_ends_well_and_is_tried_again_only_on_request(here):
    (here.folder / "late").touch()
    ended, said = run(here)
    assert {end.how for end in ended} == {"done"}
    assert sum("not driven live: live0 was spoiled 3 times" in text for text in said) == 2
    assert states(here) == {
        "straight_hardened_none_0": "done",
        "straight_hardened_gradient_0": "not driven live",
        "straight_hardened_gradient_1": "not driven live",
    }
    ended, said = run(here)
    assert ended == []
    assert sum("not tried again without --retry" in text for text in said) == 2
    (here.folder / "late").unlink()
    ended, _ = run(here, retry=True, here=True)
    assert sorted(end.name for end in ended) == [f"straight_hardened_gradient_{seed}" for seed in (0, 1)]
    assert set(states(here).values()) == {"done"}


def test_a_killed_worker_loses_its_cell_and_no_other(here):
    process, worker = start_hanging(here, jobs=2)
    os.kill(worker, signal.SIGKILL)
    pid_of(here, "straight_hardened_gradient_1")
    assert states(here)["straight_hardened_gradient_1"] == "running"
    (here.folder / "hang").unlink()
    out, err = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "killed by SIGKILL" in err
    assert "straight_hardened_gradient_0: lost" in out
    found = states(here)
    assert found.pop("straight_hardened_gradient_0") == "begun"
    assert set(found.values()) == {"done"}
    (here.cells / "straight_hardened_gradient_0" / "work").write_text("half of it")
    ended, _ = run(here, here=True)
    assert [(end.name, end.how) for end in ended] == [("straight_hardened_gradient_0", "done")]
    assert (here.cells / "straight_hardened_gradient_0" / "work").exists()  # it went on in its own folder


@pytest.mark.slow
def test_a_killed_run_takes_its_workers_along_and_goes_on(here):
    process, worker = start_hanging(here)
    process.kill()
    process.communicate()
    wait_for(lambda: not is_alive(worker), "the worker to end")
    done = set(here.cells.glob("*.json"))
    (here.folder / "hang").unlink()
    ended, _ = run(here)
    assert len(ended) == 3 - len(done)
    assert set(states(here).values()) == {"done"}


@pytest.mark.slow
def test_failed_cells_say_why_and_are_retried_when_asked(here):
    here.write(seed=[0, 1], method=["none", "cem"])
    (here.folder / "fail").touch()
    code, out, err = here.call("experiment", "run", str(here.file), "--jobs", "2")
    assert code == 1
    assert "straight_hardened_cem_0: RuntimeError: the search came to nothing" in err
    code, out, _ = here.call("experiment", "status", str(here.file))
    assert code == 0
    assert "the search came to nothing" in out
    assert "2 failed, 1 done of 3 cells" in out
    (here.folder / "fail").unlink()
    ended, said = run(here)
    assert ended == []
    assert any("--retry" in line for line in said)
    ended, _ = run(here, retry=True)
    assert sorted(end.name for end in ended) == ["straight_hardened_cem_0", "straight_hardened_cem_1"]
    assert set(states(here).values()) == {"done"}


@pytest.mark.slow
def test_live_cells_run_alone_after_all_others(here):
    here.write(
        seed=[0, 1],
        method=["none", "cem"],
        variants={"live": {"run_folder": str(here.folder / "run"), "world.alone": 1}},
    )
    ended, _ = run(here)
    assert {end.how for end in ended} == {"done"}
    searched = [index for index, line in enumerate(here.calls) if line.startswith("search live_")]
    first = next(index for index, line in enumerate(here.calls) if line.startswith("begin live_"))
    assert len(searched) == 3
    assert max(searched) < first  # searches run beside others
    assert not any("straight_" in line for line in here.calls[first:])
    # One after the other: whatever begins ends before the next begins.
    lines = [line.split()[:2] for line in here.calls[first:]]
    assert [kind for kind, _ in lines] == ["begin", "end"] * 3
    assert all(lines[k][1] == lines[k + 1][1] for k in range(0, 6, 2))


@pytest.fixture
def cluster(here):
    """A Ray cluster of two machines with one core each, on this one."""
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    made = Cluster()
    try:
        for _ in range(2):
            made.add_node(num_cpus=1)
        made.wait_for_nodes()
        yield made
    finally:
        made.shutdown()


@pytest.mark.slow
def test_a_ray_cluster_of_several_workers_runs_the_cells(here, cluster):
    code, out, err = here.call("experiment", "run", str(here.file), "--cluster", cluster.address)
    assert code == 0, err
    assert "Ray cluster with 2 cores" in out
    assert set(states(here).values()) == {"done"}
    assert len(here.begun()) == 3
    code, out, _ = here.call("experiment", "run", str(here.file), "--cluster", cluster.address)
    assert "nothing to do" in out


@pytest.mark.slow
def test_a_lost_machine_costs_only_its_cells(here, cluster):
    (here.folder / "hang").touch()
    process = here.start("experiment", "run", str(here.file), "--cluster", cluster.address)
    workers = [pid_of(here, f"straight_hardened_gradient_{seed}") for seed in (0, 1)]  # one on each machine
    cluster.remove_node(cluster.list_all_nodes()[-1], allow_graceful=False)
    wait_for(lambda: not all(map(is_alive, workers)), "the cells of the lost machine to end")
    (here.folder / "hang").unlink()
    out, err = process.communicate(timeout=600)
    assert process.returncode == 0, err
    lines = out.splitlines()
    again = lines.index("a machine of the cluster was lost: 1 cells are handed out again")
    # The other ends are reported before: each when it came.
    assert sum("done after" in line for line in lines[:again]) == 2
    assert sum("done after" in line for line in lines[again:]) == 1
    assert set(states(here).values()) == {"done"}
    assert len(here.begun()) == 3 + 1


@pytest.mark.slow
def test_no_cluster_is_one_clear_error(here):
    code, _, err = here.call("experiment", "run", str(here.file), "--cluster", "127.0.0.1:1")
    assert code == 2
    assert "expected a Ray cluster at 127.0.0.1:1" in err
    assert "ray start --head" in err
    assert here.calls == []


def start_hanging(bench, jobs=1):
    """The process of the command, and the pid of the worker that hangs in the gradient cell of seed 0."""
    (bench.folder / "hang").touch()
    process = bench.start("experiment", "run", str(bench.file), "--jobs", str(jobs))
    return process, pid_of(bench, "straight_hardened_gradient_0")


def pid_of(bench, name):
    file = bench.cells / name / "pid"
    wait_for(lambda: file.exists() and file.read_text(), f"something in {file}")
    return int(file.read_text())


def is_alive(pid):
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 0)
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rsplit(")", 1)[1].split()[0] != "Z"
    return False


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_worker_that_is_asked_to_end_has_not_failed(here, number):
    """As by a daemon that frees memory, or a closed terminal: it goes on when the experiment is run again, without being asked to try again."""
    here.write(seed=[0], method=["gradient"])
    process, worker = start_hanging(here)
    os.kill(worker, number)
    out, err = process.communicate(timeout=600)
    assert process.returncode == 1
    assert "straight_hardened_gradient_0: lost" in out
    assert f"killed by {number.name}" in err
    assert states(here) == {"straight_hardened_gradient_0": "begun"}


def test_a_cell_that_fails_anew_is_failed_whatever_it_found_before(here):
    here.write(seed=[0], method=["cem"])
    assert [end.how for end in run(here, here=True)[0]] == ["done"]
    here.describe(none_m=5.0)
    (here.folder / "fail").touch()
    assert [end.how for end in run(here)[0]] == ["failed"]
    assert states(here) == {"straight_hardened_cem_0": "failed"}
    assert run(here)[0] == []
    here.describe(none_m=2.0)
    assert states(here) == {"straight_hardened_cem_0": "done"}


def test_a_cluster_is_filled_unless_it_is_said_how_many():
    """How many cores it has only the cluster knows; here they are counted at once."""
    assert _shares(Options(backend="ray")) == (0, 1)
    assert _shares(Options(backend="ray", jobs=3, threads=2)) == (3, 2)
    cores = len(os.sched_getaffinity(0))
    assert _shares(Options()) == (cores, 1)
    assert _shares(Options(jobs=1)) == (1, cores)


def test_a_worker_that_is_asked_to_end_closes_what_is_open(here):
    """As a CARLA world must be put back: the cell's ``finally`` is run."""
    here.write(seed=[0], method=["gradient"])
    process, worker = start_hanging(here)
    process.terminate()  # its worker is told by the kernel
    process.communicate(timeout=600)
    wait_for(lambda: not is_alive(worker), "the worker to end")
    assert any(line.startswith("closed straight_hardened_gradient_0") for line in here.calls)


def test_who_only_looks_at_a_cell_does_not_keep_its_worker_away(tmp_path, capsys):
    store = Store(tmp_path)
    lock = store.lock_file("straight_hardened_none_0")
    lock.parent.mkdir(parents=True)
    looking = hold(lock)
    threading.Timer(0.3, looking.close).start()
    take_cell(store, "straight_hardened_none_0").close()
    working = hold(lock)
    with working, pytest.raises(SystemExit):
        take_cell(store, "straight_hardened_none_0")
    assert f"is being run by process {os.getpid()}" in capsys.readouterr().err


def test_maps_of_cells_without_places_are_refused_before_anything_begins(here, capfd):
    run(here)
    loaded = here.load()
    with pytest.raises(
        ConfigError, match=r"expected finished cells that have placed objects .*, got none of 3"
    ):
        map_cells(loaded, loaded.cells)
    assert "started" not in "".join(capfd.readouterr())
