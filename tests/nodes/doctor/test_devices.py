"""The doctor and the emulators: a VESC on a pty, Tracker's datagrams; absent, wrong, busy and hung."""

import contextlib
import os
import pty
import re
import socket
import threading
import time
import tty
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.emulators.vicon_emulator import ViconEmulatorConfig
from hardware.errors import LinkLost
from hardware.mocap.vicon import ViconConfig, free_udp_port
from hardware.motor.vesc_settings import TimeoutSettings
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from nodes.lab.doctor import mocap, motor
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, DoctorCheck, examine
from tests.support.faulty_devices import FaultyVescEmulator, FaultyViconEmulator

TWIN = Path(__file__).parents[3] / "calibration" / "twin"
GOOD = {"timeout_ms": 250.0, "timeout_brake_current_a": 20.0}


def vesc(config=None, fault=0, wire=None):
    with FaultyVescEmulator(VescEmulatorConfig(**(config or GOOD))) as emulator:
        emulator.report_fault(fault)
        emulator.disturb(wire)
        found = motor.vesc(emulator.port)
        assert not [event for event in emulator.events() if event.name.startswith("SET")]  # it is only asked
        return {(row.check, row.state): row for row in found}


def test_a_good_controller():
    assert list(vesc()) == [("VESC", OK), ("VESC time-out", OK), ("battery", OK)]
    found = vesc()["VESC", OK].found
    assert "TWIN firmware 5.02 at /dev/pts/" in found
    assert vesc()["VESC time-out", OK].found == "250 ms with 20 A; required is at most 250 ms with 20 A"


def test_as_delivered_the_car_rolls_on_and_the_cure_is_a_command():
    row = vesc({"timeout_ms": 1000.0})["VESC time-out", FAILURE]
    assert "1000 ms with 0 A" in row.found
    assert row.do.startswith("advnerf car motor set-timeout --vesc /dev/pts/")
    assert row.do.endswith("--timeout-ms 250 --brake-current 20")
    assert ("VESC time-out", FAILURE) in vesc({**GOOD, "timeout_ms": 0.0})


def test_battery_fault_and_a_firmware_that_does_not_tell():
    assert "11.0 V" in vesc({**GOOD, "supply_v": 11.0})["battery", WARNING].found
    assert "under voltage" in vesc(fault=2)["VESC", WARNING].found
    assert "VESC Tool" in vesc({**GOOD, "readable_settings": False})["VESC time-out", WARNING].do


@pytest.mark.parametrize(
    ("wire", "got"),
    [("silent", "got nothing; is this a VESC"), ("garbage", r"got \d+ bytes that are no frames of a VESC")],
)
def test_a_line_without_a_sensible_word(wire, got):
    row = vesc(wire=wire)["VESC", FAILURE]
    assert re.search(got, row.found), row.found
    assert "check the port" in row.do


def test_absent_busy_and_something_else_at_the_port(tmp_path):
    (row,) = motor.vesc(str(tmp_path / "nothing"), required=True)
    assert (row.state, "udev rule" in row.do) == (FAILURE, True)
    with VescEmulator(VescEmulatorConfig(), TwinVehicle(CarConfig())) as emulator:
        held = motor.Vesc(emulator.port, motor.VehicleGains(), motor.DriveLimits())
        held.open()
        (row,) = motor.vesc(emulator.port)
        held.abandon()
    assert (row.state, row.do) == (WARNING, "stop the launch, or close VESC Tool")
    (tmp_path / "file").write_text("not a terminal")
    assert motor.vesc(str(tmp_path / "file"))[0].state == FAILURE


def test_no_controller_is_absent_unless_it_is_needed(monkeypatch):
    monkeypatch.setattr(motor, "find_vesc", lambda: None)
    assert [motor.vesc(None)[0].state, motor.vesc(None, required=True)[0].state] == [ABSENT, FAILURE]


def test_a_terminal_that_takes_no_bytes_does_not_hang_the_doctor():
    master, slave = pty.openpty()
    tty.setraw(slave)
    port = os.ttyname(slave)
    os.set_blocking(slave, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(slave, bytes(4096))
    (row,) = motor.vesc(port)
    os.close(slave)
    os.close(master)
    assert row.state == FAILURE


class Port:
    def __init__(self, device, vid=0x0483, pid=0x5740):
        self.device, self.vid, self.pid, self.description = (
            str(device),
            vid,
            pid,
            "ChibiOS/RT Virtual COM Port",
        )


def test_a_serial_device_is_told_with_what_it_lacks(tmp_path, monkeypatch):
    device = tmp_path / "ttyACM0"
    device.touch()
    monkeypatch.setattr(motor, "ports", lambda: [Port(device)])
    monkeypatch.setattr(motor, "_running", lambda name: None)
    assert "install the udev rule" in motor.serial_ports()[0].do
    monkeypatch.setattr(motor, "stable_names", lambda device: [motor.FIXED_NAME])
    assert [row.state for row in motor.serial_ports()] == [OK]
    monkeypatch.setattr(motor, "_running", lambda name: 4711)
    assert "ModemManager is running (process 4711)" in motor.serial_ports()[1].found
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert motor.serial_ports()[0].found.startswith("no permission for")
    monkeypatch.setattr(motor, "ports", list)
    assert motor.serial_ports()[0].state == ABSENT


def test_a_program_is_found_by_its_name():
    assert motor._running("no such program") is None
    assert motor._running(Path("/proc/self/comm").read_text().strip()) is not None


LISTEN_S = 0.4


@contextmanager
def tracker(names=("car", "board"), sent=None):
    """A stream of these subjects; the time of each frame is added to ``sent``."""

    def poses(ns):
        if sent is not None:
            sent.append(ns)
        return {name: np.eye(4) + np.eye(4, k=3) for name in names}

    emulator = FaultyViconEmulator(ViconEmulatorConfig(port=free_udp_port()), poses)
    try:
        yield emulator
    finally:
        emulator.close()


def listen(port, subjects=("car", "board"), **options):
    config = ViconConfig(tuple(subjects), "127.0.0.1", port)
    return mocap.listen(config, **{"required": True, "listen_s": LISTEN_S, **options})


def test_the_stream_its_rate_and_its_subjects():
    sent = []
    with tracker(sent=sent) as emulator:
        sent.clear()
        stream, *subjects = listen(emulator.config.port)
        in_the_first = len(sent)
        assert stream.state == OK
        # A busy machine sends fewer than 100 a second: what counts is what was sent meanwhile.
        assert 0.6 < LISTEN_S * float(stream.found.split()[0]) / in_the_first < 1.4
        assert [(row.state, row.found.split(":")[0]) for row in subjects] == [(OK, "car"), (OK, "board")]
        rows = listen(emulator.config.port, ("car", "wand"))
        assert [(row.state, row.found) for row in rows[2:]] == [(FAILURE, "wand is not seen")]
        assert listen(emulator.config.port, ("car", "wand"), needed=("car",))[-1].state == WARNING
        unasked = listen(emulator.config.port, ())
        assert {row.found.split(":")[0] for row in unasked[1:]} == {"car", "board"}


def test_places_are_told_and_a_stream_in_metres_is_suspected():
    """Tracker sends mm. In metres, everything stands within millimetres of the origin, and inside every fence."""
    with tracker() as emulator:
        car = listen(emulator.config.port)[1]
        assert (car.state, car.found.endswith("at x 1.000, y 0.000, z 0.000 m")) == (OK, True)
    small = {"car": np.eye(4) + 0.001 * np.eye(4, k=3)}
    emulator = FaultyViconEmulator(ViconEmulatorConfig(port=free_udp_port()), lambda ns: small)
    try:
        car = listen(emulator.config.port, ("car",))[1]
        assert (car.state, "a stream in metres" in car.do) == (WARNING, True)
    finally:
        emulator.close()


@pytest.mark.parametrize("form", ["missing", "zeros", "nan", "frozen"])
def test_an_occluded_car_is_not_seen(form):
    with tracker() as emulator:
        emulator.occlude("car", form)
        time.sleep(0.1)
        car = next(row for row in listen(emulator.config.port) if row.found.startswith("car"))
        # Frozen poses count until the same bits came five times.
        assert car.state == FAILURE or (form == "frozen" and float(car.found.split()[1]) < 20)


def test_silence_a_stranger_and_a_taken_port():
    port = free_udp_port()
    (row,) = listen(port)
    assert row.state == FAILURE
    assert "UDP Object Stream to" in row.do
    assert listen(port, required=False)[0].state == ABSENT
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", port))
        (row,) = listen(port)
        assert (row.state, "ss -ulpn" in row.do) == (FAILURE, True)
        assert mocap.free_port(port, "127.0.0.1") == [row]
    assert "give an address of this computer" in mocap.free_port(port, "203.0.113.7")[0].do
    stop = threading.Event()

    def shout():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            while not stop.wait(0.01):
                stranger.sendto(b"\xff" * 40, ("127.0.0.1", port))

    thread = threading.Thread(target=shout)
    thread.start()
    try:
        assert "not Tracker's" in listen(port)[0].found
        assert "not Tracker's" in listen(port, ())[0].found
    finally:
        stop.set()
        thread.join()


def test_time_out_that_a_launch_file_asks_for():
    with VescEmulator(VescEmulatorConfig(timeout_ms=400.0), TwinVehicle(CarConfig())) as emulator:
        rows = motor.vesc(emulator.port, TimeoutSettings(500, 0.0))
    assert [row.state for row in rows] == [OK, OK, OK]


def test_what_a_lost_line_says_is_the_finding():
    def lost():
        raise LinkLost("lost the VESC")

    assert [row.found for row in examine([DoctorCheck("VESC", lost)])] == ["lost the VESC"]
