"""The experiment page over HTTP, from its own process: what it shows, what it refuses, and that the experiment does not notice it."""

import json
import os
import shutil
import signal
import socket
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.attack.artifact import load_attack
from nodes.experiment.engine.progress_record import ProgressRecord, read_progress
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run import whole
from nodes.experiment_page.page import ExperimentPage, run_with_page
from nodes.experiment_page.state import read_state
from nodes.experiment_page.time_left import all_left_s
from nodes.lab.recorded_victim import LABEL
from nodes.runtime.errors import BusError
from tests.support.experiment_page import ABOUT, CELLS, record_of, search_so_far, state_of
from tests.support.live.page_client import request
from tests.support.stage_versions import tiny_experiment

OTHER_PATHS = [
    "/../secret.png",
    "/report/../../secret.png",
    "/%2e%2e/secret.png",
    "/report/%2e%2e/%2e%2e/secret.png",
    "//etc/passwd",
    "/etc/passwd",
    "/policy/link.png",
    "/policy/policy.safetensors",
    "/progress.json",
    "/manifest.json",
    "/cells/../../secret.png",
    "/cells/track_hardened_random_0/attack.safetensors",
    "/texture/..%2f..%2fsecret.png",
    "/texture/nobody.png",
    "/web/../server.py",
    "/web/%2e%2e%2fserver.py",
    "/policy/a.png%00.png",
    "/policy",
    "/policy/",
]
CLEAN, RANDOM, GRADIENT = (cell.name for cell in CELLS)


def port_of(page):
    return int(page.url.rstrip("/").rpartition(":")[2])


@pytest.fixture
def served(tmp_path):
    """A run folder, its record, and the port of its page."""
    folder = tmp_path / "run"
    record = record_of(folder)
    with ExperimentPage(folder, 0) as page:
        yield folder, record, port_of(page)


@pytest.fixture(scope="module")
def at_rest(tmp_path_factory):
    """The port of a page whose run folder stays as it is: a picture, and secrets beside it."""
    folder = tmp_path_factory.mktemp("at_rest") / "run"
    record_of(folder)
    (folder.parent / "secret.png").write_bytes(b"secret")
    (folder / "policy").mkdir()
    (folder / "policy" / "a.png").write_bytes(b"a picture")
    (folder / "policy" / "policy.safetensors").write_bytes(b"secret")
    (folder / "policy" / "link.png").symlink_to(folder.parent / "secret.png")
    with ExperimentPage(folder, 0) as page:
        yield port_of(page)


def test_the_state_follows_the_experiment(served):
    folder, record, port = served
    record.finish("capture", 3.0, cached=False)
    record.start("scene")(0.4, "step 40")
    state = state_of(port)
    assert [part["name"] for part in state["parts"]] == [
        "capture",
        "scene",
        CLEAN,
        RANDOM,
        GRADIENT,
        "report",
    ]
    assert [part["state"] for part in state["parts"]] == ["done", "running", *["waiting"] * 4]
    assert (state["phase"], state["left_known"], state["report"]) == ("running", False, False)
    record.finish("scene", 9.0, cached=False)
    record.start(RANDOM)
    search_so_far(folder / "cells" / RANDOM, [1.0, 3.0, 2.0])
    (search,) = state_of(port)["searches"]
    assert (search["values"], search["best"], search["planned"]) == ([1.0, 3.0, 2.0], 1, 5)
    status, headers, png = request(port, f"/texture/{RANDOM}.png")
    assert (status, headers["content-type"]) == (200, "image/png")
    finished = {"curve_total_cte_m": [4.0, 5.0]}
    (folder / "cells" / GRADIENT).mkdir()
    record.finish(GRADIENT, 0.0, cached=True)
    (folder / "cells" / GRADIENT / "surrogate.json").write_text(json.dumps(finished))
    running, ended = state_of(port)["searches"]
    assert (running["name"], ended["name"], ended["planned"]) == (RANDOM, GRADIENT, 2)
    picture = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    assert picture.std() > 10.0
    record.end("ValueError: no more")
    state = state_of(port)
    assert (state["phase"], state["failure"]) == ("failed", "ValueError: no more")
    assert [part["state"] for part in state["parts"]][3] == "failed"
    assert request(port, "/")[1]["location"] == "/run"


def test_searches_for_another_objective_are_watched_by_its_value(tmp_path):
    cells = tmp_path / "cells"
    record = ProgressRecord(tmp_path, {**ABOUT, "maximised": {"name": "Turn", "unit": "deg"}})
    record.plan(["report"], CELLS)
    for name in (RANDOM, GRADIENT):
        record.finish(name, 0.0, cached=True)
    search_so_far(cells / RANDOM, [1.0, 3.0, 2.0], values=[-4.0, -8.0, -2.0])
    (cells / GRADIENT).mkdir()
    finished = {"curve_total_cte_m": [4.0, 5.0], "curve_value": [-1.5, -7.0]}
    (cells / GRADIENT / "surrogate.json").write_text(json.dumps(finished))
    found = {each["name"]: each for each in read_state(tmp_path, time.time())["searches"]}
    assert (found[RANDOM]["values"], found[RANDOM]["best"]) == ((-4.0, -8.0, -2.0), 2)
    assert (found[GRADIENT]["values"], found[GRADIENT]["best"]) == ((-1.5, -7.0), 0)
    assert found[RANDOM]["measure"] == {"name": "Turn", "unit": "deg"}


def test_cells_that_other_processes_run_are_seen_by_their_files(served):
    folder, record, port = served
    record.finish(CLEAN, 0.0, cached=True)
    for name, percent in ((RANDOM, 40), (GRADIENT, 80)):
        (folder / "cells" / name).mkdir(parents=True)
        (folder / "cells" / name / "key.json").write_text("{}")
        (folder / "cells" / name / "log.txt").write_text(f"{percent} % 4/5, total CTE 2.0 m\n")
    parts = {part["name"]: part for part in state_of(port)["parts"]}
    assert parts[CLEAN]["state"] == "reused"
    assert (parts[RANDOM]["state"], parts[RANDOM]["fraction"]) == ("running", 0.4)
    assert parts[RANDOM]["text"] == "4/5, total CTE 2.0 m"
    (folder / "cells" / RANDOM / "error.json").write_text(json.dumps({"error": "ValueError: NaN"}))
    result = {"seconds": 12.5, "surrogate": {"total_cte_m": [4.0, 6.0], "none_total_cte_m": [1.0, 1.0]}}
    (folder / "cells" / f"{GRADIENT}.json").write_text(json.dumps(result))
    parts = {part["name"]: part for part in state_of(port)["parts"]}
    assert (parts[RANDOM]["state"], parts[RANDOM]["text"]) == ("failed", "ValueError: NaN")
    assert (parts[GRADIENT]["state"], parts[GRADIENT]["seconds"]) == ("done", 12.5)
    assert parts[GRADIENT]["measured"] == {"surrogate": [5.0, 1.0]}


def test_an_unchanged_state_is_not_sent_again(at_rest):
    _, headers, body = request(at_rest, "/state.json")
    assert body
    status, again, body = request(at_rest, "/state.json", headers={"if-none-match": headers["etag"]})
    assert (status, again["etag"], body) == (304, headers["etag"], b"")


def test_the_report_takes_over_once_it_is_made(served):
    folder, record, port = served
    (folder / "report" / "videos").mkdir(parents=True)
    (folder / "report" / "report.html").write_text("<html>the report</html>")
    (folder / "report" / "videos" / "a.mp4").write_bytes(bytes(range(256)))
    record.finish("report", 1.0, cached=False)
    assert request(port, "/")[1]["location"] == "/run"
    record.end()
    status, headers, _ = request(port, "/")
    assert (status, headers["location"]) == (307, "/report/report.html")
    status, headers, body = request(port, "/report/report.html")
    assert b"the report" in body
    assert "script-src" not in headers["content-security-policy"]
    assert "style-src 'unsafe-inline'" in headers["content-security-policy"]
    status, _, part = request(port, "/report/videos/a.mp4", headers={"range": "bytes=10-19"})
    assert (status, part) == (206, bytes(range(10, 20)))
    assert request(port, "/run")[0] == 200


def test_the_recorded_victim_is_labelled_and_gives_way_to_the_films_of_this_run(served):
    folder, record, port = served
    assert state_of(port)["recorded"] is None
    about = {"label": LABEL, "text": "It drives.", "file": "recorded/now.jpg", "film": False}
    (folder / "recorded").mkdir()
    (folder / "recorded" / "about.json").write_text(json.dumps(about))
    assert state_of(port)["recorded"] == {**about, "file": ""}  # before its first picture
    (folder / "recorded" / "now.jpg").write_bytes(b"a picture")
    (folder / "recorded" / "log.txt").write_bytes(b"secret")
    assert state_of(port)["recorded"] == about
    assert request(port, "/recorded/now.jpg?1")[2] == b"a picture"
    assert request(port, "/recorded/log.txt")[0] == 404
    record.finish(RANDOM, 3.0, cached=False)
    (folder / "cells" / RANDOM).mkdir(parents=True)
    (folder / "cells" / RANDOM / "clip.mp4").write_bytes(b"a film")
    state = state_of(port)
    assert (state["recorded"], state["films"]) == (None, [f"cells/{RANDOM}/clip.mp4"])


@pytest.mark.parametrize("path", OTHER_PATHS)
def test_only_the_files_of_the_page_are_served(at_rest, path):
    assert request(at_rest, "/policy/a.png")[2] == b"a picture"
    status, _, body = request(at_rest, path)
    assert status == 404
    assert b"secret" not in body


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
@pytest.mark.parametrize("path", ["/", "/state.json", "/web/main.js", "/policy/a.png"])
def test_it_only_reads(at_rest, method, path):
    assert request(at_rest, path, method=method)[0] == 405


def test_a_stranger_with_a_name_for_this_computer_gets_nothing(at_rest):
    status, _, body = request(at_rest, "/state.json", headers={"host": "evil.example:80"})
    assert (status, b"room" in body) == (421, False)


def test_all_answers_forbid_what_is_not_ours(at_rest):
    for path in ("/run", "/web/main.js", "/web/look.css", "/favicon.ico", "/state.json"):
        status, headers, _ = request(at_rest, path)
        assert status == 200
        assert "default-src 'none'" in headers["content-security-policy"]
        assert headers["x-content-type-options"] == "nosniff"


def test_a_taken_port_is_one_error_before_anything_is_run(tmp_path):
    experiment = tiny_experiment(tmp_path / "run")
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        with pytest.raises(BusError, match=f"127.0.0.1:{port}.*choose another port"):
            run_with_page(experiment, port, lambda record: pytest.fail("it was run"), print)
    assert not (tmp_path / "run").exists()


@pytest.mark.live
def test_clients_that_never_read_do_not_reach_the_experiment(served):
    folder, record, port = served
    film = folder / "cells" / RANDOM / "clip.mp4"
    film.parent.mkdir(parents=True)
    film.write_bytes(bytes(8 << 20))
    silent = []
    for _ in range(100):
        client = socket.create_connection(("127.0.0.1", port))
        client.sendall(f"GET /cells/{RANDOM}/clip.mp4 HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        silent.append(client)
    report, began_s = record.start("scene"), time.monotonic()
    for step in range(1000):
        report(step / 1000, f"step {step}")
    record.finish("scene", 1.0, cached=False)
    assert time.monotonic() - began_s < 60.0
    for client in silent:
        client.close()
    while request(port, "/state.json")[0] == 503:
        time.sleep(0.1)
    assert state_of(port)["parts"][1]["state"] == "done"


def children():
    return set(Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split())


def test_an_experiment_outlives_its_page(tmp_path):
    said, others = [], children()

    def run(record):
        (server,) = children() - others
        os.kill(int(server), signal.SIGKILL)
        time.sleep(0.5)
        record.start("scene")(0.5, "goes on")
        return "done"

    assert run_with_page(tiny_experiment(tmp_path / "run"), 0, run, said.append) == "done"
    assert "the page ended before" in said[-1]


def test_the_time_left_is_that_of_running_parts_and_of_cells_like_those_that_are_done():
    def part(name, state, searched=True, **changes):
        return {
            "name": name,
            "state": state,
            "searched": searched,
            "fraction": 0.0,
            "first_fraction": 0.0,
            "began_s": 0.0,
            "seconds": 0.0,
            **changes,
        }

    stages = [
        part("scene", "running", began_s=50.0, fraction=0.6, first_fraction=0.1),
        part("report", "waiting"),
    ]
    cells = [part("a", "done", seconds=30.0), part("b", "waiting"), part("c", "waiting")]
    # Half of it took 50 s, 0.4 are left.
    assert all_left_s(stages, cells, 100.0) == (40.0 + 60.0, True)
    assert all_left_s(stages, [*cells, part("d", "waiting", searched=False)], 100.0) == (100.0, False)
    assert all_left_s([part("policy", "waiting")], cells, 100.0) == (60.0, False)
    # Two cells at a time.
    cells = [
        part("a", "done", seconds=30.0),
        part("b", "running", began_s=90.0),
        part("c", "running", began_s=80.0),
    ]
    assert all_left_s([], cells, 100.0) == ((20.0 + 10.0) / 2, True)


def test_a_page_changes_no_key_and_no_attack(tiny_room, tmp_path, monkeypatch):
    """The same tiny experiment without and with its page, from the same stages."""
    monkeypatch.setattr(ExperimentPage, "wait", lambda page: None)
    found = []
    for name in ("alone", "watched"):
        shutil.copytree(tiny_room[0], tmp_path / name, ignore=shutil.ignore_patterns("cells"))
        experiment = tiny_experiment(tmp_path / name)

        def run(record, experiment=experiment):
            only = "victim=hardened,method=none+random"
            return whole.run_experiment(experiment, only=only, record=record)

        ended = run(None) if name == "alone" else run_with_page(experiment, 0, run, lambda text: None)
        assert [end.how for end in ended] == ["done", "done"]
        found.append(made_by(experiment))
    assert found[0] == found[1]
    record = read_progress(tmp_path / "watched")
    assert {name: part["state"] for name, part in record["parts"].items()} == {
        **dict.fromkeys(("capture", "scene", "bake", "object", "policy"), "reused"),
        **dict.fromkeys((CLEAN, RANDOM), "done"),
        "report": "waiting",
    }
    assert "no report yet: 1 of 3 cells are missing" in [line for _, line in record["log"]]
    assert not (tmp_path / "alone" / "progress.json").exists()


def made_by(experiment):
    """Keys and results: of the stages, and of a cell."""
    cell = Cell("track", "hardened", "random", 0)
    result = json.loads(experiment.cell_result(cell).read_text())
    stages = [
        (experiment.stage_folder(name) / "stage.json").read_text() for name in ("capture", "scene", "policy")
    ]
    attack = load_attack(experiment.cell_folder(cell) / "attack.safetensors")
    return (
        attack.attack_id,
        stages,
        [result[key] for key in ("settings_hash", "attack_id", "surrogate", "deployed")],
    )
