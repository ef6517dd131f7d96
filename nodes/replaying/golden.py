"""Golden bags: stored outputs of replayed nodes, with which new replays are compared.

The messages of a topic are compared in order: first byte for byte, then field by field with the given tolerance. Status messages are
not results, so they are neither in the digest of a replay nor in a golden bag.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nodes.bags.info import BagMessage
from nodes.bags.reader import read_info, read_messages
from nodes.bags.writer import BagWriter
from nodes.replaying.replay import Replay
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, MessageError
from nodes.runtime.messages import decode, ns_from_stamp
from nodes.runtime.topics import STATUS_PREFIX
from nodes.runtime.topics import topic as topic_row

_SUFFIX = ".mcap"


@dataclass(frozen=True)
class Tolerances:
    """Tolerances for the comparison of numbers.

    Attributes:
        general: Tolerance of all other fields.
        special: Tolerances of single fields, by topic and field: ``("/policy/drive", "drive.steering_angle")``.
    """

    general: float = 0.0
    special: Mapping[tuple[str, str], float] | None = None

    @classmethod
    def parse(cls, texts: Sequence[str]) -> Tolerances:
        """Parse ``VALUE`` and ``TOPIC:FIELD=VALUE`` texts."""
        general, special = 0.0, {}
        for text in texts:
            where, separator, value = text.rpartition("=")
            topic, colon, name = where.partition(":")
            try:
                number = float(value)
            except ValueError:
                number = -1.0
            if not 0.0 <= number < float("inf") or (
                separator and not (colon and name and topic.startswith("/"))
            ):
                raise BagError(
                    f"--tolerance {text}: expected VALUE or TOPIC:FIELD=VALUE with a number >= 0, "
                    "for example 1e-6 or /policy/drive:drive.steering_angle=1e-4"
                )
            if separator:
                special[(topic_row(topic).name, name)] = number
            else:
                general = number
        return cls(general, special)

    def of(self, topic: str, name: str) -> float:
        """Tolerance of a field."""
        return (self.special or {}).get((topic, name), self.general)


@dataclass(frozen=True)
class Difference:
    """The first message that differs from the golden bag.

    Attributes:
        topic: Topic of the message.
        index: Index among the messages of the topic, from 0.
        log_ns: Time in the recording [ns since 1970].
        stamp_ns: Capture stamp in its header [ns since 1970]; None without a header.
        name: Field, for example ``drive.steering_angle``.
        golden: Golden value, as text.
        got: Value of the replay, as text.
        by: Largest difference, for numbers.
        tolerance: Tolerance of the field.
    """

    topic: str
    index: int
    log_ns: int
    stamp_ns: int | None
    name: str
    golden: str
    got: str
    by: float | None = None
    tolerance: float = 0.0

    def text(self, start_ns: int) -> str:
        """Describe the difference in a sentence. ``start_ns`` is the start of the recording [ns since 1970]."""
        stamp = "" if self.stamp_ns is None else f", captured at {self.stamp_ns} ns"
        where = f"{self.topic} message {self.index}, {(self.log_ns - start_ns) / NS_PER_S:.3f} s into the recording{stamp}"
        much = "" if self.by is None else f": differs by {self.by:.6g}, tolerance {self.tolerance:.6g}"
        return f"{where}: {self.name} was {self.golden}, is {self.got}{much}"


class Golden:
    """Compares a replay with a golden bag, message by message.

    Args:
        tolerances: Tolerances of numbers.
        topics: Topics to compare; none means all.
    """

    def __init__(
        self, path: Path, tolerances: Tolerances | None = None, topics: Sequence[str] | None = None
    ) -> None:
        self._tolerances = tolerances or Tolerances()
        recorded = [topic.name for topic in read_info(path).topics]
        if topics and (missing := [name for name in topics if name not in recorded]):
            raise BagError(f"{path} has no topic {', '.join(missing)}; it has {', '.join(recorded)}")
        self._only = set(topics) if topics else None
        compared = [name for name in recorded if self._only is None or name in self._only]
        self._expected: dict[str, Iterator[BagMessage]] = {
            name: read_messages(path, [name]) for name in compared
        }
        self._indices: dict[str, int] = dict.fromkeys(compared, 0)
        self._differences: dict[str, Difference] = {}
        self.compared = 0

    def take(self, message: BagMessage) -> None:
        """Compare a message of the replay with its golden counterpart."""
        topic = message.topic
        if topic.startswith(STATUS_PREFIX) or (self._only is not None and topic not in self._only):
            return
        index = self._indices.get(topic, 0)
        self._indices[topic] = index + 1
        if topic in self._differences:
            return
        expected = next(self._expected.get(topic, iter(())), None)
        self.compared += 1
        if expected is None:
            stamp = _stamp(_decoded(message))
            self._differences[topic] = Difference(
                topic, index, message.log_ns, stamp, "the message", "not there", "there"
            )
        elif found := compare(expected, message, index, self._tolerances):
            self._differences[topic] = found

    def finish(self) -> Difference | None:
        """Finish the comparison and return the earliest difference; None without one."""
        for topic, messages in self._expected.items():
            if topic not in self._differences and (left := next(messages, None)) is not None:
                stamp, index = _stamp(_decoded(left)), self._indices[topic]
                self._differences[topic] = Difference(
                    topic, index, left.log_ns, stamp, "the message", "there", "not there"
                )
        return min(self._differences.values(), key=lambda found: (found.log_ns, found.topic), default=None)


def compare(golden: BagMessage, got: BagMessage, index: int, tolerances: Tolerances) -> Difference | None:
    """Compare two messages of a topic. Returns their difference, or None."""
    if golden.cdr == got.cdr and golden.log_ns == got.log_ns:
        return None
    was, now = _decoded(golden), _decoded(got)
    stamp = _stamp(was)
    for name, old, new in _fields(was, now, ""):
        allowed = tolerances.of(golden.topic, name)
        if found := _unlike(old, new, allowed):
            return Difference(golden.topic, index, golden.log_ns, stamp, name, *found, tolerance=allowed)
    if golden.log_ns != got.log_ns:
        by_s = abs(golden.log_ns - got.log_ns) / NS_PER_S
        allowed = tolerances.of(golden.topic, "time")
        if by_s > allowed:
            was_ns, now_ns = f"{golden.log_ns} ns", f"{got.log_ns} ns"
            return Difference(
                golden.topic, index, golden.log_ns, stamp, "time", was_ns, now_ns, by_s, allowed
            )
    return None


def update_golden(path: Path, replay: Replay, topics: Sequence[str] | None = None) -> int:
    """Replace the golden bag with the messages of a replay without the kept ones. Returns the number of messages.

    The same replay gives the same file, byte for byte.
    """
    path = Path(path)
    if path.suffix != _SUFFIX or path.is_dir():
        raise BagError(f"expected a golden bag file that ends with {_SUFFIX}, got {path}")
    path.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with tempfile.TemporaryDirectory(prefix=".golden-", dir=path.parent) as folder:
        metadata = {"golden": ", ".join(replay.names)}
        with BagWriter(
            Path(folder) / path.stem, metadata=metadata, attached_ns=replay.info.start_ns
        ) as writer:
            for message in replay:
                wanted = not topics or message.topic in topics
                if wanted and not message.topic.startswith(STATUS_PREFIX):
                    writer.write(
                        message.topic, message.cdr, message.log_ns, message.publish_ns, message.sequence
                    )
                    count += 1
            writer.close({"digest": replay.summary.digest})
        if count == 0:
            raise BagError(
                f"expected messages{' on ' + ', '.join(topics) if topics else ''}, but the replay published none; the golden bag {path} is unchanged"
            )
        writer.path.replace(path)
    return count


def _decoded(message: BagMessage) -> Any:
    try:
        return decode(topic_row(message.topic).type, message.cdr)
    except MessageError as error:
        raise BagError(
            f"{message.topic} in the golden bag cannot be read: {error}; write it again with --update-golden"
        ) from error


def _stamp(message: Any) -> int | None:
    head = getattr(message, "header", None)
    return None if head is None else ns_from_stamp(head.stamp)


def _fields(was: Any, now: Any, prefix: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield name and both values of every leaf field, in the order of the definition."""
    for name, old in vars(was).items():
        if name.startswith("__"):
            continue
        new, full = getattr(now, name), prefix + name
        if hasattr(old, "__msgtype__"):
            yield from _fields(old, new, full + ".")
        elif isinstance(old, list) and old and hasattr(old[0], "__msgtype__") and len(old) == len(new):
            for index, pair in enumerate(zip(old, new, strict=True)):
                yield from _fields(*pair, f"{full}[{index}].")
        else:
            yield full, old, new


def _unlike(old: Any, new: Any, allowed: float) -> tuple[str, str, float | None] | None:
    """Return golden value, new value and difference; None if they agree within the tolerance."""
    if isinstance(old, str | bool) or not isinstance(old, int | float | np.ndarray):
        return None if old == new else (repr(old), repr(new), None)
    a, b = np.asarray(old), np.asarray(new)
    if a.shape != b.shape:
        return f"{a.size} values", f"{b.size} values", None
    if a.dtype.kind not in "biuf":
        return None if np.array_equal(a, b) else (repr(old), repr(new), None)
    x, y = a.astype(np.float64), b.astype(np.float64)
    same = (x == y) | (np.isnan(x) & np.isnan(y))
    by = np.where(same, 0.0, np.abs(np.subtract(x, y, where=~same, out=np.zeros_like(x))))
    by = np.where(np.isnan(by), np.inf, by)
    worst = float(by.max(initial=0.0))
    if worst <= allowed:
        return None
    if a.ndim == 0:
        return f"{a.item():.9g}", f"{b.item():.9g}", worst
    at = int(by.argmax())
    count = int((by > allowed).sum())
    return f"{x.flat[at]:.9g} at [{at}]", f"{y.flat[at]:.9g} ({count} of {a.size} values differ)", worst
