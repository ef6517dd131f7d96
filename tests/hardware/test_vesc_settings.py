"""The head of a VESC's application configuration against bytes laid out by hand, and its way through a real pty and back."""

import struct

import pytest

from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.errors import LinkTimeout, ProtocolError
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_replies import FirmwareVersion
from hardware.motor.vesc_settings import TimeoutSettings, decode_app_configuration
from hardware.worlds.lab.config import CarConfig
from hardware.worlds.lab.vehicle import TwinVehicle

pytestmark = pytest.mark.live

# Controller id 7, 250 ms = 0x000000FA, 20 A (0x41A00000 as IEEE 754 single; 20000 mA = 0x00004E20), then other settings.
TAIL = bytes.fromhex("00 01 f4 02 03 aa bb cc 02 03 00")
GOLDEN = {
    (2, 18): "11 07 000000fa 00004e20",
    (3, 40): "11 07 000000fa 41a00000",
    (4, 2): "11 07 000000fa 41a00000",
    (5, 2): "11 deadbeef 07 000000fa 41a00000",
    (6, 2): "11 9ac0ffee 07 000000fa 41a00000",
}


def payload(release):
    return bytes.fromhex(GOLDEN[release]) + TAIL


@pytest.mark.parametrize("release", GOLDEN)
def test_time_out_of_every_layout_and_nothing_else_changes(release):
    read = decode_app_configuration(payload(release), FirmwareVersion(*release))
    assert read.timeout == TimeoutSettings(250, 20.0)
    changed = read.with_timeout(TimeoutSettings(1000, 0.0))
    assert decode_app_configuration(
        b"\x11" + changed.data, FirmwareVersion(*release)
    ).timeout == TimeoutSettings(1000, 0.0)
    assert changed.with_timeout(TimeoutSettings(250, 20.0)).data == payload(release)[1:]
    kept = len(payload(release)) - len(TAIL) - 1 - 8
    assert changed.data[:kept] == read.data[:kept]
    assert changed.data[kept + 8 :] == TAIL


@pytest.mark.parametrize("release", GOLDEN)
def test_as_delivered(release):
    # 1000 ms and 0 A, where the eight bytes of the plain and the signed layout are easiest to take for one another.
    stock = decode_app_configuration(payload(release), FirmwareVersion(*release)).with_timeout(
        TimeoutSettings(1000, 0.0)
    )
    assert decode_app_configuration(b"\x11" + stock.data, FirmwareVersion(*release)).layout == stock.layout


@pytest.mark.parametrize(
    "data",
    [b"", b"\x11", b"\x11\x00\x00", b"\x04" + bytes(73), b"\x11" + b"\xff" * 40, b"\x11" + b"\x41" * 40],
)
def test_what_is_no_configuration_is_not_guessed_at(data):
    with pytest.raises(ProtocolError, match="expected"):
        decode_app_configuration(data, FirmwareVersion(5, 2))


@pytest.mark.parametrize(("ms", "amperes"), [(-1, 0.0), (250, -1.0), (250, float("nan")), (10**7, 0.0)])
def test_settings_that_nobody_can_mean(ms, amperes):
    with pytest.raises(ValueError, match="expected a time-out"):
        TimeoutSettings(ms, amperes)


def test_which_settings_are_good_enough():
    wanted = TimeoutSettings(250, 20.0)
    assert TimeoutSettings(200, 30.0).at_least(wanted)
    assert not TimeoutSettings(0, 60.0).at_least(wanted)  # never is not early
    assert not TimeoutSettings(300, 20.0).at_least(wanted)
    assert not TimeoutSettings(250, 10.0).at_least(wanted)
    assert str(TimeoutSettings(0, 5.0)) == "switched off"


@pytest.fixture(params=[(2, 18), (3, 40), (4, 2), (5, 2), (6, 0)])
def link(request):
    config = VescEmulatorConfig(firmware=request.param)
    with VescEmulator(config, TwinVehicle(CarConfig())) as emulator:
        vesc = Vesc(emulator.port, VehicleGains(), DriveLimits())
        vesc.open()
        vesc.identify()
        yield vesc, emulator
        vesc.abandon()


def test_read_set_and_read_back_over_the_wire(link):
    vesc, emulator = link
    assert vesc.read_timeout() == TimeoutSettings(1000, 0.0)
    assert vesc.set_timeout(TimeoutSettings(250, 20.0)) == TimeoutSettings(250, 20.0)
    assert emulator.firmware.timeout == TimeoutSettings(250, 20.0)


def test_a_turning_motor_keeps_its_settings(link):
    vesc, emulator = link
    emulator.vehicle.reset(0.0, 0.0, 0.0, speed_mps=1.0)
    with pytest.raises(ProtocolError, match="at rest"):
        vesc.set_timeout(TimeoutSettings(250, 20.0))
    assert emulator.firmware.timeout == TimeoutSettings(1000, 0.0)


def test_a_controller_that_does_not_tell_its_settings():
    with (
        VescEmulator(VescEmulatorConfig(readable_settings=False), TwinVehicle(CarConfig())) as emulator,
        Vesc(emulator.port, VehicleGains(), DriveLimits()) as vesc,
    ):
        vesc.identify()
        with pytest.raises(LinkTimeout, match="AppConfiguration"):
            vesc.read_timeout(0.05)


def test_a_configuration_of_another_firmware_is_refused(link):
    vesc, emulator = link
    foreign = decode_app_configuration(payload((5, 2)), FirmwareVersion(5, 2))
    vesc._write(foreign.encode_set())
    vesc.read_values()
    assert emulator.firmware.timeout == TimeoutSettings(1000, 0.0)


def test_head_is_where_the_firmware_puts_it():
    data = decode_app_configuration(payload((5, 2)), FirmwareVersion(5, 2)).encode_set()
    assert struct.unpack_from(">BBBIBIf", data) == (2, 25, 16, 0xDEADBEEF, 7, 250, 20.0)
