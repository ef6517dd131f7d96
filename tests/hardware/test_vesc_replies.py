"""VESC replies against the offsets published for each firmware generation."""

import struct

import pytest

from hardware.errors import ProtocolError
from hardware.motor.vesc_replies import (
    FAULT_NAMES,
    LAYOUTS,
    FirmwareVersion,
    Values,
    decode_firmware_version,
    decode_values,
    encode_firmware_version,
    encode_values,
)

pytestmark = pytest.mark.live

LENGTHS = {"A": 56, "B": 54, "C": 58, "D": 59, "E": 65, "F": 73, "G": 74}
# Offsets of (erpm, v_in, tachometer, fault) in the payload, from the firmware sources.
OFFSETS = {"A": (25, 29, 47, 55), **dict.fromkeys("BCDEFG", (23, 27, 45, 53))}


def put(length, offsets, erpm, decivolts, tachometer, fault):
    payload = bytearray(length)
    payload[0] = 4
    for code, offset, value in zip("ihiB", offsets, (erpm, decivolts, tachometer, fault), strict=True):
        struct.pack_into(">" + code, payload, offset, value)
    return bytes(payload)


@pytest.mark.parametrize("generation", sorted(LAYOUTS))
def test_offsets_of_every_generation(generation):
    payload = put(LENGTHS[generation], OFFSETS[generation], -3691, 152, -70000, 4)
    values = decode_values(payload)
    assert values.generation == generation
    assert (values.erpm, values.v_in, values.tachometer, values.fault) == (-3691, 15.2, -70000, 4)
    assert values.fault_name == "over current"
    assert encode_values(values) == payload


def test_last_fields_of_the_newest_generation():
    payload = bytearray(put(74, OFFSETS["G"], 0, 0, 0, 0))
    payload[58] = 77
    struct.pack_into(">i", payload, 69, -1500)
    payload[73] = 1
    values = decode_values(bytes(payload))
    assert (values.controller_id, values.vq_v, values.status) == (77, -1.5, 1)


def test_first_fields_of_the_oldest_generation():
    payload = bytearray(56)
    payload[0] = 4
    struct.pack_into(">h", payload, 13, 315)
    struct.pack_into(">i", payload, 15, -1234)
    struct.pack_into(">h", payload, 23, -250)
    values = decode_values(bytes(payload))
    assert (values.temp_pcb_c, values.motor_current_a, values.duty) == (31.5, -12.34, -0.25)
    assert values.temp_fet_c is None


@pytest.mark.parametrize("length", [1, 53, 55, 57, 60, 72, 75, 80])
def test_other_lengths_are_refused(length):
    with pytest.raises(ProtocolError, match=f"with {length} bytes"):
        decode_values(b"\x04" + bytes(length - 1))


def test_unknown_fault_is_a_fault():
    values = decode_values(put(73, OFFSETS["F"], 0, 0, 0, 34))
    assert values.fault == 34
    assert values.fault_name == "code 34"


def test_every_fault_of_the_firmware_has_a_name():
    assert sorted(FAULT_NAMES) == list(range(34))
    assert len(set(FAULT_NAMES.values())) == 34
    names = {19: "brake hardware", 22: "resolver loss of signal", 27: "phase filter", 30: "encoder slipped"}
    assert {code: decode_values(put(73, OFFSETS["F"], 0, 0, 0, code)).fault_name for code in names} == names


def test_short_version_reply():
    assert decode_firmware_version(bytes.fromhex("00 03 28")) == FirmwareVersion(3, 40)


@pytest.mark.parametrize("release", [(3, 40), (4, 2), (5, 2), (5, 3), (6, 0), (7, 1)])
def test_version_replies_grow_and_are_read_by_their_front(release):
    version = FirmwareVersion(*release, "60_MK5", bytes(range(12)))
    payload = encode_firmware_version(version)
    assert payload.startswith(bytes([0, *release]) + b"60_MK5\0" + bytes(range(12)))
    assert decode_firmware_version(payload + b"\x01\x02\x03") == version


def test_version_2_18_says_two_numbers():
    assert encode_firmware_version(FirmwareVersion(2, 18, "410")) == b"\x00\x02\x12"


@pytest.mark.parametrize("payload", [b"", b"\x00\x05", b"\x04\x05\x02"])
def test_not_a_version_reply(payload):
    with pytest.raises(ProtocolError, match="FW_VERSION"):
        decode_firmware_version(payload)


def test_values_round_trip():
    values = Values(
        "F", 100, 0.5, 12.0, 1.5, 0.5, 6, 6, 0, 0.0, 0.0, 0.0, 0.0, temp_fet_c=30.0, controller_id=3
    )
    again = decode_values(encode_values(values))
    assert (again.erpm, again.duty, again.temp_fet_c, again.controller_id) == (100, 0.5, 30.0, 3)


@pytest.mark.parametrize(
    ("temperatures", "hottest"),
    [({"temp_fet_c": 40.0}, 40.0), ({"temp_mos1_c": 85.3, "temp_mos6_c": 31.0}, 85.3), ({}, None)],
)
def test_the_hottest_mosfet_is_of_one_sensor_or_of_six(temperatures, hottest):
    """Firmware up to 3.00 has six; its temperature had been published as 0."""
    values = Values("A", *[0.0] * 5, 0, 0, 0, *[0.0] * 4, **temperatures)
    assert values.hottest_fet_c == hottest
