"""Tells the publishers of a Zenoh topic apart. Pure.

In Zenoh every program can write to every key. A ROS 2 program announces its publishers by liveliness tokens, and attaches an identity to
each sample. So both are counted: what is announced, and what is heard without being announced.
"""

from __future__ import annotations

from collections import deque

from nodes.linking.ros2.rmw_zenoh import PUBLISHER, Token
from nodes.linking.ros2.routes import Endpoint, dds_name
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import type_hash

_REMEMBERED_S = 2.0
_MOST_UNANNOUNCED = 8
_MOST_FORMER = 64
_NAME_CHARACTERS = 60


class Publishers:
    """The publishers of one topic, other than our own. Not safe for several threads.

    ``rmw_zenoh_cpp`` derives the identity in its samples from the token. Other implementations choose any: the first one that is heard
    while there is one token belongs to that token as long as the token lives.

    Args:
        endpoint: Topic and type.
        own: Our own token on that topic; empty without one.
    """

    def __init__(self, endpoint: Endpoint, own: str = "") -> None:
        self._endpoint, self._own = endpoint, own
        self._type, self._hash = dds_name(endpoint.typename), type_hash(endpoint.typename)
        self._tokens: dict[str, Token] = {}
        self._other: dict[str, Token] = {}
        self._gids: dict[str, str] = {}  # of tokens
        self._unannounced: dict[str, int] = {}
        self._former: deque[str] = deque(maxlen=_MOST_FORMER)

    def announce(self, token: Token) -> None:
        """Note a token that has come."""
        if token.kind != PUBLISHER or token.key == self._own:
            return
        ours = (token.typename, token.type_hash) == (self._type, self._hash)
        (self._tokens if ours else self._other)[token.key] = token

    def withdraw(self, key: str) -> None:
        """Note a token that has gone."""
        self._other.pop(key, None)
        if self._tokens.pop(key, None) is not None and (gid := self._gids.pop(key, "")):
            self._former.append(gid)

    def heard(self, gid: str, mono_ns: int) -> str:
        """Identity of the publisher of a sample.

        Args:
            gid: Identity in the sample's attachment, in hexadecimal; empty if there is no attachment.
            mono_ns: When the sample arrived, monotonic clock [ns].
        """
        if (token := self._of(gid, mono_ns)) is not None:
            self._unannounced.pop(gid, None)  # its first sample may come before its token
            return _identity(token)
        if gid in self._former:
            return gid
        self._expire(mono_ns)
        if gid in self._unannounced or len(self._unannounced) < _MOST_UNANNOUNCED:
            self._unannounced[gid] = mono_ns
        return _unannounced(gid)

    def present(self, mono_ns: int) -> tuple[str, ...]:
        """Identities of the publishers. Without any token there is none: what is not announced never counts alone."""
        return self.all(mono_ns) if self._tokens else ()

    def all(self, mono_ns: int) -> tuple[str, ...]:
        """Identities of the publishers, also if none is announced."""
        self._expire(mono_ns)
        announced = sorted(_identity(token) for token in self._tokens.values())
        return (*announced, *sorted(_unannounced(gid) for gid in self._unannounced))

    def mismatch(self) -> str:
        """Why publishers of this name are not heard; empty if there are none of these."""
        if self._tokens or not self._other:
            return ""
        other = next(iter(self._other.values()))
        name, ours = self._endpoint.ros, self._endpoint.typename
        if other.typename != self._type:
            return f"expected a publisher of {name} with type {ours}, got {other.typename[:100]}; correct the route's 'type'"
        return (
            f"the publisher of {name} has another definition of {ours} ({other.type_hash[:80]}, expected {self._hash});"
            " use the same version of the message package (ROS 2 Humble states none)"
        )

    def _of(self, gid: str, mono_ns: int) -> Token | None:
        """The token to which an identity belongs."""
        for token in self._tokens.values():
            if token.gid == gid:
                if (taken_for_it := self._gids.get(token.key, gid)) != gid:
                    self._unannounced[taken_for_it] = mono_ns
                self._gids[token.key] = gid
                return token
        for key, known in self._gids.items():
            if known == gid:
                return self._tokens[key]
        if gid and gid not in self._former and len(self._tokens) == 1 and not self._gids:
            (token,) = self._tokens.values()
            self._gids[token.key] = gid
            return token
        return None

    def _expire(self, mono_ns: int) -> None:
        oldest_ns = mono_ns - round(_REMEMBERED_S * NS_PER_S)
        self._unannounced = {gid: at for gid, at in self._unannounced.items() if at >= oldest_ns}


def _identity(token: Token) -> str:
    return f"{token.node[:_NAME_CHARACTERS]} {token.gid}"


def _unannounced(gid: str) -> str:
    return f"not announced {gid or 'and without identity'}"
