"""The driver on lines that misbehave, against every firmware and telemetry generation; and a plug that is pulled and put back."""

import random
import time

import pytest

from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.errors import LinkLost, LinkTimeout
from hardware.motor.limits import DriveLimits, VehicleGains
from hardware.motor.vesc import Vesc
from hardware.motor.vesc_codec import FrameDecoder, encode_frame
from hardware.motor.vesc_replies import FirmwareVersion, Values
from tests.support.faulty_devices import FaultyVescEmulator, wire_chunks

pytestmark = pytest.mark.live

# Which telemetry a firmware sends, over the whole range of both.
PAIRS = [
    ("A", (2, 18)),
    ("B", (3, 33)),
    ("C", (3, 38)),
    ("D", (3, 40)),
    ("E", (3, 48)),
    ("F", (5, 2)),
    ("G", (6, 2)),
]
FRAMES = encode_frame(bytes([4, 2, 3, 2, 3])) + encode_frame(bytes(300)) + encode_frame(b"\x00\x05\x02")


def connect(emulator):
    vesc = Vesc(emulator.port, VehicleGains(), DriveLimits())
    vesc.open()
    return vesc


@pytest.mark.parametrize(("generation", "firmware"), PAIRS)
@pytest.mark.parametrize("fault", [None, "dribble", "noise"])
def test_every_generation_gets_through(generation, firmware, fault):
    config = VescEmulatorConfig(generation=generation, firmware=firmware, hardware_name="60", supply_v=15.2)
    with FaultyVescEmulator(config) as emulator:
        emulator.disturb(fault)
        vesc = connect(emulator)
        version = vesc.identify(timeout_s=60.0)
        assert (version.major, version.minor) == firmware
        assert version.hardware_name == ("60" if firmware >= (3, 40) else None)
        values = vesc.read_values(timeout_s=60.0)
        assert (values.generation, values.v_in, values.fault) == (generation, 15.2, 0)
        vesc.abandon()


@pytest.mark.parametrize("fault", ["garbage", "bad_crc", "silent"])
def test_nothing_wrong_is_taken_for_telemetry(fault):
    with FaultyVescEmulator(VescEmulatorConfig()) as emulator:
        vesc = connect(emulator)
        vesc.identify()
        emulator.disturb(fault)
        with pytest.raises(LinkTimeout):
            vesc.read_values(timeout_s=0.1)
        assert (vesc.skipped_bytes > 0) is (fault != "silent")
        emulator.disturb(None)
        assert _heard_again(vesc)
        vesc.abandon()


def _heard_again(vesc):
    # A false start byte can hold back up to 512 bytes; the polls that follow push them through.
    for _ in range(20):
        try:
            return vesc.read_values(timeout_s=0.05)
        except LinkTimeout:
            continue
    return None


def test_unplugged_and_plugged_in_again(tmp_path):
    link = tmp_path / "vesc"
    with FaultyVescEmulator(VescEmulatorConfig(timeout_ms=100.0), link=link) as emulator:
        vesc = Vesc(str(link), VehicleGains(), DriveLimits())
        vesc.open()
        vesc.drive(0.5, 0.0)
        vesc.identify()
        emulator.hang_up()
        with pytest.raises(LinkLost, match="USB"):
            vesc.receive()
        vesc.abandon()
        emulator.advance(0.01, time.monotonic_ns() + 10**9)
        assert emulator.firmware.timed_out  # the firmware lives on without the plug
        emulator.plug_in()
        emulator.plug_in()  # twice does no harm
        vesc.open()
        assert vesc.identify().hardware_name == "TWIN"
        vesc.abandon()


def test_unknown_fault():
    with (
        FaultyVescEmulator(VescEmulatorConfig()) as emulator,
        pytest.raises(ValueError, match=r"expected a fault of dribble.*got 'rust'"),
    ):
        emulator.disturb("rust")


@pytest.mark.parametrize("fault", [None, "dribble", "noise"])
@pytest.mark.parametrize("seed", range(5))
def test_decoder_finds_every_frame_of_a_bad_line(fault, seed):
    decoder, found = FrameDecoder(), []
    chunks = wire_chunks(FRAMES, fault, random.Random(seed))
    for chunk in chunks:
        found += decoder.feed(chunk)
    found += decoder.give_up()
    assert not decoder.pending
    assert [p for p in found if len(p) in (5, 300, 3) and p[0] in (0, 4)] == [
        bytes([4, 2, 3, 2, 3]),
        bytes(300),
        b"\x00\x05\x02",
    ]


def test_a_wrong_sum_costs_every_frame_of_a_reply():
    assert FrameDecoder().feed(b"".join(wire_chunks(FRAMES, "bad_crc", random.Random(0)))) == []
    assert FrameDecoder().feed(FRAMES) != []


def test_replies_are_told_apart_by_what_they_are():
    with FaultyVescEmulator(VescEmulatorConfig()) as emulator:
        vesc = connect(emulator)
        vesc.identify()
        vesc.request_values()
        vesc.request_app_configuration()
        replies, deadline = [], time.monotonic() + 60.0
        while len(replies) < 2 and time.monotonic() < deadline:
            replies += vesc.receive()
        assert isinstance(replies[0], Values)
        assert replies[1].timeout.timeout_ms == 1000
        assert vesc.firmware == FirmwareVersion(5, 2, "TWIN", b"advnerf-twin")
        vesc.abandon()
