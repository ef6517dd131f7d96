"""Reads messages of any type by the definition in their bag.

A definition from a foreign bag is treated as data: it gives the order of the fields, and no code is generated from it. The code
generator of ``rosbags``, which `nodes.runtime.messages` uses, only gets the definitions that advnerf ships.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg

from nodes.runtime.errors import MessageError
from nodes.runtime.messages import fields_of, message_class

MSG, IDL = "ros2msg", "ros2idl"
# Name of ROS 1 definitions in MCAP. rosbag2 has no name for them.
_AS_MSG = frozenset({MSG, "ros1msg"})
_MOST_CHARACTERS = 1 << 20
_IDL_PART = re.compile(r"^=+\nIDL: [^\n]*\n", re.MULTILINE)
_NUMBERS = {
    "bool": "?", "byte": "B", "char": "B", "octet": "B", "uint8": "u1", "int8": "i1", "uint16": "u2", "int16": "i2",
    "uint32": "u4", "int32": "i4", "uint64": "u8", "int64": "i8", "float32": "f4", "float64": "f8",
}  # fmt: skip
_PLACEHOLDER = "structure_needs_at_least_one_member"
# Exceptions that the parser of definitions raises for invalid text.
_NO_DEFINITION = (
    TypesysError,
    RecursionError,
    ValueError,
    KeyError,
    IndexError,
    TypeError,
    AttributeError,
    AssertionError,
)

Fields = list[tuple[str, Any]]


def full_type_name(name: str) -> str:
    """Convert a type name to the form of ROS 2: ``sensor_msgs/Image`` of ROS 1 becomes ``sensor_msgs/msg/Image``."""
    package, separator, rest = name.partition("/")
    return f"{package}/msg/{rest}" if separator and "/" not in rest else name


class Definition:
    """The fields of a type and of all types in it, as a bag defines them.

    Args:
        typename: Full type name.
        types: Fields by type name. Missing types are taken from advnerf's own.
    """

    def __init__(self, typename: str, types: Mapping[str, Fields]) -> None:
        self.typename = typename
        self._types = types

    @property
    def begins_with_header(self) -> bool:
        """Whether the first field is a header."""
        fields = self._fields(self.typename)
        return bool(fields) and _type_in(fields[0][1]) == "std_msgs/msg/Header"

    @property
    def is_ours(self) -> bool:
        """Whether advnerf's type with that name has exactly the same fields."""
        return self._same(self.typename, set())

    def missing(self, typename: str, own: str | None = None) -> list[str]:
        """Fields of an advnerf type that this definition lacks, for example ``drive.speed``.

        Args:
            own: The type of this definition to compare with it; None for its main type.
        """
        have = {name.lower(): kind for name, kind in self._fields(own or self.typename)}
        lacking = []
        for name, kind in fields_of(typename) or []:
            if name == _PLACEHOLDER:
                continue
            inner, found = _type_in(kind), have.get(name.lower())
            if found is None:
                lacking.append(name)
            elif inner and _type_in(found):
                lacking += [f"{name}.{rest}" for rest in self.missing(inner, _type_in(found))]
            elif bool(inner) != bool(_type_in(found)):
                lacking.append(name)
        return lacking

    def read(self, data: bytes, ros1: bool = False) -> dict[str, Any]:
        """Decode a message to its fields by lower-case names. Nested messages are dictionaries too.

        Args:
            data: Bytes of the message: CDR with its encapsulation, or the ROS 1 format.
            ros1: Whether the bytes have the ROS 1 format.

        Raises:
            MessageError: The bytes do not decode.
        """
        try:
            reader = _ByteReader(data, ros1)
            found = self._read(self.typename, reader)
            reader.require_end()
        except (struct.error, ValueError, RecursionError, UnicodeDecodeError) as error:
            raise MessageError(
                f"expected {self.typename} in {len(data)} bytes, got bytes that cannot be decoded: {error}"
            ) from error
        return found

    def _fields(self, typename: str) -> Fields:
        if typename in self._types:
            return self._types[typename]
        if (fields := fields_of(typename)) is None:
            raise MessageError(
                f"the definition of {self.typename} needs {typename}, which the bag does not define"
            )
        return fields

    def _same(self, typename: str, seen: set[str]) -> bool:
        if typename in seen:
            return True
        seen.add(typename)
        ours = fields_of(typename)
        if ours is None or ours != self._fields(typename):
            return False
        return all(self._same(inner, seen) for _, kind in ours if (inner := _type_in(kind)))

    def _read(self, typename: str, reader: _ByteReader) -> dict[str, Any]:
        fields = self._fields(typename)
        if not fields and not reader.ros1:
            reader.number("u1")
        return {
            name.lower(): self._value(kind, reader)
            for name, kind in fields
            if name != _PLACEHOLDER or not reader.ros1
        }

    def _value(self, kind: Any, reader: _ByteReader) -> Any:
        node, what = kind
        if node == Nodetype.NAME:
            return self._read(what, reader)
        if node == Nodetype.BASE:
            return reader.text() if what[0] == "string" else reader.number(_number(what[0]))
        element, length = what
        count = length if node == Nodetype.ARRAY else reader.count()
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return reader.numbers(_number(element[1][0]), count)
        reader.require(count)
        return [self._value(element, reader) for _ in range(count)]


@lru_cache(maxsize=256)
def parse_definition(typename: str, text: str, encoding: str) -> Definition:
    """Parse the definition of a type from the text in a bag.

    Args:
        text: Definition of the type and of all types in it.
        encoding: ``ros2msg``, ``ros1msg`` or ``ros2idl``.

    Raises:
        MessageError: The text is not a valid definition.
    """
    types: dict[str, Any] = {}
    try:
        if len(text) > _MOST_CHARACTERS:
            raise ValueError(f"{len(text)} characters, at most {_MOST_CHARACTERS} are read")
        if encoding in _AS_MSG:
            # The parser expects a separator line of exactly 80 characters. Some writers end it with a carriage return.
            types.update(get_types_from_msg(text.replace("\r\n", "\n"), typename))
        elif encoding == IDL:
            for part in _IDL_PART.split(text):
                if part.strip():
                    types.update(get_types_from_idl(part))
        else:
            raise ValueError(f"its language is {encoding!r}; {MSG} and {IDL} are read")
        if typename not in types:
            raise ValueError(f"it defines {', '.join(types) or 'nothing'}")
    except _NO_DEFINITION as error:
        said = " ".join(str(error).split())
        raise MessageError(f"cannot read the definition of {typename}: {said:.120}") from error
    return Definition(typename, {name: list(fields) for name, (_, fields) in types.items()})


def as_our_message(fields: Mapping[str, Any], typename: str) -> Any:
    """Make a message of an advnerf type from the fields of a foreign one, which must have all of them. Further fields are dropped.

    Args:
        fields: Fields by lower-case names, because ROS 1 wrote some in capitals.
    """
    ours = fields_of(typename) or []
    return message_class(typename)(
        **{name: _as_ours(fields.get(name.lower(), 0), kind) for name, kind in ours}
    )


def _as_ours(value: Any, kind: Any) -> Any:
    inner = _type_in(kind)
    if inner and isinstance(value, dict):
        return as_our_message(value, inner)
    if inner and isinstance(value, list):
        return [as_our_message(item, inner) for item in value]
    if isinstance(value, np.ndarray):
        node, what = kind
        if (
            node in (Nodetype.ARRAY, Nodetype.SEQUENCE)
            and what[0][0] == Nodetype.BASE
            and what[0][1][0] != "string"
        ):
            return value.astype(np.dtype(_NUMBERS[what[0][1][0]]).newbyteorder("="), copy=False)
    return value


def _type_in(kind: Any) -> str:
    """Name of the message type of a field or of its array elements; empty for numbers and strings."""
    node, what = kind
    if node == Nodetype.NAME:
        return str(what)
    return "" if node == Nodetype.BASE else _type_in(what[0])


def _number(name: str) -> str:
    if name not in _NUMBERS:
        raise MessageError(f"cannot read fields of type {name}")
    return _NUMBERS[name]


class _ByteReader:
    """Reads values in sequence from the bytes of a message."""

    def __init__(self, data: bytes, ros1: bool) -> None:
        self.ros1 = ros1
        self._order, self._at = "<", 0
        if not ros1:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise ValueError(
                    f"they begin with {bytes(data[:4]).hex()}, not with the encapsulation of CDR"
                )
            self._order = "<" if data[1] else ">"
            data = data[4:]  # alignment counts from after the encapsulation
        self._data = data

    def number(self, code: str) -> Any:
        return self.numbers(code, 1)[0].item()

    def numbers(self, code: str, count: int) -> np.ndarray[Any, Any]:
        dtype = np.dtype(self._order + code if len(code) == 2 else code)
        if count:
            self._align(dtype.itemsize)
        self.require(count * dtype.itemsize)
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += values.nbytes
        return values

    def text(self) -> str:
        length = self.count()
        self.require(length)
        raw = bytes(self._data[self._at : self._at + length])
        self._at += length
        return (raw if self.ros1 else raw.removesuffix(b"\0")).decode()

    def count(self) -> int:
        return int(self.number("u4"))

    def require(self, size: int) -> None:
        """Check that ``size`` bytes are left. Each element has at least one byte, so a damaged count cannot exceed the data."""
        if size > len(self._data) - self._at:
            raise ValueError(f"{size} bytes at byte {self._at} of {len(self._data)}")

    def require_end(self) -> None:
        """Check that at most three bytes are left, because some writers pad to a multiple of four."""
        if len(self._data) - self._at > (0 if self.ros1 else 3):
            raise ValueError(f"they end at byte {self._at} of {len(self._data)}")

    def _align(self, size: int) -> None:
        if not self.ros1:
            self._at += -self._at % size
