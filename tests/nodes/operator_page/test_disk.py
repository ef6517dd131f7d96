"""The log of acts on a disk that is full, comes back, or hangs."""

import contextlib
import json
import os
import resource
import signal
import threading
import time

import pytest

from nodes.operator_page.diary import Diary
from nodes.operator_page.disk import DiskWriter
from nodes.runtime.clock import Now
from nodes.runtime.inbox import Inbox
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

NOW = Now(1, 2)


def note(diary, act):
    diary.note(NOW, "Ann", "127.0.0.1", act, "", 0, "")


@contextlib.contextmanager
def files_of_at_most(size):
    """A disk on which files cannot grow beyond this size: writes are short, then fail (setrlimit(2), RLIMIT_FSIZE)."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    # Python ignores this signal from its start; a library that an earlier test loaded may have put its default back, which kills.
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, before)


def acts_in(file):
    return [json.loads(line)["act"] for line in file.read_text().splitlines()]


def test_a_full_disk_is_reported_and_no_line_is_lost_or_torn(tmp_path):
    file, disk = tmp_path / "page" / "acts.jsonl", DiskWriter()
    diary = Diary(file, disk)
    note(diary, "hold")
    wait_for(lambda: file.exists() and file.read_text().count("\n") == 1, "the first line")
    with files_of_at_most(file.stat().st_size + 20):
        note(diary, "estop")
        note(diary, "disarm")
        wait_for(lambda: disk.trouble, "the full disk to be noticed")
        assert disk.trouble.startswith("cannot write: ")
        assert [act["act"] for act in diary.last] == ["disarm", "estop", "hold"]
    wait_for(lambda: file.read_text().count("\n") == 3, "the rest of the log")
    assert acts_in(file) == ["hold", "estop", "disarm"]
    wait_for(lambda: not disk.trouble, "the disk to be well again")
    disk.close()
    diary.close()
    assert file.stat().st_mode & 0o777 == 0o600


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
def test_a_device_that_takes_nothing_ends_nothing():
    disk, file = DiskWriter(), open("/dev/full", "wb", buffering=0)  # noqa: SIM115
    disk.submit(lambda: file.write(b"x"))
    wait_for(lambda: disk.trouble == "cannot write: No space left on device", "the trouble")
    disk.close(5.0)
    assert not disk._thread.is_alive()
    file.close()


def test_a_disk_that_hangs_delays_nobody_and_is_named():
    disk, answer = DiskWriter(), threading.Event()
    done = []
    disk.submit(answer.wait)
    disk.submit(lambda: done.append(1))
    wait_for(lambda: disk._began_s is not None, "the write to begin")
    disk._began_s = time.monotonic() - 60.0  # as after a minute
    assert disk.trouble == "the disk has not answered for 60 s"
    for _ in range(5000):
        disk.submit(lambda: done.append(1))  # none of these waits for the disk
    assert disk.lost > 2900
    answer.set()
    wait_for(lambda: len(done) > 1000, "the waiting jobs")
    disk.close(10.0)


def test_no_item_displaces_an_urgent_one():
    inbox = Inbox(capacity=4)
    inbox.put("stop", urgent=True)
    for number in range(100):
        inbox.put(number)
    inbox.fail(RuntimeError("the server ended"))
    assert inbox.take() == ["stop", 96, 97, 98, 99]
    with pytest.raises(RuntimeError, match="the server ended"):
        inbox.take()
    inbox.close()
