"""Connecting to a CARLA server and checking that it is reachable, has the right version and map, and has no other client."""

from __future__ import annotations

import socket
from typing import Any

from hardware.worlds.carla.config import ServerConfig
from hardware.worlds.carla.errors import CarlaBusy, CarlaMapError, CarlaUnreachable, CarlaVersionMismatch
from hardware.worlds.carla.library import server_answers

_PROBE_S = 3.0
_LISTED = 12


def connect(server: ServerConfig, library: Any) -> Any:
    """A ``carla.Client`` of a server that answers and has the client library's version.

    Raises:
        CarlaUnreachable: Nothing listens there, or the listener does not answer as CARLA does.
        CarlaVersionMismatch: The server has another version.
    """
    where = f"{server.host}:{server.port}"
    # The library takes its whole time-out to notice that nothing listens; a plain socket knows at once, and why.
    try:
        socket.create_connection((server.host, server.port), min(_PROBE_S, server.timeout_s)).close()
    except OSError as error:
        raise CarlaUnreachable(
            f"expected a CARLA server at {where}, got: {error}; start one (./CarlaUE4.sh -RenderOffScreen -carla-rpc-port="
            f"{server.port}), let ports {server.port} and {server.port + 1} through its firewall, or name another host or port"
        ) from error
    client = library.Client(server.host, server.port)
    client.set_timeout(server.timeout_s)
    try:
        found = str(client.get_server_version())
    except RuntimeError as error:
        raise CarlaUnreachable(
            f"expected a CARLA server at {where}, something listens there but does not answer as one within {server.timeout_s:g} s "
            f"({error}); is it another program, a server that is still loading, or one whose synchronous client was killed?"
        ) from error
    check_versions(found, str(client.get_client_version()), where)
    return client


def check_versions(server: str, client: str, where: str) -> None:
    """Raise `CarlaVersionMismatch` unless the releases are equal; a build suffix after a dash is ignored."""
    if server.split("-")[0] != client.split("-")[0]:
        raise CarlaVersionMismatch(
            f"expected CARLA {client} at {where}, as the client library is, got {server}: start that version of the server, or "
            f"`pip install carla=={server.split('-')[0]}`"
        )


def map_name(path: str) -> str:
    """The short name of a map: ``Town02`` for ``/Game/Carla/Maps/Town02``."""
    return path.rsplit("/", 1)[-1]


def open_world(client: Any, server: ServerConfig) -> Any:
    """The world of the wanted map.

    Raises:
        CarlaMapError: Another map is loaded and may not be replaced, or the server does not have the requested one.
        CarlaUnreachable: The server did not answer in time.
    """
    with server_answers(f"opening its world at {server.host}:{server.port}"):
        world = client.get_world()
        loaded = map_name(world.get_map().name)
        if server.town is None or loaded == server.town:
            return world
        if not server.load_town:
            raise CarlaMapError(
                f"expected the map {server.town}, got {loaded}; set server.load_town, or server.town to {loaded} or null"
            )
        names = sorted({map_name(path) for path in client.get_available_maps()})
        if server.town not in names:
            shown = ", ".join(names[:_LISTED]) + (", ..." if len(names) > _LISTED else "")
            raise CarlaMapError(f"expected the map {server.town} on the server, which has {shown or 'none'}")
        client.set_timeout(server.load_timeout_s)
        try:
            return client.load_world(server.town)
        finally:
            client.set_timeout(server.timeout_s)


def check_nobody_else(world: Any, server: ServerConfig) -> None:
    """Raise `CarlaBusy` if another client controls the world, or if other actors would be in the pictures."""
    if world.get_settings().synchronous_mode and not server.take_over:
        raise CarlaBusy(
            "expected a world that ticks by itself, got a synchronous one: another client drives it, or one was killed and could not "
            "put it back; end that client, run `advnerf scene carla release`, or set server.take_over"
        )
    if server.allow_traffic:
        return
    actors = world.get_actors()
    others = [actor for kind in ("vehicle.*", "walker.pedestrian.*") for actor in actors.filter(kind)]
    if others:
        kinds = ", ".join(sorted({actor.type_id for actor in others})[:3])
        raise CarlaBusy(
            f"expected an empty world, got {len(others)} vehicles or walkers ({kinds}), which would be in the pictures; remove them, "
            "load the map again, or set server.allow_traffic"
        )
