"""The VESC driver against the emulator over a real pty, and the emulator's firmware with time handed to it."""

import contextlib
import os
import pty
import threading
import time
import tty

import pytest

from hardware.emulators.pacing import Pacer
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig, VescFirmware
from hardware.errors import DeviceBusy, DeviceNotFound, HardwareError, LinkLost, LinkTimeout
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_codec import CommandId, encode_command
from hardware.motor.vesc_replies import FirmwareVersion
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle
from tests.support.faulty_devices import FaultyVescEmulator
from tests.support.waiting import wait_for
from tests.support.wire_log import read_wire_log

pytestmark = pytest.mark.live


def vehicle():
    return TwinVehicle(CarConfig())


@pytest.fixture
def emulator(tmp_path):
    with VescEmulator(VescEmulatorConfig(), vehicle(), tmp_path / "vesc", tmp_path / "wire.csv") as emulator:
        yield emulator


def driver(emulator, **options):
    return Vesc(emulator.port, VehicleGains(), DriveLimits(), **options)


def names(emulator):
    return [event.name for event in emulator.events() if event.name not in ("GET_VALUES", "FW_VERSION")]


@contextlib.contextmanager
def running(emulator):
    """Let the car live in real time."""
    stop = threading.Event()
    pacer = Pacer(200.0)

    def run():
        while (tick_ns := pacer.wait(stop)) is not None:
            emulator.advance(0.005, tick_ns)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


def test_a_jam_has_no_effect_on_a_step_up_to_an_earlier_time():
    with FaultyVescEmulator(VescEmulatorConfig()) as emulator:
        emulator.vehicle.command(erpm=4000.0)
        before_ns = time.monotonic_ns()
        emulator.advance(0.5, before_ns)
        emulator.jam("locked")
        assert emulator.advance(0.005, before_ns + 1).speed_mps > 0.5, "due before, made late"
        assert names(emulator) == ["MOVING"]
        later_ns = time.monotonic_ns()
        assert emulator.advance(0.005, later_ns).speed_mps == 0.0
        assert [e.mono_ns for e in emulator.events() if e.name == "STANDSTILL"] == [later_ns]
        with pytest.raises(ValueError, match="expected a jam of locked, spinning, got 'stuck'"):
            emulator.jam("stuck")


def test_who_is_there(emulator):
    with driver(emulator) as vesc:
        assert vesc.identify() == FirmwareVersion(5, 2, "TWIN", b"advnerf-twin")
        assert str(vesc.firmware) == "TWIN firmware 5.02"
        values = vesc.read_values()
        assert (values.generation, values.erpm, values.v_in, values.fault) == ("F", 0.0, 15.2, 0)


def test_drive_sends_servo_then_rpm_and_says_what_it_sent(emulator):
    with driver(emulator) as vesc:
        sent = vesc.drive(0.3, 0.1)
        wait_for(lambda: len(emulator.events()) == 2, "two events")
        servo, rpm = emulator.events()
        assert (servo.name, rpm.name) == ("SET_SERVO_POS", "SET_RPM")
        assert (sent.servo, sent.erpm, sent.braking) == (servo.value, rpm.value, False)
        assert rpm.value == 1384.0  # 0.3 * 4614 = 1384.2, truncated by the protocol
        assert servo.value == 0.409
        assert sent.speed_mps == pytest.approx(0.3, abs=1e-3)
        assert sent.steering_rad == pytest.approx(0.1, abs=1e-3)
        assert sent.write_mono_ns <= time.monotonic_ns()
        assert abs(sent.write_mono_ns - servo.mono_ns) < 50e6


def test_limits_are_in_the_driver(emulator):
    with driver(emulator) as vesc:
        sent = vesc.drive(50.0, 9.0)
        assert sent.erpm == pytest.approx(0.35 * 4614, abs=1)
        assert sent.steering_rad == pytest.approx(0.3135, abs=2e-3)


@pytest.mark.parametrize("command", [(float("nan"), 0.0), (0.5, float("inf"))])
def test_a_command_that_is_not_finite_brakes(emulator, command):
    with driver(emulator, stop_brake_current_a=12.0) as vesc:
        sent = vesc.drive(*command)
        assert (sent.braking, sent.brake_current_a, sent.erpm) == (True, 12.0, 0.0)
        wait_for(lambda: names(emulator) == ["SET_CURRENT_BRAKE"], "the brake")


def test_leaving_the_context_brakes_then_lets_go(emulator):
    def make_a_mistake():
        with driver(emulator) as vesc:
            vesc.drive(0.5, 0.0)
            raise RuntimeError("mistake")

    with pytest.raises(RuntimeError, match="mistake"):
        make_a_mistake()
    wait_for(lambda: names(emulator)[-1] == "SET_CURRENT", "the release")
    assert names(emulator)[2:] == ["SET_CURRENT_BRAKE", "SET_CURRENT"]
    assert emulator.events()[-1].value == 0.0


def test_second_opening_is_refused(emulator):
    with driver(emulator), pytest.raises(DeviceBusy, match="another process holds it"):
        driver(emulator).open()


def test_no_such_port(tmp_path):
    with pytest.raises(DeviceNotFound, match="plugged in"):
        Vesc(str(tmp_path / "none"), VehicleGains(), DriveLimits()).open()


def test_hang_up_is_one_kind_of_error(emulator):
    vesc = driver(emulator)
    vesc.open()
    emulator.hang_up()
    with pytest.raises(LinkLost, match="USB"):
        vesc.receive()
    with pytest.raises(LinkLost, match="USB"):
        vesc.drive(0.5, 0.0)
    vesc.close()
    with pytest.raises(LinkLost, match="closed"):
        vesc.brake(1.0)


def test_silence_and_blockage_end_in_time_outs():
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        vesc = Vesc(os.ttyname(slave), VehicleGains(), DriveLimits(), write_timeout_s=0.02)
        vesc.open()
        with pytest.raises(LinkTimeout, match="powered"):
            vesc.identify(timeout_s=0.05)
        with pytest.raises(LinkTimeout, match="hangs"):
            all(vesc.brake(1.0) for _ in range(100_000))
        vesc.abandon()
    finally:
        os.close(master)
        os.close(slave)


def test_a_process_that_was_held_up_after_a_write_has_not_met_a_blocked_port(monkeypatch):
    """All bytes were accepted; that the clock went on meanwhile says nothing about the controller."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    try:
        vesc = Vesc(os.ttyname(slave), VehicleGains(), DriveLimits(), write_timeout_s=0.02)
        vesc.open()

        def late(fd, data, write=os.write):
            taken = write(fd, data)
            time.sleep(0.05)
            return taken

        monkeypatch.setattr("hardware.motor.vesc.os.write", late)
        assert vesc.brake(5.0).brake_current_a == pytest.approx(5.0)
        assert vesc.is_open
        vesc.abandon()
    finally:
        os.close(master)
        os.close(slave)


def test_the_car_moves_and_telemetry_says_so(emulator):
    with driver(emulator) as vesc, running(emulator):
        for _ in range(14):
            vesc.drive(0.8, 0.0)
            time.sleep(0.05)
        assert 0.2 < emulator.state.x_m < 0.6
        assert vesc.gains.speed_mps(vesc.read_values().erpm) == pytest.approx(0.8, abs=0.1)
        with pytest.raises(HardwareError, match="at rest"):
            emulator.place(0.0, 0.0, 0.0)
        vesc.brake(20.0)
        wait_for(lambda: emulator.state.speed_mps == 0.0, "standstill")
        emulator.place(1.0, 2.0, 0.5)
        assert (emulator.state.x_m, emulator.state.y_m, emulator.state.yaw_rad) == (1.0, 2.0, 0.5)
    motion = [e.name for e in emulator.events() if e.name in ("MOVING", "STANDSTILL", "PLACED")]
    assert motion == ["MOVING", "STANDSTILL", "PLACED"]


def test_wire_log_tells_what_came_and_where_the_car_was(emulator, tmp_path):
    with driver(emulator) as vesc:
        vesc.drive(0.5, 0.0)
        wait_for(lambda: len(names(emulator)) == 2, "two commands")
    rows = read_wire_log(tmp_path / "wire.csv")
    kept = [(event.name, event.value) for event, _, _ in rows if event.name != "GET_VALUES"]
    assert kept[:2] == [("SET_SERVO_POS", 0.53), ("SET_RPM", 1614.0)]
    assert [event.mono_ns for event, _, _ in rows] == sorted(event.mono_ns for event, _, _ in rows)


def test_link_is_made_and_removed(tmp_path):
    link = tmp_path / "vesc"
    link.symlink_to("/nowhere")
    with (
        VescEmulator(VescEmulatorConfig(), vehicle(), link) as emulator,
        Vesc(str(link), VehicleGains(), DriveLimits()) as vesc,
    ):
        assert os.path.realpath(link) == emulator.port
        vesc.identify()
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("timeout_ms", "brake_a", "expected_m"),
    # Stock: 1 s at 0.8/1.02 m/s, then friction 0.6 m/s^2. Set: 0.25 s, then friction and 20 A x 0.16 m/s^2/A.
    [(1000.0, 0.0, 0.784 * 1.0 + 0.784**2 / 2 / 0.6), (250.0, 20.0, 0.784 * 0.25 + 0.784**2 / 2 / 3.8)],
)
def test_stopping_distance_when_the_computer_dies(timeout_ms, brake_a, expected_m):
    car = vehicle()
    firmware = VescFirmware(VescEmulatorConfig(timeout_ms=timeout_ms, timeout_brake_current_a=brake_a), car)
    driven_m, timeouts = 0.0, []
    for ms in range(0, 7000, 5):
        if ms <= 2000 and ms % 50 == 0:
            send(firmware, CommandId.SET_RPM, 3691.0, at_ms=ms)
            driven_m = car.odometer_m
        if ms % 20 == 0:
            send(firmware, CommandId.GET_VALUES, at_ms=ms)  # telemetry must not keep it alive
        timeouts += firmware.check_timeout(round(ms * 1e6))
        car.advance(0.005)
    (event,) = timeouts
    assert event.value == brake_a
    assert 0.0 < event.mono_ns / 1e6 - 2000.0 - timeout_ms <= 20.0
    assert car.state.speed_mps == 0.0
    assert car.odometer_m - driven_m == pytest.approx(expected_m, abs=0.02)


class Plant:
    erpm = 0.0
    odometer_m = 0.0

    def __init__(self):
        self.commands = []

    def command(self, **kwargs):
        self.commands.append(kwargs)


def send(firmware, command, value=None, at_ms=0.0):
    return firmware.receive(encode_command(command, value), round(at_ms * 1e6))


@pytest.mark.parametrize(
    ("command", "value", "expected"),
    [
        (CommandId.SET_RPM, 4000.0, {"erpm": 4000.0}),
        (CommandId.SET_RPM, -50000.0, {"erpm": -30000.0}),
        (CommandId.SET_RPM, 899.0, {"duty": 0.0}),
        (CommandId.SET_CURRENT, 0.0, {"current_a": 0.0}),
        (CommandId.SET_CURRENT, 100.0, {"current_a": 60.0}),
        (CommandId.SET_CURRENT_BRAKE, -20.0, {"brake_current_a": 20.0}),
        (CommandId.SET_SERVO_POS, 2.0, {"servo": 1.0}),
    ],
)
def test_what_commands_do(command, value, expected):
    plant = Plant()
    send(VescFirmware(VescEmulatorConfig(), plant), command, value)
    assert plant.commands == [expected]


def test_servo_gate_of_stock_firmware_swallows_the_command():
    plant = Plant()
    replies, events = send(
        VescFirmware(VescEmulatorConfig(servo_output=False), plant), CommandId.SET_SERVO_POS, 0.3
    )
    assert (plant.commands, replies) == ([], b"")
    assert events[0].name == "SET_SERVO_POS"


@pytest.mark.parametrize(
    ("command", "value", "feeds"),
    [
        (CommandId.ALIVE, None, True),
        (CommandId.SET_SERVO_POS, 0.5, False),
        (CommandId.GET_VALUES, None, False),
    ],
)
def test_what_feeds_the_watchdog(command, value, feeds):
    firmware = VescFirmware(VescEmulatorConfig(timeout_ms=100.0), Plant())
    send(firmware, CommandId.SET_RPM, 4000.0, at_ms=0)
    send(firmware, command, value, at_ms=80)
    firmware.check_timeout(round(150e6))
    assert firmware.timed_out is not feeds


def test_the_time_out_latches_until_the_next_command_and_zero_switches_it_off():
    plant = Plant()
    firmware = VescFirmware(VescEmulatorConfig(timeout_ms=100.0, timeout_brake_current_a=7.0), plant)
    send(firmware, CommandId.SET_RPM, 4000.0)
    for ms in range(0, 400, 5):
        firmware.check_timeout(round(ms * 1e6))
    assert plant.commands == [{"erpm": 4000.0}, {"brake_current_a": 7.0}]
    send(firmware, CommandId.SET_RPM, 4000.0, at_ms=400)
    assert not firmware.timed_out
    never = VescFirmware(VescEmulatorConfig(timeout_ms=0.0), Plant())
    send(never, CommandId.SET_RPM, 4000.0)
    assert never.check_timeout(10**12) == []


def test_firmware_survives_noise_between_commands():
    plant = Plant()
    firmware = VescFirmware(VescEmulatorConfig(), plant)
    good = encode_command(CommandId.SET_CURRENT, 0.0)
    firmware.receive(b"\x02\x00\xff\x03" + good + b"\x55\x02" + good * 3, 0)
    assert plant.commands == [{"current_a": 0.0}] * 4
    assert firmware._decoder.skipped_bytes == 6
