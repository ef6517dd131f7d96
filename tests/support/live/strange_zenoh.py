"""A stranger's place in a Zenoh network, with ``zenoh`` alone: keys, tokens and attachments are written out here once more."""

from __future__ import annotations

import json
import os
import secrets
import time
from collections.abc import Callable
from typing import Any

import zenoh
from zenoh.ext import Int64, z_serialize

from nodes.runtime.messages import type_hash
from tests.support.live.zenoh_router import ENDPOINT


class StrangeZenoh:
    """A session of a stranger."""

    def __init__(self, domain_id: int) -> None:
        self._domain = domain_id
        self.session = zenoh.open(config("peer", connect=[os.environ[ENDPOINT]]))

    def writer(
        self,
        ros: str,
        typename: str,
        reliable: bool = True,
        stated_hash: str | None = None,
        announced: bool = True,
        attachment: Callable[[int], bytes] | None = None,
    ) -> _Writer:
        """Open a publisher with the conventions of ``rmw_zenoh``, or without some of them."""
        kind, stated = _dds(typename), stated_hash or type_hash(typename)
        token = self._token("MP", ros, kind, stated, "" if reliable else "2") if announced else None
        publisher = self.session.declare_publisher(f"{self._domain}{ros}/{kind}/{stated}")
        return _Writer(publisher, token, attachment or _attachments())

    def junk_writer(self, ros: str, typename: str, size: int) -> _Writer:
        """Open a publisher for any bytes."""
        del size
        return self.writer(ros, typename)

    def reader(self, ros: str, typename: str, reliable: bool = False) -> _Reader:
        """Open a subscription with the conventions of ``rmw_zenoh``."""
        kind, stated = _dds(typename), type_hash(typename)
        token = self._token("MS", ros, kind, stated, "" if reliable else "2")
        key = f"{self._domain}{ros}/{kind}/{stated}"
        return _Reader(self.session.declare_subscriber(key, zenoh.handlers.RingChannel(5)), token)

    def close(self) -> None:
        """Leave the network."""
        self.session.close()

    def _token(self, what: str, ros: str, kind: str, stated: str, reliability: str) -> Any:
        me, number = self.session.info.zid(), secrets.randbelow(10**6)
        where = f"@ros2_lv/{self._domain}/{me}/0/{number}/{what}/%/%/stranger/{ros.replace('/', '%')}"
        return self.session.liveliness().declare_token(f"{where}/{kind}/{stated}/{reliability}::,5:,:,:,,")


class _Writer:
    def __init__(self, publisher: Any, token: Any, attachment: Callable[[int], bytes]) -> None:
        self._publisher, self._token, self._attachment, self._count = publisher, token, attachment, 0

    def put(self, cdr: bytes) -> None:
        """Write bytes."""
        self._count += 1
        self._publisher.put(cdr, attachment=self._attachment(self._count))


class _Reader:
    def __init__(self, subscriber: Any, token: Any) -> None:
        self._subscriber, self._token = subscriber, token

    def take(self, most: int) -> list[bytes]:
        """Take the bytes that have arrived."""
        found: list[bytes] = []
        while len(found) < most and (sample := self._subscriber.try_recv()) is not None:
            found.append(sample.payload.to_bytes())
        return found


def config(mode: str, connect: list[str] | None = None, listen: list[str] | None = None) -> Any:
    """Configuration of a session on this computer."""
    return made(
        {
            "mode": mode,
            "connect/endpoints": connect or [],
            "listen/endpoints": listen or ["tcp/localhost:0"],
            "scouting/multicast/enabled": False,
            "timestamping/enabled": True,
        }
    )


def made(values: dict[str, Any]) -> Any:
    """Configuration with some values, by key."""
    found = zenoh.Config()
    for key, value in values.items():
        found.insert_json5(key, json.dumps(value))
    return found


def _dds(typename: str) -> str:
    package, kind, name = typename.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def _attachments() -> Callable[[int], bytes]:
    gid = secrets.token_bytes(16)
    return lambda count: z_serialize((Int64(count), Int64(time.time_ns()), gid)).to_bytes()
