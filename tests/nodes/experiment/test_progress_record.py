"""What a running experiment leaves for its page, and that no error there reaches the experiment."""

import json
import threading

import pytest

from nodes.experiment.engine.progress_record import FILE, ProgressRecord, read_progress
from nodes.experiment.plan.cell import Cell
from nodes.runtime.progress import Point

CELL = Cell("track", "hardened", "random", 0)
ABOUT = {"name": "room", "setting": "demo", "planned": 2, "space": "face"}


@pytest.fixture
def record(tmp_path):
    made = ProgressRecord(tmp_path, ABOUT)
    made.plan(["capture", "scene"], [CELL])
    return made


def test_it_follows_what_is_reported(record, tmp_path):
    record.finish("capture", 2.0, cached=True)
    report = record.start("scene")
    report(0.25, "step 10", Point("PSNR [dB]", 10, 20.5))
    report(0.5, "step 20", Point("PSNR [dB]", 20, float("nan")))
    record.say("a line")
    found = read_progress(tmp_path)
    assert [found["parts"][name]["state"] for name in ("capture", "scene", CELL.name)] == [
        "reused",
        "running",
        "waiting",
    ]
    scene = found["parts"]["scene"]
    assert (scene["fraction"], scene["first_fraction"], scene["text"]) == (0.5, 0.25, "step 20")
    assert found["curves"] == {"scene": {"PSNR [dB]": [[10, 20.5]]}}
    assert [line for _, line in found["log"]] == ["capture: unchanged, reused", "scene: started", "a line"]


def test_an_error_is_that_of_what_was_running(record, tmp_path):
    record.start("scene")
    record.end("ValueError: no photographs")
    found = read_progress(tmp_path)
    assert found["failure"] == found["parts"]["scene"]["text"] == "ValueError: no photographs"
    assert found["parts"]["scene"]["state"] == "failed"
    assert found["parts"]["capture"]["state"] == "waiting"
    assert found["ended_s"] > 0.0


def test_curves_of_a_run_that_was_stopped_go_on_without_repeated_steps(record, tmp_path):
    report = record.start("scene")
    for step in (10, 20, 30):
        report(step / 100, "", Point("PSNR [dB]", step, float(step)))
    record.end("stopped")
    again = ProgressRecord(tmp_path, ABOUT)
    again.plan(["scene"], [])
    again.start("scene")(0.2, "", Point("PSNR [dB]", 20, 21.0))
    again.end()
    assert read_progress(tmp_path)["curves"]["scene"]["PSNR [dB]"] == [[10, 10.0], [20, 21.0]]


def test_a_disk_that_cannot_be_written_ends_the_record_only(tmp_path):
    (tmp_path / "run").write_text("a file where the folder should be")
    record = ProgressRecord(tmp_path / "run", ABOUT)
    record.plan(["scene"], [])
    record.start("scene")(0.5, "goes on")
    record.end()


def test_reports_of_several_threads_leave_a_whole_file(record, tmp_path):
    report = record.start("scene")

    def work(number):
        for step in range(200):
            report(step / 200, f"thread {number}", Point(f"curve {number}", step, 1.0))
            record.say(f"line {step}")

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    record.end()
    assert len(json.loads((tmp_path / FILE).read_text())["curves"]["scene"]) == 4
