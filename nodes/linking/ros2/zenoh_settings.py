"""Configuration of a Zenoh session, as ``rmw_zenoh_cpp`` has it. Pure, apart from a look at this computer's open ports.

On the loopback interface Zenoh's access control denies every message of a link to another computer, in both directions.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from advnerf_core.strict import StrictModel
from nodes.linking.keys import is_loopback
from nodes.linking.sockets import MOST_BYTES
from nodes.runtime.errors import SecurityError

ROUTER = "tcp/localhost:7447"
_ENDPOINT = re.compile(r"tcp/(\[[0-9a-fA-F:]+\]|[A-Za-z0-9_.\-]+):\d{1,5}")
_LISTENING = "0A"
_LOOPBACKS = ("0100007F", "00000000000000000000000001000000", "0000000000000000FFFF00000100007F")
_MESSAGES = (
    "put", "delete", "query", "reply", "declare_subscriber", "declare_queryable", "liveliness_token", "liveliness_query",
    "declare_liveliness_subscriber",
)  # fmt: skip


class ZenohSettings(StrictModel):
    """How the node finds ROS programs over Zenoh. The defaults equal ``rmw_zenoh_cpp``'s.

    Attributes:
        router: Be the Zenoh router of this computer, instead of a running ``rmw_zenohd``.
        connect: Endpoints of the router, or of other programs if there is no router. None: the router of this computer.
        listen: Endpoints on which other programs reach this node. None: any free port of this computer, or the port of a router.
        multicast: Also look for programs by multicast, so that none needs a router.
    """

    router: bool = False
    connect: tuple[str, ...] | None = None
    listen: tuple[str, ...] | None = Field(default=None, min_length=1)
    multicast: bool = False

    @field_validator("connect", "listen")
    @classmethod
    def _are_endpoints(cls, endpoints: tuple[str, ...] | None) -> tuple[str, ...] | None:
        for endpoint in endpoints or ():
            if not _ENDPOINT.fullmatch(endpoint):
                raise ValueError(f"expected endpoints such as {ROUTER}")
        return endpoints

    @property
    def connects(self) -> tuple[str, ...]:
        """Endpoints to connect to."""
        if self.connect is not None:
            return self.connect
        return () if self.router or self.multicast else (ROUTER,)

    @property
    def listens(self) -> tuple[str, ...]:
        """Endpoints to listen on."""
        return self.listen or ((ROUTER,) if self.router else ("tcp/localhost:0",))


def session_config(settings: ZenohSettings, interface: str, local: bool) -> dict[str, Any]:
    """Configuration of a session, by key.

    Args:
        settings: Ways to find ROS programs.
        interface: Network interface for multicast.
        local: Whether that is the loopback of this computer. Then an endpoint elsewhere is a `SecurityError`.
    """
    if local:
        _require_loopback((*settings.connects, *settings.listens))
    found: dict[str, Any] = {
        "mode": "router" if settings.router else "peer",
        "connect/endpoints": settings.connects,
        "listen/endpoints": settings.listens,
        "scouting/multicast/enabled": settings.multicast,
        "scouting/multicast/interface": interface,
        # The caches of transient-local ROS programs need time stamps.
        "timestamping/enabled": True,
    }
    if not settings.router:  # which passes on the messages of others, too
        found["transport/link/rx/max_message_size"] = MOST_BYTES
    if local:
        found["access_control"] = _only_on(interface)
    return found


def require_local_router(settings: ZenohSettings) -> None:
    """Raise a `SecurityError` if a router on this computer lets other computers reach this node."""
    for endpoint in settings.connects:
        if open_to_others(address_of(endpoint)[1]):
            raise SecurityError(
                f"the Zenoh router at {endpoint} accepts connections from other computers, and would pass on what they say."
                " Restart it with ZENOH_CONFIG_OVERRIDE='listen/endpoints=[\"tcp/localhost:7447\"]' ros2 run rmw_zenoh_cpp rmw_zenohd,"
                " or end it and set zenoh.router: true, or set another interface and open_to_network: true"
            )


def open_to_others(port: int, folder: Path = Path("/proc/net")) -> bool:
    """Whether a TCP port of this computer accepts connections on an address other than the loopback's."""
    for table in ("tcp", "tcp6"):
        file = folder / table
        lines = file.read_text().splitlines()[1:] if file.exists() else []
        for _, local, _, state, *_ in map(str.split, lines):
            address, _, found = local.partition(":")
            if state == _LISTENING and int(found, 16) == port and address not in _LOOPBACKS:
                return True
    return False


def address_of(endpoint: str) -> tuple[str, int]:
    """Host and port of an endpoint."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    return host.strip("[]"), int(port)


def _require_loopback(endpoints: tuple[str, ...]) -> None:
    for endpoint in endpoints:
        if not is_loopback(address_of(endpoint)[0]):
            raise SecurityError(
                f"{endpoint} is not on this computer, but interface is a loopback; set the interface of that network and"
                " open_to_network: true, or use localhost"
            )


def _only_on(interface: str) -> dict[str, Any]:
    # `**` does not match a chunk that begins with @.
    rule = {
        "id": "all",
        "messages": _MESSAGES,
        "flows": ("ingress", "egress"),
        "permission": "allow",
        "key_exprs": ("**", "@ros2_lv/**"),
    }
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [rule],
        "subjects": [{"id": "here", "interfaces": [interface]}],
        "policies": [{"rules": ["all"], "subjects": ["here"]}],
    }
