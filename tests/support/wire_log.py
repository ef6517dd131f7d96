"""Reads the log of an emulated motor controller: what came over the wire, and how the car moved."""

from pathlib import Path

from hardware.emulators.vesc_firmware import WireEvent


def read_wire_log(path: Path, offset: int = 0) -> list[tuple[WireEvent, float, float]]:
    """Events of a log file, each with the car's speed [m/s] and odometer [m] at that moment.

    Args:
        offset: Start in the file [bytes]; an earlier size of the file gives the newer part. Lines cut short are left out.
    """
    with path.open("rb") as log:
        log.seek(offset)
        text = log.read().decode("ascii")
    rows = []
    for line in text.splitlines(keepends=True):
        fields = line.rstrip("\n").split(",")
        if not line.endswith("\n") or len(fields) != 5 or not fields[0].isdigit():
            continue
        event = WireEvent(int(fields[0]), fields[1], float(fields[2]) if fields[2] else None)
        rows.append((event, float(fields[3]), float(fields[4])))
    return rows
