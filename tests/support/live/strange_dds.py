"""A stranger's place on a DDS domain, with Cyclone DDS alone."""

from __future__ import annotations

from typing import Any

from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl import types as idl
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from nodes.linking.ros2.dds import domain_config
from nodes.linking.ros2.idl import bytes_type, dds_topic
from nodes.linking.ros2.routes import dds_name
from nodes.runtime.messages import type_hash


class StrangeDds:
    """A participant of a stranger; everything it opened leaves with it."""

    domains: dict[int, Any] = {}  # noqa: RUF012 - one of each for the process

    def __init__(self, domain_id: int) -> None:
        if domain_id not in self.domains:
            self.domains[domain_id] = Domain(domain_id, domain_config("lo", local=True))
        self._participant = DomainParticipant(domain_id)

    def writer(
        self, ros: str, typename: str, reliable: bool = True, stated_hash: str | None = None
    ) -> _Writer:
        """Open a writer with ROS 2's conventions."""
        stated = type_hash(typename) if stated_hash is None else stated_hash
        return _Writer(self._open(ros, bytes_type(typename), _qos(reliable, stated)))

    def junk_writer(self, ros: str, typename: str, size: int) -> _Writer:
        """Open a writer of the type's name whose content is any ``size`` bytes."""
        return _Writer(self._open(ros, _junk_type(typename, size), _qos(True, "")))

    def reader(self, ros: str, typename: str, reliable: bool = False) -> _Reader:
        """Open a reader with ROS 2's conventions."""
        topic = Topic(self._participant, dds_topic(ros), bytes_type(typename))
        return _Reader(DataReader(self._participant, topic, qos=_qos(reliable, type_hash(typename))))

    def close(self) -> None:
        """Leave the domain."""
        del self._participant

    def _open(self, ros: str, kind: Any, qos: Any) -> Any:
        return DataWriter(self._participant, Topic(self._participant, dds_topic(ros), kind), qos=qos)


class _Writer:
    def __init__(self, writer: Any) -> None:
        self._writer = writer

    def put(self, cdr: bytes) -> None:
        """Write bytes; a full queue is no reason to stop."""
        try:
            self._writer.write(self._writer.data_type(cdr))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise


class _Reader:
    def __init__(self, reader: Any) -> None:
        self._reader = reader

    def take(self, most: int) -> list[bytes]:
        """Take the bytes that have arrived."""
        return [sample.cdr for sample in self._reader.take(most)]


def _qos(reliable: bool, stated: str) -> Any:
    """QoS of a ROS 2 program that states the hash of its type."""
    return Qos(
        Policy.Reliability.Reliable(0) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(5),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash={stated};".encode()),
    )


def _junk_type(typename: str, size: int) -> Any:
    made: Any = make_idl_struct(
        "Junk",
        dds_name(typename),
        {"junk": idl.array.__class_getitem__((idl.byte, size))},
        dataclassify=False,
    )

    def take_bytes(sample: Any, cdr: bytes) -> None:
        sample.cdr = cdr

    made.__init__ = take_bytes
    made.serialize = lambda sample, *_, **__: sample.cdr
    return made
