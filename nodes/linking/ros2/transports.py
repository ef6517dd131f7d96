"""The two transports of ROS 2 messages: DDS (Cyclone DDS, x86-64 only) and Zenoh (as ``rmw_zenoh_cpp``). Each is imported when chosen."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from nodes.linking.ros2.routes import Endpoint
from nodes.linking.ros2.samples import Heard, Side
from nodes.linking.ros2.zenoh_settings import ZenohSettings
from nodes.runtime.errors import BusError, ConfigError
from nodes.runtime.inbox import Inbox

Transport = Literal["auto", "dds", "zenoh"]
DDS, ZENOH = "dds", "zenoh"
_PACKAGES = {DDS: "cyclonedds", ZENOH: "zenoh"}
_LOOPBACK_FLAG = 0x8


def installed_transports() -> list[str]:
    """The transports that are installed, of ``dds`` and ``zenoh``."""
    return [name for name, package in _PACKAGES.items() if find_spec(package) is not None]


def chosen_transport(transport: Transport) -> str:
    """The transport to use: ``dds`` or ``zenoh``. ``auto`` is DDS where it is installed, else Zenoh; a missing one is a `ConfigError`."""
    wanted = (DDS, ZENOH) if transport == "auto" else (transport,)
    if found := [name for name in installed_transports() if name in wanted]:
        return found[0]
    only_x86 = (
        "; Cyclone DDS has wheels for x86-64 only, 'transport: zenoh' runs on arm64" if DDS in wanted else ""
    )
    raise ConfigError(
        f"expected an installed transport for ROS 2 ({' or '.join(wanted)}), found none; pip install 'advnerf[ros2]'{only_x86}"
    )


def open_transport(
    transport: Transport,
    domain_id: int,
    interface: str,
    settings: ZenohSettings,
    sends: Sequence[Endpoint],
    takes: Sequence[Endpoint],
    inbox: Inbox[list[Heard]],
    watched: Sequence[int] = (),
) -> Side:
    """Join ROS programs.

    Args:
        transport: Name of the transport.
        domain_id: ``ROS_DOMAIN_ID``.
        interface: Network interface.
        settings: Ways to find ROS programs over Zenoh.
        sends: Topics to write.
        takes: Topics to read.
        inbox: Receives batches of samples.
        watched: Numbers of the sent topics beside which no other publisher may exist.
    """
    chosen, local = chosen_transport(transport), is_loopback_interface(interface)
    try:
        if chosen == DDS:
            from nodes.linking.ros2.dds import Participant

            return Participant(domain_id, interface, local, sends, takes, inbox, watched)
        from nodes.linking.ros2.zenoh_session import Session

        return Session(domain_id, interface, local, settings, sends, takes, inbox, watched)
    except ImportError as error:
        raise ConfigError(
            f"the transport {chosen} of ROS 2 cannot be imported ({error}): pip install 'advnerf[ros2]'"
        ) from error


def is_loopback_interface(name: str) -> bool:
    """Whether a network interface is the loopback of this computer. An interface that does not exist is a `BusError`."""
    try:
        flags = int((Path("/sys/class/net") / name / "flags").read_text(), 16)
    except (OSError, ValueError):
        known = ", ".join(sorted(found for _, found in socket.if_nameindex()))
        raise BusError(
            f"expected a network interface of this computer ({known}), got {name!r}; set 'interface'"
        ) from None
    return bool(flags & _LOOPBACK_FLAG)
