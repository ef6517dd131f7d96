"""Motion-capture checks: whether the stream arrives on the configured port, with the configured subjects."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Sequence

import numpy as np

from advnerf_core.geometry import Array
from hardware.errors import DeviceBusy, ProtocolError
from hardware.mocap.vicon import DEFAULT_PORT, ViconConfig, ViconReceiver
from hardware.mocap.vicon_codec import decode_block
from nodes.lab.doctor.check import ABSENT, FAILURE, OK, WARNING, CheckResult, report

LISTEN_S = 1.5
_NAME = "VICON"
_NEAR_ORIGIN_M = 0.02
_CURE = "in Tracker, enable System > UDP Object Stream to this computer's address; firewall: sudo ufw allow {port}/udp"


def free_port(port: int = DEFAULT_PORT, host: str = "") -> list[CheckResult]:
    """Check that no other program uses the port."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((host, port))
        except OSError as error:
            do = f"stop the program that uses it (sudo ss -ulpn 'sport = {port}'), or choose another port here and in Tracker"
            if error.errno == errno.EADDRNOTAVAIL:
                do = "give an address of this computer, or 0.0.0.0 for all"
            return report(_NAME, FAILURE, f"UDP {host or '*'}:{port}: {error.strerror}", do)
    return report(_NAME, OK, f"UDP {port} is free")


def listen(
    config: ViconConfig,
    required: bool = False,
    listen_s: float = LISTEN_S,
    needed: Sequence[str] | None = None,
) -> list[CheckResult]:
    """Listen to the stream for a moment, and check datagrams, senders, subjects and rates.

    Args:
        config: Configuration of the receiver. Without subjects, all are checked.
        required: Whether a missing stream is a failure.
        needed: Subjects whose absence is a failure; None means all configured subjects.
    """
    try:
        if not config.subjects:
            config = ViconConfig(_names(config, listen_s / 3), config.host, config.port, source=config.source)
        with ViconReceiver(config) as receiver:
            seen: dict[str, list[Array]] = {name: [] for name in config.subjects}
            deadline = time.monotonic() + listen_s
            while (left_s := deadline - time.monotonic()) > 0.0:
                for pose in receiver.read(left_s):
                    seen[pose.name].append(pose.T_world_from_subject[:3, 3])
            counts = receiver.counts
    except DeviceBusy:
        return free_port(config.port, config.host)
    where = f"UDP {config.host or '*'}:{config.port}"
    if not counts.datagrams:
        text = f"no datagram on {where} within {listen_s:g} s"
        return report(_NAME, FAILURE if required else ABSENT, text, _CURE.format(port=config.port))
    rate_hz = counts.datagrams / listen_s
    rows = report(_NAME, OK, f"{rate_hz:.0f} datagrams a second on {where}")
    if counts.refused:
        do = "find the other sender, or set vicon.source to Tracker's address"
        rows = report(
            _NAME, WARNING, f"{counts.refused} of {counts.datagrams} datagrams are not Tracker's", do
        )
    return rows + [
        _subject(name, places, listen_s, required and name in (needed or config.subjects))
        for name, places in seen.items()
    ]


def _subject(name: str, places_m: Sequence[Array], listen_s: float, required: bool) -> CheckResult:
    if places_m:
        x_m, y_m, z_m = np.round(places_m[-1], 3) + 0.0  # without a minus before a zero
        text = f"{name}: {len(places_m) / listen_s:.0f} poses a second, at x {x_m:.3f}, y {y_m:.3f}, z {z_m:.3f} m"
        if max(abs(x_m), abs(y_m), abs(z_m)) < _NEAR_ORIGIN_M:
            do = "measure where it stands: a stream in metres, where Tracker sends mm, puts everything there, and inside every fence"
            return CheckResult(_NAME, WARNING, text, do)
        return CheckResult(_NAME, OK, text)
    do = "check the subject's name, tick mark and markers in Tracker"
    return CheckResult(_NAME, FAILURE if required else WARNING, f"{name} is not seen", do)


def _names(config: ViconConfig, listen_s: float) -> tuple[str, ...]:
    """Names of the subjects in the stream."""
    names: set[str] = set()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((config.host, config.port))
        except OSError as error:
            raise DeviceBusy(str(error)) from error
        deadline = time.monotonic() + listen_s
        while (left_s := deadline - time.monotonic()) > 0.0:
            probe.settimeout(left_s)
            try:
                names |= {item.name for item in decode_block(probe.recv(4096)).objects}
            except TimeoutError:
                break
            except ProtocolError:
                continue
    return tuple(sorted(names))
