import pytest

from hardware.errors import DeviceNotFound, ProtocolError
from hardware.screen.edid import connected_displays, edid_of, make_edid, parse_edid

pytestmark = pytest.mark.live

# Real monitors, from reports of their owners; the data sheet of the U2412M gives an active area of 518.4 x 324.0 mm.
DELL_U2412M = bytes.fromhex(
    "00ffffffffffff0010ac79a0554130331c1b010380342078eaee95a3544c99260f5054a1080081408180a940b300d1c0010101010101283c80a070b023403020"
    "360006442100001a000000ff005950505930373743333041550a000000fc0044454c4c2055323431324d0a20000000fd00323d1e5311000a2020202020200020"
)
DELL_E193FP = bytes.fromhex(
    "00ffffffffffff0010ac0e7000000000180f010368261e782ec665a2594c9d24125054a54b00714f8180010101010101010101010101302a009851002a403070"
    "1300520e1100001e000000ff0047363536363536464c4553410a000000fc0044656c6c204531393346500a20000000fd00384c1e530e000a20202020202000b4"
)


def test_real_monitors_say_what_their_data_sheets_say():
    wide = parse_edid(DELL_U2412M)
    assert (wide.maker, wide.name, wide.size_px, wide.size_mm) == (
        "DEL",
        "DELL U2412M",
        (1920, 1200),
        (518.0, 324.0),
    )
    old = parse_edid(DELL_E193FP)
    assert (old.maker, old.name, old.size_px) == ("DEL", "Dell E193FP", (1280, 1024))
    assert old.size_mm is None  # 338 x 270 mm in its mode, 38 x 30 cm in its head: the panel has 376 x 301


def changed(block, **bytes_at):
    block = bytearray(block)
    for place, value in bytes_at.items():
        block[int(place[1:])] = value
    block[127] = -sum(block[:127]) % 256
    return bytes(block)


def test_a_size_that_contradicts_itself_or_is_missing_is_no_size():
    aspect = changed(DELL_U2412M, b66=160, b67=90, b68=0)  # 160 x 90 "mm", 52 x 32 cm
    assert parse_edid(aspect).size_mm is None
    projector = changed(DELL_U2412M, b21=0, b22=0)
    assert parse_edid(projector).size_mm is None


def test_damage_is_told():
    with pytest.raises(ProtocolError, match="begins with 00ffffffffffff00"):
        parse_edid(b"\0" * 128)
    with pytest.raises(ProtocolError, match="128 bytes"):
        parse_edid(DELL_U2412M[:100])
    damaged = bytearray(DELL_U2412M)
    damaged[60] ^= 4
    with pytest.raises(ProtocolError, match="add up to 0"):
        parse_edid(bytes(damaged))
    with pytest.raises(ProtocolError, match="preferred mode"):
        parse_edid(changed(DELL_U2412M, b54=0, b55=0))


def test_a_made_edid_reads_as_it_was_meant():
    edid = parse_edid(make_edid("ADV", 7, "twin monitor", (3840, 2160), (598, 336)))
    assert (edid.maker, edid.product, edid.name) == ("ADV", 7, "twin monitor")
    assert (edid.size_px, edid.size_mm) == ((3840, 2160), (598.0, 336.0))


def test_connectors_with_a_monitor_are_found_and_others_named(tmp_path):
    for connector, data in {
        "card0-HDMI-A-1": DELL_U2412M,
        "card0-DP-1": b"",
        "card1-DP-2": b"\xff" * 128,
    }.items():
        (tmp_path / connector).mkdir()
        (tmp_path / connector / "edid").write_bytes(data)
    assert list(connected_displays(tmp_path)) == ["HDMI-A-1"]
    assert edid_of("HDMI-A-1", tmp_path).name == "DELL U2412M"
    with pytest.raises(DeviceNotFound, match=r"DP-1, found: HDMI-A-1 \(DELL U2412M\)"):
        edid_of("DP-1", tmp_path)
