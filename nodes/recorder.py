"""The recorder node: writes the messages on the bus to a bag."""

from __future__ import annotations

import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import Field

from advnerf_core.strict import StrictModel
from nodes.bags.writer import BagWriter, SplitLimits
from nodes.runtime.errors import BagError, NodeFinished
from nodes.runtime.messages import decode
from nodes.runtime.node import MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.paths import RESOLVED_NAME
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import TOPICS, status_topic
from nodes.runtime.topics import topic as topic_row

# Period of finishing the current chunk. A power cut loses little more than this.
_FLUSH_HZ = 1.0
_PAGE_ACT, _PAGE_STOPS = "/operator/act", "record_stop"


class RecorderConfig(StrictModel):
    """Configuration of the recorder.

    Attributes:
        output: Folder of the bag, relative to the run folder. It must not exist.
        topics: Topics to record; none means the whole topic table.
        statuses_of: Nodes whose status is also recorded.
        attachments: Files to attach, such as calibration and attack files.
        queue: Messages per topic that may wait while the disk is busy.
        max_bag_duration_s: Time after which a new file starts [s]. The default keeps the index of a quiet recording small.
        until_page_stops: End when the operator page says so, with all that it said before.
        max_bag_size_mb: Size at which a new file starts [MiB], after compression. The index of a file takes about 700 bytes of memory
            per image, or per 64 KiB of small messages.
    """

    output: Path = Path("bag")
    topics: list[str] | None = None
    statuses_of: list[str] = Field(default_factory=list)
    attachments: list[Path] = Field(default_factory=list)
    queue: int = Field(default=200, ge=1)
    until_page_stops: bool = False
    max_bag_duration_s: float = Field(default=SplitLimits.duration_s, gt=0, allow_inf_nan=False)
    max_bag_size_mb: float = Field(default=SplitLimits.size_mib, gt=0, allow_inf_nan=False)


class RecorderNode(Node):
    """Writes received bytes to a bag without decoding.

    Args:
        queue: Messages that may wait per topic.
        until_page_stops: As in `RecorderConfig`.
    """

    opens = "a new bag"
    raw = True
    tick_rate_hz = _FLUSH_HZ

    def __init__(
        self, writer: BagWriter, topics: list[str], queue: int, until_page_stops: bool = False
    ) -> None:
        self._writer, self._until_page_stops = writer, until_page_stops
        self._lost = dict.fromkeys(topics, 0)
        self.subscriptions = tuple(topics)
        self.queues = dict.fromkeys(topics, queue)

    @classmethod
    def build(cls, config: RecorderConfig, context: NodeContext) -> RecorderNode:
        """Build the node: read the attachments and open the bag."""
        topics = list(TOPICS) if config.topics is None else [topic_row(name).name for name in config.topics]
        topics += [topic for name in config.statuses_of if (topic := status_topic(name)) not in topics]
        attachments = _read_attachments([context.run_dir / RESOLVED_NAME], must_exist=False)
        attachments |= _read_attachments(config.attachments, must_exist=True)
        limits = SplitLimits(config.max_bag_duration_s, config.max_bag_size_mb)
        folder = context.run_dir / config.output
        writer = BagWriter(folder, attachments, provenance(), limits=limits, compressed=True)
        return cls(writer, topics, config.queue, config.until_page_stops)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Write one message."""
        self._writer.write(
            topic, info.raw, info.receive_real_ns, info.publish_real_ns, info.sequence, info.lost
        )
        self._lost[topic] += info.lost
        if self._until_page_stops and topic == _PAGE_ACT:
            act = decode(topic_row(topic).type, info.raw)
            if act.act == _PAGE_STOPS and act.granted:
                raise NodeFinished(f"{act.operator or 'the page'} stopped the recording")
        return []

    def tick(self, now: Now) -> list[Out]:
        """Flush the current chunk."""
        self._writer.flush()
        return []

    def status(self) -> tuple[str, str]:
        """Report active, with the number of messages."""
        return "active", f"{self._writer.messages} messages in {self._writer.folder}"

    def counters(self) -> dict[str, float]:
        """Report lost messages."""
        return {"lost_total": float(sum(self._lost.values()))}

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()


def provenance() -> dict[str, str]:
    """Origin of a recording: versions, git hash, machine."""
    facts = {"python": platform.python_version(), "host": platform.node(), "machine": platform.machine()}
    try:
        facts["version"] = version("advnerf")
    except PackageNotFoundError:
        facts["version"] = "not installed"
    command = [
        "git",
        "-C",
        str(Path(__file__).parent),
        "describe",
        "--always",
        "--dirty",
        "--abbrev=40",
        "--exclude=*",
    ]
    try:
        result = subprocess.run(command, capture_output=True, text=True, timeout=5, check=False)
        facts["git"] = result.stdout.strip() if result.returncode == 0 else "not a checkout"
    except (OSError, subprocess.TimeoutExpired):
        facts["git"] = "no answer from git"
    return facts


def _read_attachments(paths: list[Path], must_exist: bool) -> dict[str, bytes]:
    contents: dict[str, bytes] = {}
    for path in paths:
        if not must_exist and not path.exists():
            continue
        if path.name in contents:
            raise BagError(
                f"expected attachments with different names, got two called {path.name}; rename one"
            )
        try:
            contents[path.name] = path.read_bytes()
        except OSError as error:
            raise BagError(
                f"cannot attach {path}: {error.strerror}; correct its path or permissions"
            ) from error
    return contents


if __name__ == "__main__":
    raise SystemExit(run_node_main(RecorderConfig, RecorderNode.build))
