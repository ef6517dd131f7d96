import grp
import os
from collections import namedtuple

import pytest

from nodes.lab.doctor import machine, motor
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult
from nodes.lab.doctor.recording import ImageFormat, bytes_per_s
from nodes.linking.keys import DRIVE, KeyFolder
from nodes.runtime.bus import Bus
from nodes.runtime.messages import header, types

pytestmark = pytest.mark.live


def test_keys_are_shown_and_one_that_others_may_read_is_a_finding_with_its_cure(tmp_path):
    (found,) = machine.keys(tmp_path)
    assert (found.state, found.do) == (ABSENT, "two hosts need them: advnerf car keys new NAME")
    keys = KeyFolder(tmp_path)
    keys.new("robot")
    keys.allow("robot", DRIVE)
    assert machine.keys(tmp_path) == [
        CheckResult("keys", OK, "ours: robot; robot may drive over the network")
    ]
    (tmp_path / "secret" / "robot.key").chmod(0o640)
    (found,) = machine.keys(tmp_path)
    assert found.state == WARNING
    assert "create a new key" in found.found


def test_clock_is_judged_by_what_the_kernel_says(monkeypatch):
    real = machine.adjtimex_error_s()
    assert real is None or 0.0 <= real < 60.0
    for error_s, state in ((None, WARNING), (0.02, WARNING), (0.001, OK)):
        monkeypatch.setattr(machine, "adjtimex_error_s", lambda value=error_s: value)
        assert machine.clock()[0].state == state


def chronyc(folder, monkeypatch, script):
    (folder / "chronyc").write_text(f"#!/bin/sh\n{script}\n")
    (folder / "chronyc").chmod(0o755)
    monkeypatch.setenv("PATH", str(folder), prepend=":")


def test_chrony_says_whom_it_follows_and_one_that_hangs_costs_its_deadline_only(tmp_path, monkeypatch):
    monkeypatch.setattr(machine, "adjtimex_error_s", lambda: 0.001)
    row = "C0A80A01,192.168.10.1,3,1700000000.1,0.000250000,0.0001,0.0002,1.2,0.001,0.02,0.001,0.002,64.0,Normal"
    chronyc(tmp_path, monkeypatch, f"echo {row}")
    assert machine.clock() == [
        CheckResult("clock", OK, "off by at most 1.0 ms, chrony follows 192.168.10.1, offset +0.25 ms")
    ]
    chronyc(tmp_path, monkeypatch, "echo '506 Cannot talk to daemon' >&2; exit 1")
    assert "chronyd is not running" in machine.clock()[0].found
    monkeypatch.setattr(machine, "_CHRONYC_S", 0.1)
    chronyc(tmp_path, monkeypatch, "exec sleep 30")
    assert "no answer from chronyc" in machine.clock()[0].found


@pytest.mark.parametrize(
    ("offset_s", "state", "cure"),
    [(0.001, OK, ""), (-0.012, WARNING, "chrony"), (0.05, FAILURE, "cannot be armed")],
)
def test_offset_of_the_other_host_is_heard_from_a_running_launch(tmp_path, offset_s, state, cure):
    with Bus(tmp_path) as gateway:
        gateway.publisher("/clock/offset")
        message = types.ClockOffset(
            header=header(1), peer="robot", offset_s=offset_s, error_s=0.001, round_trip_s=0.002
        )

        class Speaking(Bus):
            def wait(self, timeout_s):
                gateway.publish("/clock/offset", message)
                super().wait(0.02)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(machine, "Bus", Speaking)
            (found,) = machine._offset(tmp_path)
    assert (found.check, found.state) == ("clock offset", state)
    assert cure in found.do
    assert f"{offset_s * 1e3:+.1f} +- 1.0 ms" in found.found


def test_disk_is_told_in_minutes_of_recording(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    rate = 4.0e6
    for free, minutes, state in ((1e6, 0, FAILURE), (2.4e9, 10, WARNING), (24e9, 100, OK)):
        monkeypatch.setattr(machine.shutil, "disk_usage", lambda path, free=free: usage(1e12, 0, int(free)))
        (found,) = machine.disk(tmp_path / "new" / "folder", rate)
        assert found.state == state
        assert f": {minutes} minutes of recording at 14.4 GB an hour" in found.found
        assert bool(found.do) is (state != OK)


def test_a_recording_is_two_picture_streams_and_little_else():
    roles = ("camera", "vicon", "compositor", "policy", "safety", "motor")
    pictures = 2 * 336 * 188 * 3 * 10.0
    assert pictures < bytes_per_s(ImageFormat(), publishers=roles) < 1.15 * pictures
    assert bytes_per_s(ImageFormat(rate_hz=20.0), publishers=roles) > 1.8 * pictures
    assert bytes_per_s(ImageFormat(), ["/vicon/car"], statuses=0) == 100.0 * 400
    small = bytes_per_s(ImageFormat(compressed=True), ["/camera/image_raw/compressed"], statuses=0)
    assert 0.1 < small / (pictures / 2) < 0.25


def test_requirements_are_compared_with_what_is_installed():
    unused = ['nobody-has-this>=1; extra == "gadget"', 'nor-this[a1]>=1; extra == "gadget-cu12"']
    assert machine.packages(["numpy>=1.26,<3", *unused]) == [CheckResult("extras", OK, "complete: none")]
    rows = machine.packages(
        ["numpy>=99", "nobody-has-this", 'numpy<1; extra == "old"', 'pydantic>=2; extra == "good"']
    )
    assert [row.state for row in rows] == [FAILURE, OK, WARNING]
    assert "is not >=99; nobody-has-this is missing" in rows[0].found
    assert rows[1].found == "complete: good"
    assert rows[2].do == "pip install 'advnerf[old]'"
    assert machine.versions()[0].state == OK


@pytest.mark.parametrize(
    ("version", "specifier", "fits"),
    [
        ("2.13.0+cpu", ">=2.4", True),
        ("0.12.1", "<0.12,>=0.11", False),
        ("5", "<5,>=4.10", False),
        ("4.10.0.84", "<5,>=4.10", True),
        ("0.9.16", "==0.9.16", True),
        ("3.1", "==3.1.0", True),
        ("1.0", "", True),
    ],
)
def test_specifiers(monkeypatch, version, specifier, fits):
    monkeypatch.setattr(machine.importlib.metadata, "version", lambda name: version)
    assert (machine.packages([f"thing{specifier}"])[0].state == OK) is fits


def test_what_only_another_computer_needs_does_not_make_an_extra_incomplete():
    elsewhere = "nobody-has-this>=11,<12; platform_machine == 'vax' and extra == 'ros2'"
    here = "numpy; platform_machine != 'vax' and extra == 'ros2'"
    (row,) = machine.packages([elsewhere, here, "nobody-has-this; python_version < '3'"])
    assert row == CheckResult("extras", OK, "complete: ros2")
    rows = machine.packages([elsewhere.replace("==", "!=", 1)])
    assert [row.found for row in rows] == ["complete: none"]


def test_permission_is_cured_by_the_group_or_by_logging_in_again(monkeypatch):
    entry = namedtuple("entry", "gr_gid gr_mem")
    monkeypatch.setattr(motor.pwd, "getpwuid", lambda uid: namedtuple("user", "pw_name")("ann"))
    monkeypatch.setattr(grp, "getgrnam", lambda name: entry(4711, []))
    assert motor.permission_cure("dialout") == "sudo usermod -aG dialout ann, then log out and in again"
    monkeypatch.setattr(grp, "getgrnam", lambda name: entry(4711, ["ann"]))
    assert "only since your last login" in motor.permission_cure("dialout")
    monkeypatch.setattr(os, "getgroups", lambda: [4711])
    assert "udev rule sets GROUP" in motor.permission_cure("dialout")


def test_stable_names_are_those_that_lead_to_the_device(tmp_path):
    device, folder = tmp_path / "ttyACM0", tmp_path / "by-id"
    device.touch()
    folder.mkdir()
    (folder / "usb-ST_VESC-if00").symlink_to("../ttyACM0")
    (folder / "usb-other").symlink_to("../ttyACM1")
    (tmp_path / "vesc").symlink_to("ttyACM0")
    names = motor.stable_names(device, [folder, tmp_path / "none"], tmp_path / "vesc")
    assert [name.name for name in names] == ["vesc", "usb-ST_VESC-if00"]
