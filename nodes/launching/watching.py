"""Queries about the topics of a running launch: their list, rates and messages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from nodes.launching.launched import read_launched
from nodes.launching.running import active_launches, has_ended, is_running
from nodes.runtime.bus import Bus, Received
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import LaunchError, MessageError
from nodes.runtime.messages import stamp_ns
from nodes.runtime.paths import RESOLVED_NAME, bus_folder
from nodes.runtime.topics import STATUS_PREFIX, TOPICS, status_topic
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.twin_port import is_twin

_SENT = "/motor/sent"
_STATUS_WAIT_S = _REPORT_WAIT_S = 1.0
_ECHO_ITEMS = 12


@dataclass(frozen=True)
class TopicRow:
    """A topic of a running launch."""

    name: str
    type: str
    publisher: str
    subscribers: int


@dataclass(frozen=True)
class Delay:
    """Percentiles of one delay [s]."""

    median_s: float
    p99_s: float
    worst_s: float


@dataclass(frozen=True)
class RateReport:
    """Rate and delays of a topic over a period.

    Attributes:
        messages: Number of received messages.
        lost: Number of messages that were lost on the way.
        shortest_s: Shortest time between two messages [s].
        longest_s: Longest time between two messages [s].
        capture_to_publish: From the stamp in the header to publication, in real time; None without a header.
        publish_to_receive: From publication to reception here.
        capture_to_receive: Age of the stamp at reception, in real time; None without a header.
    """

    messages: int
    lost: int
    rate_hz: float
    shortest_s: float
    longest_s: float
    capture_to_publish: Delay | None
    publish_to_receive: Delay
    capture_to_receive: Delay | None


def find_run_dir(given: Path | None) -> Path:
    """Return the given run folder, or the only running launch's.

    Raises:
        LaunchError: There is none, more than one, or the given one is of a launch that has ended.
    """
    if given is not None:
        if not given.is_dir():
            raise LaunchError(f"expected a run folder at {given}, found none; correct --folder")
        if (given / RESOLVED_NAME).exists():
            require_running(given)
        return given
    launches = active_launches()
    if not launches:
        raise LaunchError(
            "expected a running launch, found none; start one with advnerf launch FILE, or give the folder of a run with --folder"
        )
    if len(launches) > 1:
        found = ", ".join(str(launch["run_dir"]) for launch in launches)
        raise LaunchError(
            f"expected one running launch, found {len(launches)} ({found}); select one with --folder"
        )
    return Path(launches[0]["run_dir"])


def require_running(run_dir: Path) -> None:
    """Raise `LaunchError` if no node of this host is left in a run folder. Without its gateway, those of another are out of reach."""
    if has_ended(run_dir):
        raise LaunchError(
            f"expected a running launch in {run_dir}, but all of its nodes have ended; start it with advnerf launch"
        )


def describe_car(run_dir: Path) -> str:
    """Describe the car that a launch drives. Whether one on another host is real is known from what its motor node reports."""
    launched = read_launched(run_dir)
    if _SENT not in launched.relayed:
        return launched.car(run_dir)
    reported = (str(each.message().peer) for each in listen(run_dir, _SENT, _REPORT_WAIT_S))
    if not (peer := next(filter(None, reported), "")):
        return f"the car at {launched.address}, whose motor node does not report; it may be REAL"
    return f"{'the simulated' if is_twin(peer) else 'a REAL'} car at {launched.address}, {peer}"


def node_names(run_dir: Path) -> list[str]:
    """Names of the nodes that have, or had, a socket in a run folder, and of the nodes of its running launch."""
    prefix = status_topic("x")[:-1].strip("/").replace("/", ".")
    sockets = (path.name for path in bus_folder(run_dir).iterdir() if path.suffix != ".lock")
    names = {name.removeprefix(prefix + ".") for name in sockets if name.startswith(prefix + ".")}
    return sorted(names | set(_launched(run_dir)))


def _launched(run_dir: Path) -> tuple[str, ...]:
    """Names of the nodes of the launch that is running in a run folder."""
    return read_launched(run_dir).nodes if is_running(run_dir) else ()


def node_statuses(run_dir: Path) -> dict[str, Any]:
    """Last status of every node that reports in time; None for a silent node."""
    names = node_names(run_dir)
    statuses: dict[str, Any] = dict.fromkeys(names)
    with Bus(run_dir) as bus:
        for name in names:
            bus.subscribe(status_topic(name))
        deadline = time.monotonic() + _STATUS_WAIT_S
        while None in statuses.values() and (left := deadline - time.monotonic()) > 0:
            bus.wait(left)
            for received in bus.receive():
                statuses[received.topic.removeprefix(STATUS_PREFIX)] = received.message()
    return statuses


def list_topics(run_dir: Path) -> list[TopicRow]:
    """All topics of the table and all status topics, with their current publisher and number of subscribers."""
    publishers: dict[str, tuple[str, int]] = {}
    statuses = {name: status for name, status in node_statuses(run_dir).items() if status is not None}
    for name, status in statuses.items():
        for topic, subscribers in zip(status.publications, status.subscribers, strict=True):
            publishers[topic] = (name, int(subscribers))
    rows = [TopicRow(name, row.type, *publishers.get(name, ("", 0))) for name, row in TOPICS.items()]
    return rows + [
        TopicRow(status_topic(name), topic_row(status_topic(name)).type, name, 0) for name in sorted(statuses)
    ]


def listen(run_dir: Path, topic: str, duration_s: float | None) -> Iterator[Received]:
    """Yield the messages of a topic as they arrive, for ``duration_s`` [s] (None: for ever)."""
    deadline = None if duration_s is None else time.monotonic() + duration_s
    with Bus(run_dir) as bus:
        bus.subscribe(topic, queue=1000)
        while deadline is None or time.monotonic() < deadline:
            bus.wait(0.1 if deadline is None else min(0.1, max(0.0, deadline - time.monotonic())))
            yield from bus.receive()


def measure_rate(run_dir: Path, topic: str, duration_s: float) -> RateReport:
    """Listen for ``duration_s`` [s] and measure the rate of a topic, and the age of its messages at publication and reception."""
    times, published, way, ages, lost = [], [], [], [], 0
    for received in listen(run_dir, topic, duration_s):
        info, message = received.info, received.message()
        times.append(info.publish_mono_ns)
        lost += info.lost
        way.append((info.receive_mono_ns - info.publish_mono_ns) / NS_PER_S)
        if hasattr(message, "header"):
            published.append((info.publish_real_ns - stamp_ns(message)) / NS_PER_S)
            ages.append((info.receive_real_ns - stamp_ns(message)) / NS_PER_S)
    if len(times) < 2:
        raise MessageError(
            f"expected at least two messages of {topic} in {duration_s:g} s, got {len(times)}; is its node running?"
        )
    gaps = [(b - a) / NS_PER_S for a, b in pairwise(times)]
    return RateReport(
        len(times),
        lost,
        len(gaps) / sum(gaps),
        min(gaps),
        max(gaps),
        _delay(published) if published else None,
        _delay(way),
        _delay(ages) if ages else None,
    )


def _delay(values_s: list[float]) -> Delay:
    median_s, p99_s = np.percentile(values_s, [50, 99])
    return Delay(float(median_s), float(p99_s), max(values_s))


def describe(message: Any, indent: str = "") -> str:
    """Format a message as indented text. Long arrays are shortened."""
    lines = []
    for name, value in vars(message).items():
        if name.startswith("__"):
            continue
        if hasattr(value, "__msgtype__"):
            lines.append(f"{indent}{name}:\n{describe(value, indent + '  ')}")
        elif isinstance(value, np.ndarray | list) and len(value) > _ECHO_ITEMS:
            shown = ", ".join(str(item) for item in value[:_ECHO_ITEMS])
            lines.append(f"{indent}{name}: [{shown}, ... {len(value)} in all]")
        elif isinstance(value, np.ndarray):
            lines.append(f"{indent}{name}: {value.tolist()}")
        else:
            lines.append(f"{indent}{name}: {value!r}")
    return "\n".join(lines)
