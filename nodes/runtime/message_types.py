"""Message types of ROS 2 and of advnerf, each made when it is first asked for.

``rosbags`` makes 162 classes when its types of ROS 2 Jazzy are imported, and thirteen functions for each type that is encoded. A node
needs a tenth of the classes and three of the functions, and made none of the others: this was a third of the time of its start.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.serde.cdr import generate_deserialize_cdr, generate_getsize_cdr, generate_serialize_cdr
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.base import normalize_fieldname
from rosbags.typesys.store import Typestore
from rosbags.typesys.stores import empty

MSG_FOLDER = Path(__file__).parent / "msg"
# Copies of the types of ROS 2 Jazzy that nodes use. All others come from rosbags.
_ROS2_FOLDER = Path(__file__).parent / "ros2_msg"


class MessageTypes(Typestore):
    """The types of ROS 2 Jazzy and of ``nodes/runtime/msg``; no other is ever registered.

    Args:
        max_sequence_length: Largest number of elements of a sequence that is decoded.
    """

    def __init__(self, max_sequence_length: int) -> None:
        super().__init__(empty, max_sequence_length=max_sequence_length)
        self._files = {
            file.relative_to(folder).with_suffix("").as_posix(): file
            for folder in (MSG_FOLDER, _ROS2_FOLDER)
            for file in folder.glob("*/msg/*.msg")
        }
        self._lock, self._has_all = threading.RLock(), False

    def find(self, name: str, packages: Sequence[str]) -> str | None:
        """Full name of the type with a short name in the first of some packages; None if there is none."""
        full = [f"{package}/msg/{name}" for package in packages]
        # In this order, because `has` imports all types of ROS 2 for a name that it does not know.
        near = [typename for typename in full if typename in self.types or typename in self._files]
        return next((typename for typename in near or full if self.has(typename)), None)

    def has(self, typename: str) -> bool:
        """Whether a type exists; it can be used afterwards."""
        if typename not in self.types:
            with self._lock:
                self._add(typename)
        return typename in self.types

    def _add(self, typename: str) -> None:
        definitions: dict[str, Any] = {}
        self._read(typename, definitions)
        if definitions:
            self.register(definitions)
        if typename not in self.types and not self._has_all:
            everything = get_typestore(Stores.ROS2_JAZZY)
            self.fielddefs = {**everything.fielddefs, **self.fielddefs}
            self.types = {**everything.types, **self.types}
            self._has_all = True

    def _read(self, typename: str, definitions: dict[str, Any]) -> None:
        """Read the definitions of a type and of all types in it that are not registered."""
        file = self._files.get(typename)
        if file is None or typename in self.types or typename in definitions:
            return
        definitions.update(get_types_from_msg(file.read_text(encoding="utf-8"), typename))
        for _, (kind, content) in definitions[typename][1]:
            if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                kind, content = content[0]
            if kind == Nodetype.NAME:
                self._read(content, definitions)

    def get_msgdef(self, typename: str) -> Any:
        """The functions of a type that encode and decode it."""
        made = self.cache.get(typename)
        if made is None:
            made = self.cache[typename] = _Functions(self, typename)  # type: ignore[assignment]
        return made


class _Functions:
    """What ``rosbags`` calls a ``Msgdef``, without the conversions from and to ROS 1. Each function is made when it is first used."""

    def __init__(self, store: MessageTypes, typename: str) -> None:
        self._store, self.cls = store, store.types[typename]
        self.fields = [(normalize_fieldname(name), kind) for name, kind in store.fielddefs[typename][1]]

    @cached_property
    def _size(self) -> tuple[Any, int]:
        return generate_getsize_cdr(self.fields, self._store)

    @property
    def getsize_cdr(self) -> Any:
        return self._size[0]

    @property
    def size_cdr(self) -> int:
        return self._size[1]

    @cached_property
    def serialize_cdr_le(self) -> Any:
        return generate_serialize_cdr(self.fields, self._store, "le")

    @cached_property
    def serialize_cdr_be(self) -> Any:
        return generate_serialize_cdr(self.fields, self._store, "be")

    @cached_property
    def deserialize_cdr_le(self) -> Any:
        return generate_deserialize_cdr(self.fields, self._store, "le")

    @cached_property
    def deserialize_cdr_be(self) -> Any:
        return generate_deserialize_cdr(self.fields, self._store, "be")
