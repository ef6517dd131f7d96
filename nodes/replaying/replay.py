"""Lockstep replay: runs node classes in this process, message by message, in the order and on the time of the recording.

A replay neither reads a clock nor waits, so the same bag gives the same bytes on every machine. Recorded messages of the replayed
nodes are replaced by new ones. An output has the time of the message or tick that caused it, and reaches the other replayed nodes
before the next message. No message is dropped for being late.
"""

from __future__ import annotations

import tempfile
from collections import deque
from collections.abc import Collection, Iterator
from pathlib import Path

from nodes.bags.info import BagMessage
from nodes.bags.reader import read_attachments, read_info, read_messages, require_readable
from nodes.bags.time_gaps import silence_s, skipped_gaps
from nodes.bags.writer import BagWriter
from nodes.replaying.lockstep import BagClock, Lockstep, Summary
from nodes.replaying.nodes import Choice, build_nodes, close_nodes
from nodes.runtime.errors import BagError
from nodes.runtime.node import Node
from nodes.runtime.topics import topic as topic_row
from nodes.runtime.topics import type_of_topic


class Replay:
    """A bag and the nodes to run over it.

    Args:
        whole: Also yield messages of the bag to which no node subscribes (to write another bag).
        unheard: Topics whose recorded messages no node gets.

    Topics that are not in the topic table are skipped and listed in `left_out`. Iterate once; then `summary` is complete. Use it as a
    context manager: leaving it closes the nodes.
    """

    def __init__(self, bag: Path, choice: Choice, whole: bool = False, unheard: Collection[str] = ()) -> None:
        self.info = read_info(bag)
        self.bag, self._whole = bag, whole
        self._folder = tempfile.TemporaryDirectory(prefix="advnerf-replay-")
        self._clock = BagClock(self.info.start_ns)
        self._nodes: dict[str, Node] = {}
        try:
            self._nodes = build_nodes(bag, choice, Path(self._folder.name), self._clock)
            self._lockstep = Lockstep(self._nodes, self._clock, self.info.start_ns)
            self._gaps = skipped_gaps(bag)
            self._gaps_ahead = deque(self._gaps)
            recorded = [topic.name for topic in self.info.topics]
            self.left_out = [topic for topic in recorded if type_of_topic(topic) is None]
            heard = self._lockstep.heard_topics - self.made_topics - set(unheard)
            self._heard = [topic for topic in recorded if topic in heard]
            require_readable(bag, {topic: topic_row(topic).type for topic in self._heard})
            if not self._heard:
                raise BagError(
                    f"{self.info.path} has nothing for {', '.join(choice.nodes)}: they listen to "
                    f"{', '.join(sorted(self._lockstep.heard_topics)) or 'nothing'}, it has {', '.join(recorded)}"
                )
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Replay:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @property
    def names(self) -> list[str]:
        """Names of the replayed nodes."""
        return list(self._nodes)

    def blind_sources(self, topic: str) -> list[str]:
        """Names of the replayed nodes that publish a topic and do not look at the images that they get."""
        return [name for name, node in self._nodes.items() if node.blind and topic in node.publications]

    @property
    def made_topics(self) -> set[str]:
        """Topics whose recorded messages are replaced by the replayed nodes' messages."""
        return self._lockstep.made_topics

    @property
    def summary(self) -> Summary:
        """Current summary."""
        return self._lockstep.summary

    def __iter__(self) -> Iterator[BagMessage]:
        """Yield every new message, and with ``whole`` also the kept ones, in order. Times of new ones are those in the recording."""
        recorded = [topic.name for topic in self.info.topics]
        topics = [topic for topic in recorded if topic not in self.left_out] if self._whole else self._heard
        heard = frozenset(self._heard)
        for message in read_messages(self.bag, topics):
            if message.topic in self.made_topics:
                continue
            yield from self._advance_to(message.log_ns)
            if self._whole:
                yield message
            if message.topic in heard:
                yield from self._lockstep.feed(message)
        yield from self._advance_to(self.info.end_ns)
        self._lockstep.finish()
        self.summary.duration_s = self.info.duration_s - silence_s(self._gaps)

    def _advance_to(self, real_ns: int) -> list[BagMessage]:
        """Run the ticks that are due by a time. In a gap of the recording there are none."""
        made: list[BagMessage] = []
        while self._gaps_ahead and self._gaps_ahead[0].after_ns <= real_ns:
            gap = self._gaps_ahead.popleft()
            made += self._lockstep.jump(gap.before_ns, gap.after_ns)
        return made + self._lockstep.advance_to(real_ns)

    def close(self) -> None:
        """Close the nodes."""
        nodes, self._nodes = self._nodes, {}
        close_nodes(nodes)
        self._folder.cleanup()


def write_replay(replay: Replay, folder: Path) -> None:
    """Write a replay, created with ``whole``, as a new bag with the kept and the new messages.

    All attachments are copied. The same replay gives the same bytes.
    """
    metadata = {**replay.info.metadata, "replayed": ", ".join(sorted(replay.names))}
    attachments = read_attachments(replay.bag)
    with BagWriter(folder, attachments, metadata, attached_ns=replay.info.start_ns) as writer:
        for message in replay:
            writer.write(message.topic, message.cdr, message.log_ns, message.publish_ns, message.sequence)
        writer.close({"digest": replay.summary.digest})
